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


def source() -> Path | None:
    """Return the folder or the wheel that this package came from, None where that is not known."""
    import json
    from importlib import metadata
    from urllib.parse import unquote

    folder = Path(__file__).parents[1]
    if (folder / "setup.py").exists():
        return folder
    try:
        told = metadata.distribution("exo_gravity").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        return None
    path = Path(unquote(json.loads(told)["url"].removeprefix("file://"))) if told else None
    return path if path and path.exists() else None


def pip_install(what: str) -> str:
    """Return the command that installs `what` here: Ubuntu guards its own Python, and ROS needs its NumPy."""
    import sysconfig

    is_guarded = sys.prefix == sys.base_prefix and Path(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED").exists()
    return f"pip install --break-system-packages '{what}' 'numpy<2'" if is_guarded else f"pip install '{what}'"


def with_extra(extra: str) -> str:
    """Return the command that installs an extra of this package, which no index has yet, from where that came."""
    path = source()
    if path and Path(sys.prefix).parent == path:
        return f"'{path}/.ci/setup' {extra.replace(',', ' ')}"
    if path:
        return pip_install(f"{path}[{extra}]")
    return f"{pip_install(f'.[{extra}]')} in the source folder of exo_gravity"


def require_ros(executable: str) -> None:
    """End `executable` with exit code 2 and one line if ROS 2's Python library is not found."""
    from importlib.util import find_spec

    if not find_spec("rclpy"):
        remedy = f"source /opt/ros/jazzy/setup.bash, or without ROS: {with_extra('ros')}"
        sys.stderr.write(f"{executable}: the Python package rclpy is not found: {remedy}\n")
        raise SystemExit(2)
