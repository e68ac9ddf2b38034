"""The one YAML that drives everything: ROS 2's own parameter-file form, keyed by fully qualified node names.

    /imu: {ros__parameters: {...}}
    /right/can_bridge: {ros__parameters: {can: {interface: socketcan}, ...}}

The tools read it to know which nodes to start and what arm they have; the nodes read it through ROS.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import yaml

from exo_gravity.core.errors import ParameterError

FORM = "/namespace/executable: {ros__parameters: {...}}"


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
    raise ParameterError("config", name, "a file that the package installs; is it installed whole?")


def load(path: str | Path) -> dict[str, dict[str, Any]]:
    """Return {node name: {dotted parameter name: value}} of a parameter file.

    Raises ParameterError, naming the file or the entry, where it is missing, no YAML or of another form.
    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
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


def _flat(node: str, prefix: str, value: Any):
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(node, f"{prefix}.{key}" if prefix else str(key), inner)
        return
    if value is None:
        raise ParameterError(f"{node} {prefix}", value, "given a value, or left out")
    if isinstance(value, list) and len({type(item) for item in value}) > 1:
        # ROS's own reader gives up on such a list without naming it.
        raise ParameterError(f"{node} {prefix}", value, "a list of one type: 1.0, not 1, beside 2.5")
    yield prefix, value
