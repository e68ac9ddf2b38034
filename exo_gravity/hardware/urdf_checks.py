# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a URDF leaves out or only fills in, and what moves in it besides the joints of the arm.

Many published descriptions were made for pictures and for planning: they have links without mass, equal masses on all
links, effort limits that no motor has, joints that follow another one, and joints that the arm does not drive. Each
changes the torque. How much is tried in random poses under random tilts: what changes it by more than a few per cent is
refused, or must come with the joint states; the rest is named in `notes`.
"""

import copy
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from exo_gravity.core.arm.arm_data import STANDARD_GRAVITY
from exo_gravity.core.errors import ParameterError

Pinocchio = Any  # the module, and its models: it has no type hints
TURNING = "JointModelR"  # how Pinocchio's names of revolute and continuous joints begin
SHAPES = ("visual", "collision")
LARGEST = 1e3  # rad or m, of a limit that is none
TINY = 1e-12  # Nm
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)  # as urdfdom, Pinocchio and MuJoCo all read it
# Attributes of a joint, or of what a link's inertial has, with one number each; xyz and rpy have three.
SINGLE = (
    "value", "ixx", "iyy", "izz", "ixy", "ixz", "iyz", "lower", "upper", "effort", "velocity", "multiplier", "offset",
)  # fmt: skip


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


class Mimic(NamedTuple):
    """A joint that follows another one: its position is multiplier times that of `joint`, plus offset."""

    joint: str
    multiplier: float
    offset: float


class Other(NamedTuple):
    """A joint that is not the arm's, and that changes its torque."""

    name: str
    lower: float  #: rad or m
    upper: float

    @property
    def can_be_at_zero(self) -> bool:
        """Whether 0 is within its limits: there it is taken to be as long as no position is reported."""
        return self.lower <= 0.0 <= self.upper


def robot_of(text: str) -> Element:
    """Return the `robot` element of a URDF.

    Raises ParameterError for other texts, where xacro has not run, and for a text in place of a number.
    """
    try:
        robot = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ParameterError("urdf", f"{text[:60].strip()} ...", f"well-formed XML ({error})") from None
    if robot.tag != "robot":
        raise ParameterError("urdf", f"<{robot.tag}>", "a URDF, whose outermost element is `robot` without a namespace")
    if left := next((element.tag for element in robot.iter() if "xacro" in element.tag.partition("}")[0]), ""):
        raise ParameterError("urdf", left, "a URDF without xacro elements: run xacro first")
    for owner in (*robot.findall("link"), *robot.findall("joint")):
        for part in (*owner, *owner.findall("inertial/*")):
            for name, text in part.attrib.items():
                words, count = text.split(), 3 if name in ("xyz", "rpy") else int(name in SINGLE)
                if count and not (len(words) == count and all(map(NUMBER.fullmatch, words))):
                    what = f"{part.tag} {name} of the {owner.tag} {owner.get('name')}"
                    raise ParameterError(what, text, f"{'3 finite numbers' * (count > 1) or 'a finite number'}, as 1.2")
    return robot


def _check_axes(robot: Element, names: Sequence[str]) -> None:
    """Raise ParameterError if the axis of a joint of the arm has no direction: its torque would be 0."""
    for joint in robot.iter("joint"):
        axis = joint.find("axis")
        if joint.get("name") in names and axis is not None and not any(map(float, axis.get("xyz", "1").split())):
            raise ParameterError(f"axis of {joint.get('name')}", axis.get("xyz"), "a direction, as 0 1 0")


