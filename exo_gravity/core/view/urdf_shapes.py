"""What a robot description looks like: a trunk, tubes, motors, and a small sphere at each centre of gravity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement

from exo_gravity.core.view.arm_description import Point

COLOURS = {
    "person": (0.80, 0.76, 0.70, 0.6),
    "tube": (0.16, 0.17, 0.19, 1.0),
    "motor": (0.55, 0.58, 0.62, 1.0),
    "centre_of_gravity": (0.85, 0.25, 0.15, 1.0),
}
TUBE = 0.0125  # m, radius of the carbon tubes (the paper, appendix A)
MOTOR_RADIUS, MOTOR_LENGTH = 0.042, 0.04  # m, between AK60-6 and AK80-9
COG_RADIUS = 0.018  # m
CHEST, HEAD_RADIUS, HEAD_HEIGHT = (0.14, 0.26, 0.48), 0.10, 0.20  # m


def numbers(*values: float) -> str:
    """Return numbers as URDF writes them, with every digit, so that nothing is rounded."""
    return " ".join(repr(float(value) + 0.0) for value in values)  # + 0.0: no negative zero


def add_material(robot: Element) -> None:
    """Add the colours."""
    for name, colour in COLOURS.items():
        SubElement(SubElement(robot, "material", name=name), "color", rgba=numbers(*colour))


def add_mesh(link: Element, folder: str) -> None:
    """Add the mesh LINK.stl in `folder`, an address, as the visual of `link`."""
    visual = SubElement(link, "visual")
    geometry = SubElement(visual, "geometry")
    SubElement(geometry, "mesh", filename=f"{folder.rstrip('/')}/{link.get('name')}.stl")


def add_trunk_shapes(trunk: Element, shoulders: Sequence[Point]) -> None:
    """Add chest, head, and the motor of each joint 1, at `shoulders` (n, 3) m."""
    x, _, z = (sum(column) / len(shoulders) for column in zip(*shoulders, strict=True))
    _add(trunk, "person", "box", (x, 0.0, z - CHEST[2] / 2), size=numbers(*CHEST))
    _add(trunk, "person", "sphere", (x, 0.0, z + HEAD_HEIGHT), radius=numbers(HEAD_RADIUS))
    for shoulder in shoulders:
        _add_cylinder(trunk, "motor", shoulder, (0.0, 0.0, 1.0), MOTOR_RADIUS, MOTOR_LENGTH)


def add_link_shapes(link: Element, end: Point, next_axis: Point | None, centre: Point, sideways: bool) -> None:
    """Add the tube to `end`, the motor of the next joint there if there is one, and the centre of gravity, m."""
    middle = (end[0] / 2, end[1] / 2, end[2] / 2)
    along = (0.0, 1.0, 0.0) if sideways else (0.0, 0.0, 1.0)
    if any(end):
        _add_cylinder(link, "tube", middle, along, TUBE, math.hypot(*end))
    if next_axis:
        _add_cylinder(link, "motor", end, next_axis, MOTOR_RADIUS, MOTOR_LENGTH)
    _add(link, "centre_of_gravity", "sphere", centre, radius=numbers(COG_RADIUS))


def _add_cylinder(link: Element, material: str, centre: Point, axis: Point, radius: float, length: float) -> None:
    """Add a cylinder along `axis`, one of the frame's axes."""
    x, y, _ = map(abs, axis)
    turned = (y * math.pi / 2, x * math.pi / 2, 0.0)  # a cylinder of URDF lies along z
    _add(link, material, "cylinder", centre, turned, radius=numbers(radius), length=numbers(length))


def _add(
    link: Element, material: str, shape: str, centre: Point, turned: Point = (0.0, 0.0, 0.0), **dimensions: str
) -> None:
    visual = SubElement(link, "visual")
    SubElement(visual, "origin", xyz=numbers(*centre), rpy=numbers(*turned))
    SubElement(SubElement(visual, "geometry"), shape, dimensions)
    SubElement(visual, "material", name=material)
