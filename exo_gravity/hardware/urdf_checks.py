# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Checks of a URDF: missing numbers, placeholders, and joints that move besides those of the arm. See `FINDINGS`.

Many published descriptions were made for pictures and for planning: they have links without mass, equal masses on all
links, effort limits that no motor has, joints that follow another one, and joints that the arm does not drive. Each
changes the torque: what changes it by more than a few per cent is refused, the rest is noted.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from exo_gravity.core.errors import ParameterError

Found = Iterable[tuple[object, ...]]
SHAPES = ("visual", "collision")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)  # as urdfdom, Pinocchio and MuJoCo all read it
# How many numbers an attribute of a joint has, or of what a link's inertial has.
COUNTS = {"xyz": 3, "rpy": 3} | dict.fromkeys(
    ("value", "ixx", "iyy", "izz", "ixy", "ixz", "iyz", "lower", "upper", "effort", "velocity", "multiplier", "offset"),
    1,
)


@dataclass(frozen=True)
class UrdfLimits:
    """What a description may leave open."""

    share: float = 0.03  #: of the arm's largest torque, by which what is not known may change a torque
    poses: int = 100  #: that are tried
    gyration: float = 0.3  #: m, radius of gyration of a link about its own joint that no link of an arm has
    strong: float = 50.0  #: times gravity's largest torque: an effort limit that limits nothing, also of a worn arm
    least_mass: float = 0.05  #: kg for each joint, lighter than any motor
    most_mass: float = 40.0  #: kg, more than people can wear on an arm
    reach: float = 2.0  #: m, from the first joint to the centre of gravity that is farthest from it
    weak: float = 0.5  #: share of gravity's largest torque at the joint, which an effort limit must reach


LIMITS = UrdfLimits()


class Link(NamedTuple):
    """What a URDF says of a link; zeros where it says nothing."""

    name: str
    mass: float  #: kg
    cog: tuple[float, ...]  #: (3,) m
    inertia: tuple[float, ...]  #: ixx, iyy, izz, ixy, ixz, iyz in kg m^2
    is_drawn: bool  #: whether it has a shape
    joint: int  #: Pinocchio's number of the joint that moves it, 0 for none

    @property
    def ball(self) -> tuple[object, ...]:
        """Mass and inertia of a link that is a ball about its own origin, as placeholders are; () for any other."""
        xx, yy, zz, *products = self.inertia
        is_ball = self.mass > 0.0 and not any(self.cog) and xx == yy == zz and not any(products)
        return (self.mass, self.inertia) if is_ball else ()


class Finding(NamedTuple):
    """What is looked for in a URDF, and what is said of it.

    `look` takes the `robot` element, the `UrdfJoints`, or the `UrdfShape`, as the key of `FINDINGS` says.
    """

    look: Callable[[Any], Found]  #: yields for each that is found what fills `name`, its value, and what fills `said`
    name: str  #: of what is refused; '' of what is noted
    said: str  #: what the value must be; or the note, which all that is found fills


def robot_of(text: str) -> Element:
    """Return the `robot` element of a URDF. Raises ParameterError for what `FINDINGS` refuses in a text."""
    try:
        robot = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ParameterError("urdf", f"{text[:60].strip()} ...", f"well-formed XML ({error})") from None
    checked("text", robot)
    return robot


def links_of(root: Element, model: Any) -> Iterator[Link]:
    """Yield the links of a `robot`. model: Pinocchio's of the same URDF."""
    for link in root.findall("link"):
        name, inertial = link.get("name", ""), link.find("inertial")
        parts = {} if inertial is None else {part.tag: part.attrib for part in inertial}
        mass, cog = (parts.get(tag, {}).get(own, "0") for tag, own in (("mass", "value"), ("origin", "xyz")))
        products = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        inertia = tuple(float(parts.get("inertia", {}).get(own, "0")) for own in products)
        is_drawn = any(link.find(shape) is not None for shape in SHAPES)
        joint = carrier_of(model, name)[0] if model.existBodyName(name) else 0
        yield Link(name, float(mass), tuple(map(float, cog.split())), inertia, is_drawn, joint)


