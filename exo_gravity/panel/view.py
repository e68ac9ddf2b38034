"""What the page shows: the state of an arm, ten times a second; its limits and settings; the picture of the arms."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree

from exo_gravity.panel.params import SETTABLE

SILENT = 1.5  # s without diagnostics or joint states after which the last ones are not shown any more
OF_BRIDGE = {
    "state": "state",
    "fault": "fault",
    "limits": "limits acting",
    "rate": "rate (Hz)",
    "answered": "age of efforts (ms)",
}


@dataclass
class Joints:
    """The newest message with joint values."""

    time: float = -math.inf  #: monotonic s of its arrival
    names: Sequence[str] = ()
    position: Sequence[float] = ()
    effort: Sequence[float] = ()


@dataclass
class Status:
    """The newest diagnostics of one node."""

    level: int = 0  #: 0 OK, 1 warning, 2 error
    message: str = ""
    values: Mapping[str, str] = field(default_factory=dict)
    time: float = -math.inf  #: monotonic s of its arrival


def arm_state(now: float, joints: Joints, bridge: Status, compensator: Status) -> dict[str, Any]:
    """Return the state of one arm for the page; None in the place of what is old."""
    state: dict[str, Any] = {"bridge": None, "compensator": None, "joints": None}
    if now - bridge.time < SILENT:
        values = {key: bridge.values.get(name, "") for key, name in OF_BRIDGE.items()}
        state["bridge"] = {"level": bridge.level, "message": bridge.message, **values}
    if now - compensator.time < SILENT:
        carried = compensator.values.get("mass carried (kg)")
        state["compensator"] = {"level": compensator.level, "message": compensator.message, "mass carried": carried}
    if now - joints.time < SILENT:
        state["joints"] = [
            {
                "name": name,
                "position": _rounded(joints.position, n),
                "effort": _rounded(joints.effort, n),
                "temperature": _number(bridge.values.get(f"{name} temperature (degC)")) if state["bridge"] else None,
            }
            for n, name in enumerate(joints.names)
        ]
    return state


def _rounded(values: Sequence[float], index: int) -> float | None:
    return round(values[index], 4) if index < len(values) and math.isfinite(values[index]) else None


def _number(text: str | None) -> float | None:
    try:
        value = float(text or "nan")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def arm_setup(bridge: Mapping[str, Any], compensator: Mapping[str, Any], support_limit: float | None) -> dict[str, Any]:
    """Return limits and settings of one arm for the page, from the parameters of its two nodes.

    support_limit: the largest support within the motors' rated torque, None if it is not known.
    """
    limits = {name: bridge.get(name) for name in ("joint_names", "position_min", "position_max")}
    efforts = [values["max_effort"] for values in (bridge, compensator) if values.get("max_effort")]
    return {
        **limits,
        "max_effort": [min(column) for column in zip(*efforts, strict=True)] if efforts else None,
        "settings": {name: compensator.get(name) for name in SETTABLE},
        "support_limit": support_limit,
    }


def scene_of(urdf: str) -> dict[str, Any]:
    """Return {"links": {name: [shape]}, "joints": [joint]} of a robot description (`core.view.urdf`).

    shape: kind (box, cylinder or sphere), size in m with the name of each number in keys, xyz in m and rpy in rad in
    the link's frame, rgba. joint: name, parent, child, xyz, rpy, and axis and limits where it can turn, else None.
    """
    robot = ElementTree.fromstring(urdf)
    colours = {material.get("name"): _numbers(material, "color", "rgba") for material in robot.findall("material")}
    shapes = {link.get("name", ""): [_shape(v, colours) for v in link.findall("visual")] for link in robot.iter("link")}
    return {"links": shapes, "joints": [_joint(joint) for joint in robot.findall("joint")]}


def _shape(visual: ElementTree.Element, colours: Mapping[str | None, list[float] | None]) -> dict[str, Any]:
    shape = next(visual.iter("geometry"))[0]
    return {
        "kind": shape.tag,
        "size": [float(word) for value in shape.attrib.values() for word in value.split()],
        "keys": list(shape.attrib),
        "rgba": colours[next(visual.iter("material")).get("name")],
        **_origin(visual),
    }


def _joint(joint: ElementTree.Element) -> dict[str, Any]:
    limit = joint.find("limit")
    return {
        "name": joint.get("name"),
        "parent": next(joint.iter("parent")).get("link"),
        "child": next(joint.iter("child")).get("link"),
        "axis": _numbers(joint, "axis", "xyz"),
        "lower": float(limit.get("lower", "0")) if limit is not None else None,
        "upper": float(limit.get("upper", "0")) if limit is not None else None,
        **_origin(joint),
    }


def _origin(element: ElementTree.Element) -> dict[str, list[float]]:
    return {key: _numbers(element, "origin", key) or [0.0] * 3 for key in ("xyz", "rpy")}


def _numbers(parent: ElementTree.Element, tag: str, key: str) -> list[float] | None:
    element = parent.find(tag)
    return [float(word) for word in element.get(key, "").split()] if element is not None else None
