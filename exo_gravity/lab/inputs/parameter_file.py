# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The parameter file that drives everything: ROS 2's own YAML form, keyed by fully qualified node names.

    /imu: {ros__parameters: {...}}
    /right/can_bridge: {ros__parameters: {can: {interface: socketcan}, ...}}

The tools read it to find out which nodes to start and which arms they have; the nodes read it through ROS. Both read
the same (ros_yaml.py).
"""

from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

from exo_gravity import packaged
from exo_gravity.core.arm.tilt import SIDES
from exo_gravity.core.errors import DataError, ParameterError, named
from exo_gravity.core.motors.joint_motor import OPTIONS, buses_of
from exo_gravity.core.params import joint_count
from exo_gravity.lab.inputs import ros_yaml
from exo_gravity.lab.inputs.ros_yaml import Nodes

RECORDED_TEXTS = 32  # remembered of a recording: more than it has nodes whose parameters are used


def packaged_config(name: str) -> Path:
    """Return the path of a file of `config/`. Raises ParameterError if it is not installed."""
    if (path := packaged(name)) is None:
        raise ParameterError("config", name, "a file that the package installs: reinstall the package")
    return path


def load(path: str | Path) -> Nodes:
    """Return {node name: {dotted parameter name: value}} of a parameter file, as the nodes read it.

    Raises ParameterError, which names the file, the line or the entry, if the file is missing, not YAML, or of another
    form, if ROS would read it in a way that nobody means (ros_yaml.py), or if its nodes contradict each other.
    """
    try:
        nodes = ros_yaml.read(Path(path).read_text(encoding="utf-8"), str(path))
    except OSError as error:
        raise ParameterError("params", str(path), f"a readable file ({error.strerror})") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ParameterError("params", str(path), f"YAML ({' '.join(str(error).split())})") from None
    _check_together(nodes)
    return nodes


@lru_cache(RECORDED_TEXTS)
def recorded_parameters(text: str, node: str) -> Mapping[str, Any]:
    """Return the parameters of `node` by name, from the text that the recorder wrote. Raises DataError."""
    try:
        # In libyaml's loader some 25,000 brackets in brackets would end the process; PyYAML's own one raises.
        loader = ros_yaml.EventLoader if len(text) < 10_000 else yaml.SafeLoader
        given = yaml.load(text, loader)[node]["ros__parameters"]
        if {*map(type, given.keys())} <= {str}:
            return MappingProxyType(given)
    except (yaml.YAMLError, AttributeError, LookupError, TypeError, ValueError, RecursionError):
        pass
    raise DataError(f"{node}: the recording has no parameters of it that can be read")


def node_of(arm: str, executable: str) -> str:
    """Return the full name of a node of an arm: '/right/can_bridge'; an arm without a namespace is called 'arm'."""
    return f"/{executable}" if arm == "arm" else f"/{arm}/{executable}"


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


def _check_together(nodes: Nodes) -> None:
    """Raise ParameterError for nodes that contradict each other: buses, names of joints, sides, a second IMU."""
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
        # Efforts are looked up by name: the motors of two exchanged names would each get the torque of the other.
        for executable in ("compensator", "simulator"):
            other = f"{node.rpartition('/')[0]}/{executable}"
            names, others = (one.get("joint_names") for one in (given, nodes.get(other, {})))
            if names and others and list(names) != list(others):
                raise ParameterError(f"{node} joint_names", list(names), f"those of {other}, {list(others)}")
    for node, given in nodes.items():
        of_namespace, side = node.split("/")[-2], given.get("side")
        if side in SIDES and of_namespace in SIDES and side != of_namespace:
            raise ParameterError(f"{node} side", side, f"{of_namespace}, as its namespace says")
    imus = [node for node in nodes if node.endswith("/imu")]
    if len(imus) > 1:
        raise ParameterError("params", imus, "a file with one imu, which serves both arms: all publish /imu/pitch_yaw")
