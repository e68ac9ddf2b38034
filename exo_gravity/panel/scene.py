"""The robot description (URDF) as plain values that the page draws."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree


def scene_of(urdf: str) -> dict[str, Any]:
    """Return {"links": {name: [shape]}, "joints": [joint]} of a URDF.

    shape: kind (box, cylinder or sphere), size in m, xyz in m and rpy in rad in the link's frame, rgba. joint: name,
    parent, child, xyz, rpy, and axis and limits where it can turn.
    """
    robot = ElementTree.fromstring(urdf)
    colours = {
        material.get("name"): _numbers(color.get("rgba"))
        for material in robot.findall("material")
        if (color := material.find("color")) is not None
    }
    links = {str(link.get("name")): [_shape(v, colours) for v in link.findall("visual")] for link in robot.iter("link")}
    return {"links": links, "joints": [_joint(joint) for joint in robot.findall("joint")]}


def _shape(visual: ElementTree.Element, colours: dict[str | None, list[float]]) -> dict[str, Any]:
    geometry = visual.find("geometry")
    shape = geometry[0] if geometry is not None else ElementTree.Element("sphere", radius="0.02")
    material = visual.find("material")
    return {
        "kind": shape.tag,
        "size": [number for value in shape.attrib.values() for number in _numbers(value)],
        "keys": list(shape.attrib),
        "rgba": colours.get(material.get("name") if material is not None else None, [0.6, 0.6, 0.6, 1.0]),
        **_origin(visual),
    }


def _joint(joint: ElementTree.Element) -> dict[str, Any]:
    parent, child = joint.find("parent"), joint.find("child")
    axis, limit = joint.find("axis"), joint.find("limit")
    return {
        "name": joint.get("name"),
        "parent": parent.get("link") if parent is not None else "",
        "child": child.get("link") if child is not None else "",
        "axis": _numbers(axis.get("xyz")) if axis is not None else None,
        "lower": float(limit.get("lower", "0")) if limit is not None else None,
        "upper": float(limit.get("upper", "0")) if limit is not None else None,
        **_origin(joint),
    }


def _origin(element: ElementTree.Element) -> dict[str, list[float]]:
    origin = element.find("origin")
    return {key: _numbers(origin.get(key) if origin is not None else None) or [0.0] * 3 for key in ("xyz", "rpy")}


def _numbers(text: str | None) -> list[float]:
    return [float(word) for word in (text or "").split()]
