# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The robot description (URDF) of one arm or of both, and what a viewer shows around the arms.

Every frame has the trunk's axes (REP-103: x forward, y left, z up) while the arm hangs at theta = 0. So the origins of
the joints are plain offsets, and the description needs no rotations: they and the axes are those of the hanging arm,
link 1 sideways and links 2 to 4 down. The right arm is the mirror image, so positive angles are abduction and flexion
on both sides. It is made from the same values as the control law; the gain c_n is no part of it, and neither is
gravity.

Around the arms are gravity, the torque and the limits of each joint, and the state of each arm. Every shape is given in
the trunk's axes, so that a viewer needs no transforms for it. A joint's range is an arc around its axis, and its torque
a second, smaller arc, which spans `SIZES.torque_span` at the joint's torque limit.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.compensation.settings import robot_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import JOINT_COUNT, Vector
from exo_gravity.core.params import Param
from exo_gravity.core.safety.command import CARRYING, State
from exo_gravity.core.safety.limits import WALL, Limits, limits_of
from exo_gravity.hardware.urdf_arm import UrdfArm, arm_in_file

Point = tuple[float, ...]  # (3,)

ROOT = "trunk"
NO_TURN = (0.0, 0.0, 0.0)  # rad
HALF_BREADTH = 0.15  # m from the middle of the trunk to the axis of joint 1, if `shoulder` is not given
# The parameters of `robot_model`.
# fmt: off
ROBOT_MODEL = (
    Param("rate", 30.0, "joint states of all arms per second", (1.0, 100.0), "Hz", fixed=True),
    Param("meshes", "", "address of a folder with LINK.stl for each link, as package://NAME/FOLDER; empty: tubes",
          fixed=True),
)
# fmt: on
COLOURS = {
    "person": (0.80, 0.76, 0.70, 0.6),
    "tube": (0.16, 0.17, 0.19, 1.0),
    "motor": (0.55, 0.58, 0.62, 1.0),
    "centre_of_gravity": (0.85, 0.25, 0.15, 1.0),
}
TUBE_RADIUS = 0.03  # m; each link has the inertia of a thin tube
DRAWN_RADIUS = 0.0125  # m, of the carbon tubes (the paper, appendix A)
MOTOR: dict[str, Any] = {"radius": 0.042, "length": 0.04}  # m, between AK60-6 and AK80-9
COG_RADIUS = 0.018  # m
LEAST_MASS = 1e-3  # kg, of a link that has none in its URDF
CHEST, HEAD_RADIUS, HEAD_HEIGHT = (0.14, 0.26, 0.48), 0.10, 0.20  # m

Colour = tuple[float, float, float, float]

ARROW, LINE, TEXT, SPHERE = "arrow", "line", "text", "sphere"
GREEN, AMBER, RED = (0.20, 0.70, 0.30, 1.0), (0.95, 0.65, 0.10, 1.0), (0.85, 0.15, 0.15, 1.0)
GREY, BLUE = (0.60, 0.60, 0.60, 1.0), (0.20, 0.45, 0.85, 1.0)


