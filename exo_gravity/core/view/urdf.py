"""The robot description (URDF) of one arm or of both, made from the same values as the control law.

Every frame has the trunk's axes (REP-103: x forward, y left, z up) while the arm hangs at theta = 0. So the origins of
the joints are plain offsets, and the description needs no rotations. From the frames of Table 1 (model/arm.py), for the
left arm:

    joint 1  at the shoulder   turns about -z     link 1 points left, along +y
    joint 2  at (0, l1, 0)     turns about +x     links 2 to 4 point down, along -z
    joint 3  at (0, 0, -l2)    turns about -y
    joint 4  at (0, 0, -l3)    turns about -y

The right arm is the mirror image: y changes its sign in each offset, x and z theirs in each axis. So positive angles
are abduction and flexion on both sides. The gain c_n is no part of a description, and neither is gravity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.view.arm_description import ArmDescription, Point

ROOT = "trunk"
TUBE_RADIUS = 0.03  # m; each link has the inertia of a thin tube


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


class Body(NamedTuple):
    """Mass in kg and centre of gravity (3,) in m of one link, in the frame of its joint."""

    mass: float
    centre: Point


def urdf(arms: Sequence[ArmDescription], meshes: str = "") -> str:
    """Return the URDF of one arm a side, with the root link `trunk`.

    meshes: address of a folder (package:// or file://) with LINK.stl for every link, each in the frame of its joint and
    in m; '' draws tubes and motors. Raises ParameterError if two arms are on one side, or a link has no mass.
    """
    sides = [arm.side for arm in arms]
    if not arms or len(set(sides)) != len(sides):
        raise ParameterError("side", sides, "one arm for each side that is described")
    robot = Element("robot", name="exo_gravity")
    _add_material(robot)
    trunk = SubElement(robot, "link", name=ROOT)
    if meshes:
        _add_mesh(trunk, meshes)
    else:
        _add_trunk_shapes(trunk, [arm.base for arm in arms])
    for arm, names in zip(arms, joint_names(arms), strict=True):
        _add_arm(robot, arm, names, meshes)
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def joint_names(arms: Sequence[ArmDescription]) -> list[tuple[str, ...]]:
    """Return the four joint names of each arm; with the side in front if the arms share a name."""
    names = [arm.limits.joint_names for arm in arms]
    if len({name for four in names for name in four}) == JOINT_COUNT * len(arms):
        return names
    return [tuple(f"{arm.side}_{name}" for name in four) for arm, four in zip(arms, names, strict=True)]


def bodies(arm: ArmDescription) -> tuple[Body, ...]:
    """Return mass and centre of gravity of the four links.

    Moments across the links (moments.py) become offsets of the centres of gravity: W of link 1, Z of link 2, Y3 and
    Y4 of links 3 and 4. An arm given by its moments has the masses `arm.mass`, and its centres of gravity, also beyond
    the links, follow from the moments. Raises ParameterError if a link has no mass.
    """
    robot = arm.robot
    mass = [float(m) for m in (arm.mass if robot.by_moments else robot.mass)]
    if not all(m > 0.0 for m in mass):
        raise ParameterError("robot.mass", mass, "above 0 kg for each link of a robot description")
    along = [
        (robot.first_moment[n] - float(robot.length[n]) * sum(mass[n + 1 :])) / mass[n]
        if robot.by_moments
        else float(robot.cog[n])
        for n in range(JOINT_COUNT)
    ]
    w, z, y3, y4 = robot.off_axis
    out = arm.outward
    centres = (
        (w / mass[0], out * along[0], 0.0),
        (0.0, -out * z / mass[1], -along[1]),
        (y3 / mass[2], 0.0, -along[2]),
        (y4 / mass[3], 0.0, -along[3]),
    )
    return tuple(Body(m, centre) for m, centre in zip(mass, centres, strict=True))


def axes(arm: ArmDescription) -> tuple[Point, ...]:
    """Return the axes of the four joints in the trunk's axes."""
    return (0.0, 0.0, -arm.outward), (arm.outward, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, -1.0, 0.0)


def ends(arm: ArmDescription) -> tuple[Point, ...]:
    """Return the far end of each of the four links in the frame of its joint, m."""
    first, *others = arm.robot.length.tolist()
    return ((0.0, arm.outward * first, 0.0), *((0.0, 0.0, -length) for length in others))


def _add_arm(robot: Element, arm: ArmDescription, names: Sequence[str], meshes: str) -> None:
    lengths, end = arm.robot.length.tolist(), ends(arm)
    axis, parent, origin = axes(arm), ROOT, arm.base
    for n, (name, body) in enumerate(zip(names, bodies(arm), strict=True)):
        _add_joint(robot, name, "revolute", parent, arm.links[n], origin)
        _add_motion(robot[-1], arm, n, axis[n])
        link = SubElement(robot, "link", name=arm.links[n])
        _add_inertia(link, body, lengths[n], sideways=n == 0)
        if meshes:
            _add_mesh(link, meshes)
        else:
            next_axis = axis[n + 1] if n + 1 < JOINT_COUNT else None
            _add_link_shapes(link, end[n], next_axis, body.centre, sideways=n == 0)
        parent, origin = arm.links[n], end[n]
    _add_joint(robot, f"{arm.links[-1]}_joint", "fixed", parent, arm.links[-1], origin)
    SubElement(robot, "link", name=arm.links[-1])


def _add_joint(robot: Element, name: str, kind: str, parent: str, child: str, origin: Point) -> None:
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "origin", xyz=_numbers(*origin), rpy=_numbers(0.0, 0.0, 0.0))
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)


