# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Feed-forward gravity compensation for a worn upper-body exoskeleton (ROS 2)."""

import os
import sys
from pathlib import Path


def packaged(name: str) -> Path | None:
    """Return a file or folder of `config/`, in a checkout, a workspace or a virtual environment; None if in none."""
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(":"))
    shares = (Path(prefix, "share/exo_gravity") for prefix in (*prefixes, sys.prefix))
    roots = (Path(__file__).parents[1], *shares)
    return next((path for root in roots if (path := root / "config" / name).exists()), None)


def version() -> str:
    """Return the version of the installed package, '' if it is not installed."""
    from importlib import metadata  # slow to import

    try:
        return metadata.version("exo_gravity")
    except metadata.PackageNotFoundError:
        return ""