class UrdfJoints:
    """How the joints of a URDF move: the arm's by themselves, mimic joints with them, others as is reported.

    pin: the module pinocchio. text: of the URDF. joint_names: (n,) of the arm. Raises ParameterError if the text is not
    a URDF, or if a joint is not in it, does not turn, or follows another one.

    model: of Pinocchio, with the joints alone that move. Its velocities (nv,) follow from the arm's (n,) by `spread`,
    and torques (n,) of the arm from those of its joints by `folded`.
    """

    def __init__(self, pin: Pinocchio, text: str, joint_names: Sequence[str]) -> None:
        self.root = robot_of(text)  #: the `robot` element
        try:
            self.model = pin.buildModelFromXML(text)
        except (RuntimeError, ValueError) as error:
            expected = f"a URDF that Pinocchio reads: the lines above say more ({error})"
            raise ParameterError("urdf", f"{text[:60].strip()} ...", expected) from None
        self.inertials = read_inertials(self.root, self.model)  #: of each link, by its name
        self._pin = pin
        self.names = tuple(joint_names)
        self._mimics = dict(_mimics(self.root))
        movable = {self.model.names[n]: joint for n, joint in enumerate(self.model.joints) if n and joint.nv == 1}
        turning = [name for name, joint in movable.items() if joint.shortname().startswith(TURNING)]
        for name in self.names:
            if name in self._mimics:
                raise ParameterError("joint_names", name, f"{self._mimics[name].joint}, which that joint follows")
            if name not in turning:
                expected = f"turning joints of the URDF ({', '.join(turning) or 'it has none'})"
                raise ParameterError("joint_names", name, expected)
        _check_axes(self.root, self.names)
        self._leaders = {name: self._leader(name) for name in movable}
        free = sorted({leader.joint for leader in self._leaders.values() if leader.joint in movable} - set(self.names))
        self._reported: set[str] = set()
        self.others = [self._limits(name) for name in free]  #: joints that are not the arm's and change its torque
        self._couple()
        self.peak, effects = self._tried()  #: (n,) Nm, the largest torque that gravity needs in any pose and tilt
        self._lock([other for other, effect in zip(self.others, effects, strict=True) if effect > LIMITS.share])

    def of(self, text: str) -> "UrdfJoints":
        """Return the same joints in the URDF `text`."""
        return UrdfJoints(self._pin, text, self.names)

    def configuration(self, theta: Sequence[float]) -> np.ndarray:
        """Return Pinocchio's configuration (nq,) for the angles `theta` (n,) in rad.

        Raises ParameterError while a joint that cannot be at 0 is not reported.
        """
        self._check_others()
        return self._configuration_at(self._own @ np.asarray(theta) + self._still)

    def configurations(self, theta: np.ndarray) -> Iterator[np.ndarray]:
        """Yield Pinocchio's configuration (nq,) for each row of `theta` (m, n) in rad. Raises likewise."""
        self._check_others()
        return map(self._configuration_at, theta @ self._own.T + self._still)

    def spread(self, values: Sequence[float]) -> np.ndarray:
        """Return the velocities or accelerations (nv,) of the model for the arm's (n,)."""
        return np.asarray(self._own @ np.asarray(values))

    def folded(self, torque: np.ndarray) -> np.ndarray:
        """Return the torque (n,) in Nm of the arm's joints for that of all joints of the model, (nv,).

        Also (n, m) for (nv, m).
        """
        return np.asarray(self._own.T @ torque)

    def folded_matrix(self, matrix: np.ndarray) -> np.ndarray:
        """Return the mass matrix (n, n) of the arm for that of the model, (nv, nv)."""
        return np.asarray(self._own.T @ matrix @ self._own)

    def follow(self, names: Sequence[str], positions: Sequence[float]) -> None:
        """Take the positions (m,) of all joints that are reported, by their names (m,).

        Raises ParameterError if one that changes the torque is not finite, or is missing although it was reported
        before or cannot be at 0.
        """
        at, reported = self._at.copy(), set()
        for number, other in enumerate(self.others):
            if other.name not in names:
                if other.name in self._reported or not other.can_be_at_zero:
                    raise _missing(other)
                continue
            position = float(positions[list(names).index(other.name)])
            if not math.isfinite(position):
                raise ParameterError(f"position of {other.name}", position, "finite: the arm's torque depends on it")
            at[number] = position
            reported.add(other.name)
        if reported:
            self._reported |= reported
            self._hold_others(at)

    def limits(self, name: str) -> tuple[float, float]:
        """Return the lowest and the highest angle of an arm's joint in rad; a continuous one may be anywhere."""
        own = self._limits(name)
        return own.lower, own.upper

    @property
    def fixed(self) -> tuple[str, ...]:
        """The other joints that are taken to be at 0, because none is reported."""
        return tuple(other.name for other in self.others if other.name not in self._reported)

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence on the other joints, for the log."""
        if not self.others:
            return ()
        names = ", ".join(other.name for other in self.others)
        return (f"{names} change the torque and are not in joint_names: at 0, unless the joint states have them",)

    def _check_others(self) -> None:
        for other in self.others:
            if not other.can_be_at_zero and other.name not in self._reported:
                raise _missing(other)

    def _couple(self) -> None:
        """Find how the joints of the model follow the arm's and the others."""
        model, order = self.model, [*self.names, *(other.name for other in self.others)]
        coupling, self._offset = np.zeros((model.nv, len(order))), np.zeros(model.nv)
        for number, name in enumerate(model.names):
            if number and name in self._leaders:
                leader, multiplier, self._offset[model.joints[number].idx_v] = self._leaders[name]
                if leader in order:
                    coupling[model.joints[number].idx_v, order.index(leader)] = multiplier
        self._coupling, self._own = coupling, coupling[:, : len(self.names)]
        self._neutral, self._data = self._pin.neutral(model), model.createData()
        self._hold_others(np.array([min(max(0.0, other.lower), other.upper) for other in self.others]))

    def _hold_others(self, at: np.ndarray) -> None:
        """Take the positions `at` of the other joints, and compute once what they add to those of the model, (nv,)."""
        self._at, self._still = at, self._coupling[:, len(self.names) :] @ at + self._offset

    def _lock(self, others: list[Other]) -> None:
        """Keep the arm's joints, `others`, and what follows them; lock all other joints of the model."""
        kept = {*self.names, *(other.name for other in others)}
        names = enumerate(self.model.names)
        locked = [n for n, name in names if n and (name not in self._leaders or self._leaders[name].joint not in kept)]
        if locked:
            try:
                self.model = self._pin.buildReducedModel(self.model, locked, self._configuration_at(self._still))
            except ValueError as error:  # Pinocchio looks frames up by name alone
                twice = ", ".join(sorted({name for name in self.model.names if name in self.inertials}))
                raise ParameterError("joints of the URDF", twice, f"named otherwise than its links ({error})") from None
        self.others = others
        self._couple()

    def _configuration_at(self, positions: np.ndarray) -> np.ndarray:
        """Return the configuration (nq,) for the positions of the model's joints, (nv,)."""
        if self.model.nq == self.model.nv:  # no continuous joint, which has two numbers in a configuration
            return positions
        return np.asarray(self._pin.integrate(self.model, self._neutral, positions))

    def _torque(self, positions: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        self.model.gravity.linear = gravity
        at = self._configuration_at(self._coupling @ positions + self._offset)
        return self.folded(self._pin.computeGeneralizedGravity(self.model, self._data, at))

    def _tried(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest torque (n,) in Nm in random poses, and each other joint's effect as a share of it."""
        count = len(self.names)
        ranges = [*map(self._limits, self.names), *self.others]
        low, high = np.array([(each.lower, each.upper) for each in ranges]).T
        peak, effects = np.zeros(count), np.zeros(len(self.others))
        for positions, gravity in random_poses(low, high):
            torque = self._torque(positions, gravity)
            peak = np.maximum(peak, np.abs(torque))
            for k, position in enumerate(self._at.tolist()):
                moved = positions.copy()
                moved[count + k] = position
                effects[k] = max(effects[k], float(np.max(np.abs(self._torque(moved, gravity) - torque))))
        return peak, effects / max(float(np.max(peak)), TINY)

    def _leader(self, name: str) -> Mimic:
        """Return how a joint follows the one that moves by itself; raises ParameterError if they go in a circle."""
        leader, seen = Mimic(name, 1.0, 0.0), {name}
        while leader.joint in self._mimics:
            joint, multiplier, offset = self._mimics[leader.joint]
            if joint in seen:
                raise ParameterError(f"mimic of {name}", joint, "a joint that does not follow it in turn")
            seen.add(joint)
            leader = Mimic(joint, leader.multiplier * multiplier, leader.multiplier * offset + leader.offset)
        return leader

    def _limits(self, name: str) -> Other:
        """Return a joint of the model with its limits; a continuous one may be anywhere."""
        joint = self.model.joints[self.model.getJointId(name)]
        if joint.nq != 1:
            return Other(name, -math.pi, math.pi)
        limits = self.model.lowerPositionLimit, self.model.upperPositionLimit
        lower, upper = (float(limit[joint.idx_q]) for limit in limits)
        if lower > upper:
            raise ParameterError(f"limits of {name}", [lower, upper], "the lower one, then the upper one")
        return Other(name, max(lower, -LARGEST), min(upper, LARGEST))


def random_poses(low: np.ndarray, high: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield positions (n,) between `low` and `high` (n,), each with gravity (3,) m/s^2 in some direction."""
    random = np.random.default_rng(0)
    for _ in range(LIMITS.poses):
        gravity = random.normal(size=3)
        yield random.uniform(low, high), STANDARD_GRAVITY * gravity / np.linalg.norm(gravity)


def usable_efforts(joints: UrdfJoints) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Return the effort limits (n,) in Nm of the arm's joints, 0 where there is none or only a placeholder.

    And a sentence for each placeholder: a limit far above what gravity needs, or far below.
    """
    efforts, notes = [], []
    for name, peak in zip(joints.names, joints.peak.tolist(), strict=True):
        joint = joints.model.joints[joints.model.getJointId(name)]
        effort = float(joints.model.effortLimit[joint.idx_v])
        if not 0.0 < effort < math.inf:
            effort = 0.0
        elif effort > LIMITS.strong * joints.peak.max() or effort < LIMITS.weak * peak:
            notes.append(f"the effort limit of {name}, {effort:g} Nm, is not used: gravity needs up to {peak:.3g} Nm")
            effort = 0.0
        efforts.append(effort)
    return tuple(efforts), tuple(notes)


class Inertial(NamedTuple):
    """What a URDF says of a link's mass. mass: kg. cog: (3,) m. inertia: ixx, iyy, izz, ixy, ixz, iyz in kg m^2."""

    mass: float
    cog: tuple[float, ...]
    inertia: tuple[float, ...]

    @property
    def is_round(self) -> bool:
        """Whether it is a ball about the origin of its link, as a placeholder is."""
        xx, yy, zz, *products = self.inertia
        return self.mass > 0.0 and not any(self.cog) and xx == yy == zz and not any(products)


def check_size(joints: UrdfJoints, mass: float, length: Sequence[float]) -> None:
    """Raise ParameterError for what is no arm: its URDF is in other units, as CAD exports them, or lacks masses.

    mass: kg that `joints` move. length: (n,) m of its links.
    """
    least, most = LIMITS.least_mass * len(length), LIMITS.most_mass
    if not least <= mass <= most:
        expected = f"{least:.2g} to {most:g} kg in all: it lacks inertial elements, or its masses are not in kg"
        raise ParameterError("mass of the URDF's links", float(f"{mass:.4g}"), expected)
    moved = dict(_moved(joints.root, joints.names))
    reach = sum(length) + max(math.hypot(*joints.inertials[link].cog) for link in moved)
    if not reach <= LIMITS.reach:
        expected = f"at most {LIMITS.reach:g} m: are its lengths in m?"
        raise ParameterError("reach of the URDF's links", float(f"{reach:.4g}"), expected)


def check_masses(joints: UrdfJoints) -> tuple[str, ...]:
    """Return a sentence for each doubt about the masses that the arm moves.

    Raises ParameterError if a link of the arm's joints has a shape and no mass, or if masses that are only filled in
    make more than a few per cent of the torque.
    """
    moved = dict(_moved(joints.root, joints.names))  # by link: the joint before it
    links = {link.get("name", ""): link for link in joints.root.iter("link")}
    inertials = joints.inertials
    empty = [name for name in moved if not inertials[name].mass and any(map(links[name].findall, SHAPES))]
    own = [name for name in empty if moved[name] in joints.names]
    if own:
        expected = "with a mass, because the URDF gives it a shape: without it the torque would be too small"
        raise ParameterError("link", ", ".join(own), expected)
    notes = [f"these moving links have a shape and no mass: {', '.join(empty)}"] if empty else []
    filled_in = _filled_in({name: inertial for name, inertial in inertials.items() if name in moved})
    if filled_in:
        share, named = _share_of(filled_in, joints), ", ".join(filled_in)
        if share > LIMITS.share:
            expected = (
                "measured or computed: equal masses with their centres of gravity in the joints are placeholders, and "
                f"they make {share:.0%} of the torque"
            )
            raise ParameterError(f"mass of {named}", [inertials[name].mass for name in filled_in], expected)
        notes.append(f"the masses of these links look like placeholders, {share:.1%} of the torque: {named}")
    return tuple(notes)


def read_inertials(root: Element, model: Pinocchio) -> dict[str, Inertial]:
    """Return what a URDF says of the mass of each link, by its name, as `model` has it, too.

    urdfdom drops an inertial that it cannot read (a tab, a blank, an entity), says so on stderr, and goes on.

    Raises ParameterError for a mass that is negative or no number, and where Pinocchio's model has another one.
    """
    inertials = {link.get("name", ""): _inertial(link) for link in root.iter("link")}
    before = {child: (joint, parent) for joint, parent, child in _joints(root)}
    groups: dict[str, list[str]] = {}  # links by the joint that moves them
    for link in inertials:
        joint, at = before.get(link, ("", ""))
        while joint and joint not in model.names:  # a fixed one
            joint, at = before.get(at, ("", ""))
        if joint:
            groups.setdefault(joint, []).append(link)
    for joint, links in groups.items():
        stated, read = sum(inertials[link].mass for link in links), model.inertias[model.getJointId(joint)].mass
        if not math.isclose(stated, read, rel_tol=1e-6, abs_tol=1e-9):
            expected = f"written so that Pinocchio reads it, as 1.2: it reads {read:.4g} kg"
            raise ParameterError(f"mass of {', '.join(links)}", stated, expected)
    return inertials


def _filled_in(inertials: dict[str, Inertial]) -> list[str]:
    """Return the links whose masses look like placeholders: balls about their joints, equal or impossibly large."""
    balls = {name: inertial for name, inertial in inertials.items() if inertial.is_round}
    count = Counter(balls.values())
    return [
        name
        for name, ball in balls.items()
        if count[ball] > 1 or math.sqrt(ball.inertia[0] / ball.mass) > LIMITS.gyration
    ]


def _share_of(links: Sequence[str], joints: UrdfJoints) -> float:
    """Return which share of the arm's largest torque comes from these links."""
    root = copy.deepcopy(joints.root)
    for link in root.iter("link"):
        for inertial in link.findall("inertial"):
            if link.get("name") in links:
                link.remove(inertial)
    without = joints.of(ElementTree.tostring(root, encoding="unicode"))
    return float(np.max((joints.peak - without.peak) / joints.peak.max())) if joints.peak.any() else 0.0


def _missing(other: Other) -> ParameterError:
    cannot = "" if other.can_be_at_zero else f", and it cannot be at 0 (limits {other.lower:g} to {other.upper:g})"
    return ParameterError(
        f"position of {other.name}", None, f"in the joint states: it moves what the arm holds{cannot}"
    )


def _mimics(root: Element) -> Iterator[tuple[str, Mimic]]:
    for joint in root.findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            numbers = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
            yield joint.get("name", ""), Mimic(mimic.get("joint", ""), *numbers)


def _joints(root: Element) -> Iterator[tuple[str, str, str]]:
    """Yield the name of each joint, its parent link and its child link."""
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            yield joint.get("name", ""), parent.get("link", ""), child.get("link", "")


def _moved(root: Element, joint_names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield each link that the arm's joints move, with the name of the joint before it."""
    after: dict[str, list[tuple[str, str]]] = {}
    ends = []
    for name, parent, child in _joints(root):
        after.setdefault(parent, []).append((child, name))
        if name in joint_names:
            ends.append((child, name))
    seen: set[str] = set()
    while ends:
        link, joint_name = ends.pop()
        if link not in seen:
            seen.add(link)
            yield link, joint_name
            ends += after.get(link, ())


def _inertial(link: Element) -> Inertial:
    """Return what the URDF says of a link's mass, zeros where it says nothing. Raises ParameterError."""
    inertial = link.find("inertial")
    parts = {} if inertial is None else {part.tag: part.attrib for part in inertial}

    def numbers(tag: str, *names: str) -> tuple[float, ...]:
        return tuple(float(word) for name in names for word in parts.get(tag, {}).get(name, "0").split())

    mass = numbers("mass", "value")[0]
    if mass < 0.0:
        raise ParameterError(f"mass of the link {link.get('name')}", mass, "0 kg or more")
    cog = numbers("origin", "xyz") if "xyz" in parts.get("origin", {}) else (0.0, 0.0, 0.0)
    return Inertial(mass, cog, numbers("inertia", "ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
