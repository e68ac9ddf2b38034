"""The parameter file that drives everything: ROS 2's own YAML form, keyed by fully qualified node names.

    /imu: {ros__parameters: {...}}
    /right/can_bridge: {ros__parameters: {can: {interface: socketcan}, ...}}

The tools read it to find out which nodes to start and which arms they have; the nodes read it through ROS.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from exo_gravity.core.errors import ParameterError

FORM = "/namespace/executable: {ros__parameters: {...}}"
MAX_LIST = 100  # entries; the longest list of any parameter has 4, and ROS's reader takes minutes for 200,000
# libyaml is ten times faster; PyYAML is sometimes built without it.
Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

Nodes = dict[str, dict[str, Any]]  # node name -> dotted parameter name -> value


def packaged_config(name: str) -> Path:
    """Return the path of a file of `config/`, in a checkout, a virtual environment or a ROS workspace.

    Raises ParameterError if it is in none of them.
    """
    shares = [
        Path(prefix, "share/exo_gravity") for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if prefix
    ]
    for root in (Path(__file__).parents[3], *shares, Path(sys.prefix, "share/exo_gravity")):
        path = root / "config" / name
        if path.is_file():
            return path
    raise ParameterError("config", name, "a file that the package installs: reinstall the package")


def load(path: str | Path) -> Nodes:
    """Return {node name: {dotted parameter name: value}} of a parameter file.

    Raises ParameterError, which names the file or the entry, if the file is missing, not YAML, or of another form.
    """
    try:
        content = yaml.load(Path(path).read_text(encoding="utf-8"), Loader)
    except OSError as error:
        raise ParameterError("params", str(path), f"a readable file ({error.strerror})") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ParameterError("params", str(path), f"YAML ({' '.join(str(error).split())})") from None
    if not isinstance(content, dict) or not content:
        raise ParameterError("params", str(path), f"a mapping of {FORM}")
    return {str(node): _parameters(str(node), entry) for node, entry in content.items()}


def _parameters(node: str, entry: Any) -> dict[str, Any]:
    if not node.startswith("/") or node.endswith("/"):
        raise ParameterError("node name", node, f"fully qualified, as in {FORM}")
    if not isinstance(entry, dict) or set(entry) != {"ros__parameters"}:
        raise ParameterError(node, entry, f"of the form {FORM}")
    return dict(_flat(node, "", entry["ros__parameters"] or {}))


def _flat(node: str, prefix: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) of each parameter; raise ParameterError for values that ROS cannot read."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(node, f"{prefix}.{key}" if prefix else str(key), inner)
        return
    if value is None:
        raise ParameterError(f"{node} {prefix}", value, "given a value, or left out")
    if isinstance(value, list):
        if len(value) > MAX_LIST:
            raise ParameterError(f"{node} {prefix}", value, f"at most {MAX_LIST} entries; it has {len(value):,}")
        if len({type(item) for item in value}) > 1:
            # ROS's own reader refuses such a list without naming it.
            raise ParameterError(f"{node} {prefix}", value, "a list of one type: 1.0, not 1, next to 2.5")
    yield prefix, value
