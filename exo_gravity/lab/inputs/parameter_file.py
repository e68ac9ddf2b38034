"""The parameter file that drives everything: ROS 2's own YAML form, keyed by fully qualified node names.

    /imu: {ros__parameters: {...}}
    /right/can_bridge: {ros__parameters: {can: {interface: socketcan}, ...}}

The tools read it to find out which nodes to start and which arms they have; the nodes read it through ROS.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from exo_gravity import packaged
from exo_gravity.core.errors import ParameterError, named
from exo_gravity.core.motors.joint_motor import OPTIONS, buses_of
from exo_gravity.core.params import joint_count

FORM = "/namespace/executable: {ros__parameters: {...}}"
MAX_LIST = 100  # entries; the longest list of any parameter has 4, and ROS's reader takes minutes for 200,000
# libyaml is ten times faster; PyYAML is sometimes built without it.
Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

Nodes = dict[str, dict[str, Any]]  # node name -> dotted parameter name -> value


def packaged_config(name: str) -> Path:
    """Return the path of a file of `config/`. Raises ParameterError if it is not installed."""
    if (path := packaged(name)) is None:
        raise ParameterError("config", name, "a file that the package installs: reinstall the package")
    return path


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


def node_of(arm: str, executable: str) -> str:
    """Return the full name of a node of an arm: '/right/can_bridge'; an arm without a namespace is called 'arm'."""
    return f"/{executable}" if arm == "arm" else f"/{arm}/{executable}"


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


def can_options(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options for python-can in the parameters of a node."""
    prefix = f"{OPTIONS}."
    return {name.removeprefix(prefix): value for name, value in given.items() if name.startswith(prefix)}


def stages(nodes: Iterable[str]) -> tuple[list[str], list[str], list[str]]:
    """Return the full names `nodes` in the order in which they stop: bridges, others, recorders."""
    found: tuple[list[str], list[str], list[str]] = [], [], []
    for node in nodes:
        found[0 if node.endswith("/can_bridge") else 2 if node.endswith("/recorder") else 1].append(node)
    return found


def check_buses(nodes: Nodes) -> None:
    """Raise ParameterError if two bridges would command motors on the same bus, which has one owner."""
    owner: dict[tuple[tuple[str, str], ...], str] = {}
    for node in stages(nodes)[0]:
        given = nodes[node]
        with named(f"{node} "):
            buses = buses_of(str(given.get("can.channel", node)), can_options(given), joint_count(given))
        for name, (_, own) in buses.items():
            options = {f"{OPTIONS}.{option}": value for option, value in own.items()}
            what = {"can.channel": name, "can.interface": given.get("can.interface"), **options}
            bus = tuple(sorted((key, str(value)) for key, value in what.items()))
            other = owner.setdefault(bus, node)
            if other != node:
                raise ParameterError(f"{node} can", dict(bus), f"different from the bus of {other}: one arm per bus")