def carrier_of(model: Any, body: str) -> tuple[int, Any]:
    """Return the joint that carries a body of Pinocchio's `model`, by its number, and the body's place on it."""
    frame = model.frames[model.getBodyId(body)]
    joint = frame.parentJoint if hasattr(frame, "parentJoint") else frame.parent  # the latter until Pinocchio 3
    return joint, frame.placement


def checked(stage: str, thing: object) -> tuple[str, ...]:
    """Return the notes on `thing`. Raises ParameterError for the first of its findings that is refused."""
    notes = []
    for look, name, said in FINDINGS[stage]:
        for which, value, *more in look(thing):
            if name:
                raise ParameterError(name.format(which), value, said.format(*more))
            notes.append(said.format(which, value, *more))
    return tuple(notes)


def unused_efforts(arm: Any) -> Iterator[tuple[str, float, float]]:
    """Yield each effort limit that is far above what gravity needs, or far below: its joint, Nm, and what is needed."""
    peaks = arm.moves.peak.tolist()
    for name, effort, peak in zip(arm.names, arm.moves.efforts, peaks, strict=True):
        if effort and not LIMITS.weak * peak <= effort <= LIMITS.strong * max(peaks):
            yield name, effort, peak


def _other_format(robot: Element) -> Found:
    return [("", f"<{robot.tag}>")] if robot.tag != "robot" else ()


def _xacro(robot: Element) -> Found:
    return (("", part.tag) for part in robot.iter() if "xacro" in part.tag.partition("}")[0])


def _no_numbers(robot: Element) -> Found:
    for owner in (*robot.findall("link"), *robot.findall("joint")):
        for part in (*owner, *owner.findall("inertial/*")):
            for name, text in part.attrib.items():
                words, count = text.split(), COUNTS.get(name)
                if count and not (len(words) == count and all(map(NUMBER.fullmatch, words))):
                    expected = "3 finite numbers" if count > 1 else "a finite number"
                    yield f"{part.tag} {name} of the {owner.tag} {owner.get('name')}", text, expected


def _negative_masses(robot: Element) -> Found:
    for link in robot.findall("link"):
        masses = (float(mass.get("value", "0")) for mass in link.findall("inertial/mass"))
        yield from ((link.get("name"), mass) for mass in masses if mass < 0.0)


def mimics_of(robot: Element) -> dict[str, dict[str, str]]:
    """Return by the names of joints that follow another one which one they follow, and how."""
    joints = robot.findall("joint")
    return {joint.get("name", ""): mimic.attrib for joint in joints for mimic in joint.findall("mimic")}


def _circles(robot: Element) -> Found:
    leaders = {name: mimic.get("joint", "") for name, mimic in mimics_of(robot).items()}
    for name, leader in leaders.items():
        end = leader
        for _ in leaders:
            end = leaders.get(end, "")
        if end:  # after more steps than there are joints
            yield name, leader


def _two_joints(robot: Element) -> Found:
    return ((name, count) for name, count in Counter(child for _, child in _children(robot)).items() if count > 1)


def _children(robot: Element) -> Iterator[tuple[Element, str]]:
    """Yield each joint and its child."""
    return ((joint, child.get("link", "")) for joint in robot.findall("joint") for child in joint.findall("child"))


def _left_out(joints: Any) -> Found:
    left_out = [link.name for link in joints.links if not joints.model.existBodyName(link.name)]
    return [("", left_out)] if left_out else ()


def _followers(joints: Any) -> Found:
    return (("", name, joints.mimics[name].get("joint")) for name in joints.names if name in joints.mimics)


def _not_turning(joints: Any) -> Found:
    known = ", ".join(joints.turning) or "it has none"
    return (("", name, known) for name in joints.names if name not in joints.turning)


def _no_directions(joints: Any) -> Found:
    for joint in joints.root.findall("joint"):
        axis = joint.find("axis")
        if joint.get("name") in joints.names and axis is not None and not any(map(float, axis.get("xyz", "").split())):
            yield joint.get("name"), axis.get("xyz")


def _misread(joints: Any) -> Found:
    """Yield masses that urdfdom drops, as it does with an inertial that it cannot read: a tab, a blank, an entity."""
    for joint, moved in groupby(sorted(joints.links, key=lambda link: link.joint), key=lambda link: link.joint):
        names, masses = zip(*((link.name, link.mass) for link in moved), strict=True)
        read = joints.model.inertias[joint].mass
        if joint and not math.isclose(sum(masses), read, rel_tol=1e-6, abs_tol=1e-9):
            yield ", ".join(names), sum(masses), read