def _add_motion(joint: Element, arm: ArmDescription, n: int, axis: Point) -> None:
    limits = arm.limits
    SubElement(joint, "axis", xyz=_numbers(*axis))
    values = {
        "lower": limits.position_min[n],
        "upper": limits.position_max[n],
        "effort": limits.max_effort[n],
        "velocity": limits.max_velocity[n],
    }
    SubElement(joint, "limit", {name: _numbers(value) for name, value in values.items()})
    damping, friction = float(arm.damping[n]), float(arm.friction[n])
    if damping or friction:
        SubElement(joint, "dynamics", damping=_numbers(damping), friction=_numbers(friction))


def _add_inertia(link: Element, body: Body, length: float, sideways: bool) -> None:
    """Add the inertial element of a thin tube along the link, which points along y if `sideways` and along z if not."""
    along = body.mass * TUBE_RADIUS**2
    across = along / 2 + body.mass * length**2 / 12
    principal = (across, along, across) if sideways else (across, across, along)
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=_numbers(*body.centre), rpy=_numbers(0.0, 0.0, 0.0))
    SubElement(inertial, "mass", value=_numbers(body.mass))
    moments = dict(zip(("ixx", "iyy", "izz"), map(_numbers, principal), strict=True))
    SubElement(inertial, "inertia", {**moments, "ixy": "0.0", "ixz": "0.0", "iyz": "0.0"})


def _numbers(*values: float) -> str:
    """Return numbers as URDF writes them, with every digit, so that nothing is rounded."""
    return " ".join(repr(float(value) + 0.0) for value in values)  # + 0.0: no negative zero


def _add_material(robot: Element) -> None:
    """Add the colours."""
    for name, colour in COLOURS.items():
        SubElement(SubElement(robot, "material", name=name), "color", rgba=_numbers(*colour))


def _add_mesh(link: Element, folder: str) -> None:
    """Add the mesh LINK.stl in `folder`, an address, as the visual of `link`."""
    visual = SubElement(link, "visual")
    geometry = SubElement(visual, "geometry")
    SubElement(geometry, "mesh", filename=f"{folder.rstrip('/')}/{link.get('name')}.stl")


def _add_trunk_shapes(trunk: Element, shoulders: Sequence[Point]) -> None:
    """Add chest, head, and the motor of each joint 1, at `shoulders` (n, 3) m."""
    x, _, z = (sum(column) / len(shoulders) for column in zip(*shoulders, strict=True))
    _add(trunk, "person", "box", (x, 0.0, z - CHEST[2] / 2), size=_numbers(*CHEST))
    _add(trunk, "person", "sphere", (x, 0.0, z + HEAD_HEIGHT), radius=_numbers(HEAD_RADIUS))
    for shoulder in shoulders:
        _add_cylinder(trunk, "motor", shoulder, (0.0, 0.0, 1.0), MOTOR_RADIUS, MOTOR_LENGTH)


def _add_link_shapes(link: Element, end: Point, next_axis: Point | None, centre: Point, sideways: bool) -> None:
    """Add the tube to `end`, the motor of the next joint there if there is one, and the centre of gravity, m."""
    middle = (end[0] / 2, end[1] / 2, end[2] / 2)
    along = (0.0, 1.0, 0.0) if sideways else (0.0, 0.0, 1.0)
    if any(end):
        _add_cylinder(link, "tube", middle, along, TUBE, math.hypot(*end))
    if next_axis:
        _add_cylinder(link, "motor", end, next_axis, MOTOR_RADIUS, MOTOR_LENGTH)
    _add(link, "centre_of_gravity", "sphere", centre, radius=_numbers(COG_RADIUS))


def _add_cylinder(link: Element, material: str, centre: Point, axis: Point, radius: float, length: float) -> None:
    """Add a cylinder along `axis`, one of the frame's axes."""
    x, y, _ = map(abs, axis)
    turned = (y * math.pi / 2, x * math.pi / 2, 0.0)  # a cylinder of URDF lies along z
    _add(link, material, "cylinder", centre, turned, radius=_numbers(radius), length=_numbers(length))


def _add(
    link: Element, material: str, shape: str, centre: Point, turned: Point = (0.0, 0.0, 0.0), **dimensions: str
) -> None:
    visual = SubElement(link, "visual")
    SubElement(visual, "origin", xyz=_numbers(*centre), rpy=_numbers(*turned))
    SubElement(SubElement(visual, "geometry"), shape, dimensions)
    SubElement(visual, "material", name=material)
