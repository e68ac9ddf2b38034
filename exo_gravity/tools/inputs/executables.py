"""The executables of the package that are nodes, and where they are installed."""

from __future__ import annotations

import os
import shutil
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from exo_gravity.core.errors import ParameterError

NODES_PACKAGE = "exo_gravity.nodes."


def node_names() -> tuple[str, ...]:
    """Return the executables that are nodes, from the entry points of the installed package."""
    try:
        scripts = distribution("exo_gravity").entry_points.select(group="console_scripts")
    except PackageNotFoundError:
        return ()
    return tuple(sorted(script.name for script in scripts if script.value.startswith(NODES_PACKAGE)))


def executable(node: str) -> str:
    """Return the path of the executable of `node` ('/right/can_bridge'). Raises ParameterError if there is none."""
    name, names = node.rpartition("/")[2], node_names()
    if name not in names:
        raise ParameterError("node name", node, f"/namespace/executable, with one of {', '.join(names)}")
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(":"))
    folders = (
        Path(sys.argv[0]).resolve().parent,
        Path(sys.executable).parent,
        *(Path(prefix, "lib", "exo_gravity") for prefix in prefixes),
    )
    path = os.pathsep.join(map(str, folders))
    found = shutil.which(name, path=path)
    if found is None:
        raise ParameterError("node name", node, f"an installed executable: {name} is in none of {path}")
    return found