@dataclass(frozen=True, eq=False)
class OnTrunk:
    """The paper's arm on a trunk, in the trunk's axes, as `UrdfArm` is."""

    side: str  #: 'left' or 'right'
    robot: ArmModel  #: without a wearer
    mass: Vector  #: (4,) kg, used if `robot` is given by its moments
    shoulder: Vector = (0.0, 0.0, 0.0)  #: (3,) m, the arm's base in the trunk's axes; zeros for unknown

    @property
    def outward(self) -> float:
        """1 if the arm is on the trunk's +y side (left), -1 otherwise."""
        return 1.0 if self.side == "left" else -1.0

    def pose(self, theta: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where the arm is at `theta` (4,) rad, as `Described.pose`."""
        frames = self.robot.frames(np.array([theta]))
        base = self.shoulder if any(self.shoulder) else (0.0, self.outward * HALF_BREADTH, 0.0)
        axes = self._in_trunk(frames.before[0, :, :, 2]) * self.outward  # a mirror reverses rotations
        return self._in_trunk(frames.places[0]) + base, axes, self._in_trunk(frames.after[0, :, :, 0])

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mass (4,) kg and centre of gravity (4, 3) m of each link, as `UrdfArm.bodies`.

        Moments across the links (core/arm/paper.py) become offsets of the centres of gravity: W of link 1, Z of link
        2, Y3 and Y4 of links 3 and 4. An arm given by its moments has the masses `mass`, and its centres of gravity,
        also beyond the links, follow from the moments.
        """
        robot = self.robot
        mass = np.array(self.mass if robot.by_moments else robot.mass)
        if not np.all(mass > 0.0):
            raise ParameterError("robot.mass", mass.tolist(), "above 0 kg for each link of a robot description")
        along = robot.cog
        if robot.by_moments:
            carried = [sum(mass[n + 1 :]) for n in range(JOINT_COUNT)]
            along = (robot.first_moment - robot.length * carried) / mass
        a1, a2, a3, a4 = along.tolist()
        w, z, y3, y4 = (robot.off_axis / mass).tolist()
        out = self.outward
        return mass, np.array(((w, out * a1, 0.0), (0.0, -out * z, -a2), (y3, 0.0, -a3), (y4, 0.0, -a4)))

    def _in_trunk(self, points: np.ndarray) -> np.ndarray:
        """Return vectors (n, 3) of the arm's base frame in the trunk's axes: x0 outward, y0 forward, z0 down."""
        x, y, z = points.T
        return np.stack((y, self.outward * x, -z), axis=1)


def _urdf_pose(arm: UrdfArm, theta: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where an arm from a URDF is at `theta` (n,) rad, as `Described.pose`."""
    frames, axes = arm.frames(np.array([theta])), arm.turns[:, 0]
    along = arm.directions - axes * np.einsum("na,na->n", axes, arm.directions)[:, None]
    size = np.linalg.norm(along, axis=1)[:, None]
    across = np.divide(along, size, out=arm.turns[:, 1].copy(), where=size > 1e-3)  # else along its axis
    return frames.places[0], *(np.einsum("nab,nb->na", frames.after[0], ways) for ways in (axes, across))


@dataclass(frozen=True, eq=False)
class Described:
    """What a description, and a picture, states about one arm of n joints."""

    side: str  #: 'left' or 'right'
    #: where the arm is at theta (n,) rad, in the trunk's axes: the origins (n + 1, 3) in m of the joints and the far
    #: end, the axes (n, 3) about which the joints turn, and unit vectors (n, 3) along the links, as far as these are
    #: across the axes
    pose: Callable[[Sequence[float]], tuple[np.ndarray, np.ndarray, np.ndarray]]
    #: mass (n,) in kg and centre of gravity (n, 3) in m of each link, from its joint, in the same axes, while all
    #: angles are 0; raises ParameterError if a link of the paper's arm has no mass
    bodies: Callable[[], tuple[np.ndarray, np.ndarray]]
    limits: Limits  #: names, position, speed and torque limits of the joints
    damping: Vector = (0.0,) * JOINT_COUNT  #: (n,) Nm s/rad, 0 for unknown
    friction: Vector = (0.0,) * JOINT_COUNT  #: (n,) Nm, 0 for unknown

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links (n,), and of the frame at the far end of the last one."""
        count = len(self.limits.joint_names)
        return (*(f"{self.side}_link_{n}" for n in range(1, count + 1)), f"{self.side}_end")

    @property
    def base(self) -> Point:
        """Origin of joint 1 in the trunk's axes, m."""
        return tuple(self.pose([0.0] * len(self.limits.joint_names))[0][0].tolist())


def described(compensator: Mapping[str, Any], can_bridge: Mapping[str, Any]) -> Described:
    """Return the arm that the parameters of its two nodes describe, or raise ParameterError."""
    limits, friction = limits_of(can_bridge), (compensator["friction.viscous"], compensator["friction.coulomb"])
    if arm := arm_in_file(compensator, ", for a picture: the URDF on a topic is one already"):
        pose = partial(_urdf_pose, arm)
        shoulder = pose([0.0] * len(arm.names))[0][0]
        return Described("left" if shoulder[1] > 0.0 else "right", pose, arm.bodies, limits, *friction)
    side, mass, shoulder = (compensator[name] for name in ("side", "robot.mass", "shoulder_from_imu"))
    on_trunk = OnTrunk(side, robot_of(compensator), mass, shoulder)
    return Described(side, on_trunk.pose, on_trunk.bodies, limits, *friction)


def urdf(arms: Sequence[Described], meshes: str = "") -> str:
    """Return the URDF of one arm a side, with the root link `trunk`.

    meshes: address of a folder (package:// or file://) with LINK.stl for every link, each in the frame of its joint and
    in m; '' draws tubes and motors.

    Raises ParameterError if two arms are on one side, or a link has no mass.
    """
    sides = [arm.side for arm in arms]
    if not arms or len(set(sides)) != len(sides):
        raise ParameterError("side", sides, "one arm for each side that is described")
    x, _, z = (sum(column) / len(arms) for column in zip(*(arm.base for arm in arms), strict=True))
    person = (
        _visual("person", "box", (x, 0.0, z - CHEST[2] / 2), size=CHEST),
        _visual("person", "sphere", (x, 0.0, z + HEAD_HEIGHT), radius=HEAD_RADIUS),
    )
    trunk = _link(ROOT, meshes, *person, *(_visual("motor", "cylinder", arm.base, **MOTOR) for arm in arms))
    materials = (_element("material", _element("color", rgba=rgba), name=name) for name, rgba in COLOURS.items())
    parts = (_arm(arm, names, meshes) for arm, names in zip(arms, joint_names(arms), strict=True))
    robot = _element("robot", *materials, trunk, *(part for arm in parts for part in arm), name="exo_gravity")
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def joint_names(arms: Sequence[Described]) -> list[tuple[str, ...]]:
    """Return the joint names of each arm; with the side in front if the arms share a name."""
    names = [arm.limits.joint_names for arm in arms]
    if len({name for own in names for name in own}) == sum(map(len, names)):
        return names
    return [tuple(f"{arm.side}_{name}" for name in own) for arm, own in zip(arms, names, strict=True)]


def _arm(arm: Described, names: Sequence[str], meshes: str) -> Iterator[Element]:
    """Yield the joints and links of one arm."""
    limits = arm.limits
    origins, axes, _ = arm.pose((0.0,) * len(names))
    vectors = np.diff(origins, axis=0).round(12)  # from each joint to the next
    parent, origin = ROOT, arm.base
    for n, (mass, place) in enumerate(zip(*arm.bodies(), strict=True)):
        centre = tuple(place.tolist())
        end, length = tuple(vectors[n].tolist()), float(np.linalg.norm(vectors[n]))
        lower, upper = limits.position_min[n], limits.position_max[n]
        largest = {"effort": limits.max_effort[n], "velocity": limits.max_velocity[n]}
        moving = [_element("axis", xyz=axes[n]), _element("limit", lower=lower, upper=upper, **largest)]
        if arm.damping[n] or arm.friction[n]:
            moving.append(_element("dynamics", damping=arm.damping[n], friction=arm.friction[n]))
        yield _joint(names[n], "revolute", parent, arm.links[n], origin, *moving)
        drawn = []
        if length:
            middle, along = tuple((vectors[n] / 2).tolist()), vectors[n] / length
            drawn.append(_visual("tube", "cylinder", middle, along, radius=DRAWN_RADIUS, length=length))
        if n + 1 < len(names):
            drawn.append(_visual("motor", "cylinder", end, axes[n + 1], **MOTOR))
        drawn.append(_visual("centre_of_gravity", "sphere", centre, radius=COG_RADIUS))
        is_sideways = abs(vectors[n][1]) > abs(vectors[n][2])
        yield _link(arm.links[n], meshes, *drawn, inertial=_tube(max(mass, LEAST_MASS), centre, length, is_sideways))
        parent, origin = arm.links[n], end
    yield _joint(f"{arm.links[-1]}_joint", "fixed", parent, arm.links[-1], origin)
    yield _element("link", name=arm.links[-1])


def _joint(name: str, kind: str, parent: str, child: str, origin: Point, *moving: Element) -> Element:
    ends = _element("parent", link=parent), _element("child", link=child)
    return _element("joint", _element("origin", xyz=origin, rpy=NO_TURN), *ends, *moving, name=name, type=kind)


def _tube(mass: float, centre: Point, length: float, sideways: bool) -> Element:
    """Return the inertial element of a thin tube, which points along y if `sideways` and along z if not."""
    along = mass * TUBE_RADIUS**2
    across = along / 2 + mass * length**2 / 12
    iyy, izz = (along, across) if sideways else (across, along)
    inertia = _element("inertia", ixx=across, iyy=iyy, izz=izz, ixy=0.0, ixz=0.0, iyz=0.0)
    return _element("inertial", _element("origin", xyz=centre, rpy=NO_TURN), _element("mass", value=mass), inertia)


def _link(name: str, meshes: str, *drawn: Element, inertial: Element | None = None) -> Element:
    """Return a link that shows the mesh NAME.stl in the folder `meshes`, an address, or without one what is `drawn`."""
    if meshes:
        mesh = _element("mesh", filename=f"{meshes.rstrip('/')}/{name}.stl")
        drawn = (_element("visual", _element("geometry", mesh)),)
    return _element("link", *([] if inertial is None else [inertial]), *drawn, name=name)


def _visual(material: str, shape: str, centre: Point, axis: Vector = (0.0, 0.0, 1.0), **size: float | Point) -> Element:
    """Return a shape; axis: one of the frame's axes, of a cylinder, which in URDF lies along z."""
    turn = (abs(axis[1]) * math.pi / 2, abs(axis[0]) * math.pi / 2, 0.0)
    geometry = _element("geometry", _element(shape, **size))
    return _element("visual", _element("origin", xyz=centre, rpy=turn), geometry, _element("material", name=material))


def _element(tag: str, *children: Element, **attributes: str | float | Sequence[float]) -> Element:
    """Return an element. Numbers are written with every digit, so that nothing is rounded."""
    element = Element(tag)
    for name, value in attributes.items():
        numbers = (value,) if isinstance(value, float | int) else value
        # + 0.0: no negative zero
        element.set(name, value if isinstance(value, str) else " ".join(repr(float(x) + 0.0) for x in numbers))
    element.extend(children)
    return element


@dataclass(frozen=True)
class Sizes:
    """How large each shape is."""

    range_radius: float = 0.11  #: m
    torque_radius: float = 0.075  #: m
    torque_span: float = math.radians(270.0)  #: rad, of the arc of a joint at its torque limit
    arc_step: float = math.radians(6.0)  #: rad between two points of an arc
    gravity_from: tuple[float, float, float] = (0.30, 0.0, 0.10)  #: m, in front of the chest
    gravity_length: float = 0.25  #: m
    state_height: float = 0.20  #: m above the shoulder
    limit_width: float = 0.004  #: m
    torque_width: float = 0.016  #: m
    arrow_width: float = 0.012  #: m
    text_height: float = 0.035  #: m
    sphere_size: float = 0.05  #: m, diameter


SIZES = Sizes()


RESTING = 0.05  # rad/s, below which a carried arm is held; twice the step of the motors' speed


class Shape(NamedTuple):
    """One thing to draw.

    group: 'gravity', 'torques', 'limits' or 'states'.
    kind: ARROW from the first point to the second, LINE through the points, TEXT or SPHERE at the first point.
    points: (n, 3) m.
    size: m, width of a line, height of a text, diameter.
    """

    group: str
    kind: str
    points: np.ndarray
    size: float
    colour: Colour
    text: str = ""


class ArmView(NamedTuple):
    """What is known of one arm now."""

    arm: Described
    theta: Sequence[float]  #: (n,) rad
    velocity: Sequence[float]  #: (n,) rad/s
    effort: Sequence[float]  #: (n,) Nm, as the motors report it
    state: str  #: of its bridge, '' if not known
    message: str = ""  #: of its bridge


def gravity_shapes(gravity: Vector | None) -> list[Shape]:
    """Return the arrow of gravity for its unit vector (3,) in the trunk's axes; None: the tilt is not known."""
    if gravity is None:
        return [Shape("gravity", TEXT, np.array([SIZES.gravity_from]), SIZES.text_height, RED, "no tilt")]
    points = np.array((SIZES.gravity_from, np.add(SIZES.gravity_from, np.multiply(SIZES.gravity_length, gravity))))
    return [Shape("gravity", ARROW, points, SIZES.arrow_width, BLUE)]


def arm_shapes(view: ArmView) -> list[Shape]:
    """Return what is drawn around one arm: range and torque of each joint, and what the arm's bridge does."""
    limits, shapes = view.arm.limits, []
    for n, (origin, axis, along) in enumerate(zip(*view.arm.pose(view.theta), strict=False)):
        low, high = limits.position_min[n] - view.theta[n], limits.position_max[n] - view.theta[n]
        colour = GREY if low + WALL.width <= 0.0 <= high - WALL.width else RED
        tip = origin + SIZES.range_radius * along
        shapes.append(
            Shape("limits", LINE, _arc(origin, axis, along, low, high, SIZES.range_radius), SIZES.limit_width, colour)
        )
        shapes.append(Shape("limits", LINE, np.array((origin, tip)), SIZES.limit_width, colour))
        effort, limit = view.effort[n], limits.max_effort[n]
        share = max(-1.0, min(1.0, effort / limit)) if limit > 0.0 else 0.0
        arc = _arc(origin, axis, along, 0.0, share * SIZES.torque_span, SIZES.torque_radius)
        strength = RED if abs(share) >= 1.0 else AMBER if abs(share) > 0.5 else GREEN
        shapes.append(Shape("torques", LINE, arc, SIZES.torque_width, strength))
        shapes.append(
            Shape("torques", TEXT, tip[None], SIZES.text_height, strength, f"{round(effort, 2) + 0.0:.2f} Nm")
        )
    colour, state = state_of(view)
    above = np.add([view.arm.base], (0.0, 0.0, SIZES.state_height))
    shapes.append(Shape("states", SPHERE, above, SIZES.sphere_size, colour))
    over = np.add(above, (0.0, 0.0, SIZES.sphere_size))
    return [*shapes, Shape("states", TEXT, over, SIZES.text_height, colour, f"{view.arm.side}: {state}")]


def state_of(view: ArmView) -> tuple[Colour, str]:
    """Return the colour and the words for what the arm's bridge does: 'active, holding' or the latched fault."""
    if view.state == State.ACTIVE.value:
        return GREEN, "active, holding" if max(map(abs, view.velocity)) < RESTING else "active, moving"
    if view.state == State.FAULT.value:
        return RED, view.message or view.state
    powered = view.state in {state.value for state in (*CARRYING, State.LETTING_DOWN)}
    return (AMBER if powered else GREY), view.state or view.message or "no state"


def _arc(
    origin: np.ndarray, axis: np.ndarray, along: np.ndarray, start: float, end: float, radius: float
) -> np.ndarray:
    """Return points (n, 3) on the arc around `axis` from angle `start` to `end` in rad from the direction `along`."""
    angles = np.linspace(start, end, 2 + int(abs(end - start) / SIZES.arc_step))[:, None]
    return np.asarray(origin + radius * (np.cos(angles) * along + np.sin(angles) * np.cross(axis, along)))