def _swapped_limits(joints: Any) -> Found:
    for name in (*joints.names, *joints.others):
        lower, upper = joints.limits(name)
        if lower > upper:
            yield name, [lower, upper]


def _mass(arm: Any) -> Found:
    mass, least = sum(link.mass for link in arm.moves.moved), LIMITS.least_mass * len(arm.names)
    if not least <= mass <= LIMITS.most_mass:
        yield "", float(f"{mass:.4g}"), least, LIMITS.most_mass


def _reach(arm: Any) -> Found:
    reach = sum(arm.length) + max(math.hypot(*link.cog) for link in arm.moves.moved)
    if not reach <= LIMITS.reach:
        yield "", float(f"{reach:.4g}"), LIMITS.reach


def _empty(arm: Any, of_arm: bool) -> Found:
    """Yield the links that have a shape and no mass: those that joints of the arm move themselves, or the others."""
    own = [child for joint, child in _children(arm.moves.root) if joint.get("name") in arm.names]
    empty = [link.name for link in arm.moves.moved if link.is_drawn and not link.mass and (link.name in own) == of_arm]
    return [("", ", ".join(empty))] if empty else ()


def _filled_in(arm: Any, is_much: bool) -> Found:
    """Yield the links whose masses look like placeholders, if they make much of the torque, or if they do not.

    They are balls about their joints, equal or impossibly large.
    """
    balls = [link for link in arm.moves.moved if link.ball]
    count = Counter(link.ball for link in balls)
    odd = {
        link.name: link.mass
        for link in balls
        if count[link.ball] > 1 or math.sqrt(link.inertia[0] / link.mass) > LIMITS.gyration
    }
    share = arm.moves.share_of(odd) if odd else 0.0
    if odd and (share > LIMITS.share) == is_much:
        yield ", ".join(odd), list(odd.values()), share


def _others(arm: Any) -> Found:
    if arm.moves.others:
        yield ", ".join(arm.moves.others), ""


FINDINGS = {
    "text": (
        Finding(_other_format, "urdf", "a URDF, whose outermost element is `robot` without a namespace"),
        Finding(_xacro, "urdf", "a URDF without xacro elements: run xacro first"),
        Finding(_no_numbers, "{}", "{}, as 1.2"),
        Finding(_negative_masses, "mass of the link {}", "0 kg or more"),
        Finding(_circles, "mimic of {}", "a joint that does not follow it in turn"),
        Finding(_two_joints, "joints that move {}", "1"),
    ),
    "joints": (
        Finding(_left_out, "links", "carried by the root link: these carry each other"),
        Finding(_followers, "joint_names", "{}, which that joint follows"),
        Finding(_not_turning, "joint_names", "turning joints of the URDF ({})"),
        Finding(_no_directions, "axis of {}", "a direction, as 0 1 0"),
        Finding(_misread, "mass of {}", "written so that Pinocchio reads it, as 1.2: it reads {:.4g} kg"),
        Finding(_swapped_limits, "limits of {}", "the lower one, then the upper one"),
    ),
    "arm": (
        Finding(_mass, "mass of the URDF's links",
                "{:.2g} to {:g} kg in all: it lacks inertial elements, or its masses are not in kg"),
        Finding(_reach, "reach of the URDF's links", "at most {:g} m: are its lengths in m?"),
        Finding(partial(_empty, of_arm=True), "link",
                "with a mass, because the URDF gives it a shape: without it the torque would be too small"),
        Finding(partial(_empty, of_arm=False), "", "these moving links have a shape and no mass: {1}"),
        Finding(partial(_filled_in, is_much=True), "mass of {}",
                "measured or computed: equal masses with their centres of gravity in the joints are placeholders, and "
                "they make {:.0%} of the torque"),
        Finding(partial(_filled_in, is_much=False), "",
                "the masses of these links look like placeholders, {2:.1%} of the torque: {0}"),
        Finding(unused_efforts, "", "the effort limit of {}, {:g} Nm, is not used: gravity needs up to {:.3g} Nm"),
        Finding(_others, "",
                "{} change the torque and are not in joint_names: at 0, unless the joint states have them"),
    ),
}  # fmt: skip
