# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Any serial arm, from its URDF, by Pinocchio (extra `urdf`).

A URDF gives each link's mass, centre of gravity and inertia, and each joint's place and axis. With the joint velocities
and accelerations zero, recursive Newton-Euler leaves the torque that holds the arm (`computeGeneralizedGravity`).
Gravity comes as a vector in the root link's axes, so that the base may tilt. The root link has the trunk's axes
(REP-103).
"""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from exo_gravity import packaged
from exo_gravity.core.arm.arm import (
    MAX_GAIN,
    MAX_GRAVITY,
    MAX_MASS,
    MAX_PAYLOAD,
    MAX_REACH,
    STANDARD_GRAVITY,
)
from exo_gravity.core.arm.gravity import Torque
from exo_gravity.core.arm.rotation import ZERO
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import ParameterError, with_extra
from exo_gravity.core.numbers import MAX_JOINTS, Vector, floats, one_float
from exo_gravity.hardware.urdf_checks import UrdfJoints, check_masses, usable_efforts
from exo_gravity.hardware.urdf_held import Bodies, Held
from exo_gravity.hardware.urdf_links import UrdfLinks
from exo_gravity.hardware.urdf_tree import Frames, JointTree

PACKAGE = "package://"
# The compensator's parameters.
MOMENT_NAMES, TURN_NAMES = (tuple(f"urdf.{what}_{axis}" for axis in "xyz") for what in ("moment", "turn"))
LEAST_LENGTH = 1e-4  # m between two joints; nearer ones have no link between them
BASE_POSES = 60  # at random, from which the moments are found that torque can show
DEPENDENT = 1e-6  # of the largest column: what is left of one that depends on others
Base = Sequence[tuple[int, np.ndarray]]


def read_urdf(path: str) -> str:
    """Return the text of a URDF file, whose path may begin with package://NAME/. Raises ParameterError."""
    try:
        return _located(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError("urdf.file", path, f"a URDF file ({error})") from None


def _located(path: str) -> Path:
    if not path.startswith(PACKAGE):
        return Path(path).expanduser()
    name, _, rest = path.removeprefix(PACKAGE).partition("/")
    if name == "exo_gravity" and (own := packaged(rest.removeprefix("config/"))):
        return own
    shares = [Path(prefix, "share", name) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if prefix]
    found = (file for share in shares if (file := share / rest).exists())
    return next(found, Path(path))


def arm_from(values: Mapping[str, Any], text: str) -> UrdfArm:
    """Return the arm that the compensator's parameter `values` describe, from the `text` of its URDF.

    can_bridge reports the arm's own joints alone: any other is then taken to be at 0. Raises ParameterError as
    `UrdfArm` does, and if another joint cannot be at 0.
    """
    names = values["joint_names"]
    arm = UrdfArm(text, names, values["urdf.hand"])
    if values.get("command_interface") != "multi_array":
        arm.follow(names, [0.0] * len(names))
    moments, turn = (np.transpose([values[name] for name in names]) for names in (MOMENT_NAMES, TURN_NAMES))
    return arm.corrected(moments).turned(turn)


def arm_in_file(values: Mapping[str, Any], why: str) -> UrdfArm:
    """Return the same arm from the file `urdf.file`. Raises ParameterError, also if it comes from a topic.

    why: ends the sentence that it must be a file.
    """
    if not values["urdf.file"]:
        raise ParameterError("urdf.file", "", f"a file{why}")
    return arm_from(values, read_urdf(values["urdf.file"]))


class Skeleton(NamedTuple):
    """What `can_bridge` needs to compute the gravity of an arm of n joints itself, in the root link's axes."""

    axes: np.ndarray  #: (n, 3), unit vectors along the joints' axes while all angles are 0
    ways: np.ndarray  #: (n, 3), unit vectors along the links, zeros for one without length
    moments: np.ndarray  #: (n,) kg m, largest first moment along each link, with all mass beyond it
    beside: np.ndarray  #: (n,) kg m, the most by which masses beside the links load each joint in any pose


class UrdfArm:
    """The arm that `joint_names` (n,) move in the URDF `text`; other joints are where `follow` says, or at 0.

    It is an `Arm` of core/arm/interface.py, of which tilts are those of the left arm.

    hand: the link that holds a load, '' if there is none.
    rotors: inertia of the motors' rotors at the joints, (n,) kg m^2, which a URDF does not state; () for none.

    Raises ParameterError if the text is not a URDF, its links have no mass, Pinocchio is missing, the hand is no link,
    a joint is missing or does not turn, or a description is incomplete (`urdf_checks`).

    max_effort: (n,) Nm, the joints' effort limits in the URDF, 0 where it has none that a joint can have.
    notes: sentences on what is doubtful in the URDF, for the log.
    length: (n,) m from each joint to the next one, and from the last one to the hand; 0 if there is no hand.
    """

    def __init__(self, text: str, joint_names: Sequence[str], hand: str = "", rotors: Sequence[float] = ()) -> None:
        self._pin, names = _pinocchio(), list(joint_names)
        if not 1 <= len(set(names)) == len(names) <= MAX_JOINTS:
            raise ParameterError("joint_names", names, f"1 to {MAX_JOINTS} different joints of the URDF")
        self._moves = UrdfJoints(self._pin, text, names)  # shared by all arms that are made of this one
        self._model = self._moves.model
        if hand and not self._model.existBodyName(hand):
            links = ", ".join(frame.name for frame in self._model.frames if frame.type == self._pin.FrameType.BODY)
            raise ParameterError("urdf.hand", hand, f"a link of the URDF ({links})")
        self._joints = [self._model.getJointId(name) for name in names]
        self._numbers = [joint - 1 for joint in self._joints]  # in the tree, which has no joint of the root link
        self.gain, self.gravity = np.ones(len(names)), STANDARD_GRAVITY
        self._held = Held()
        self._hand = hand
        self._rotors = tuple(rotors) or (0.0,) * len(names)
        self._change = np.zeros((len(names), 3))  # kg m, beyond the URDF
        self._turn = np.zeros((len(names), 3))  # rad, likewise
        self._identity = text, tuple(names)
        self._bare = self._by_mass = self._model  # without load and wearer
        self._data = self._model.createData()
        self._own_mass = max(self._tree.masses[self._numbers].tolist())
        if not self._own_mass > 0.0:
            raise ParameterError("mass of the URDF's links", self._own_mass, "above 0 kg: it lacks inertial elements")
        self.max_effort, unused = usable_efforts(self._moves)
        self.notes = (*check_masses(self._moves), *unused, *self._moves.notes)
        self._along = self._ways()
        self._bodies = Bodies(self._pin, self._joints, names, self._along, hand)
        self.length = tuple(float(np.linalg.norm(way)) for way in self._along)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, UrdfArm) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[object, ...]:
        own = self._own_mass, self._change.tobytes(), self._turn.tobytes()
        return (*self._identity, self._hand, self._rotors, self.scale, self._held, *own)

    @property
    def payload(self) -> tuple[float, float, float, float]:
        """The load in the hand: kg, and its centre of gravity in m in the frame of the hand."""
        return self._held.payload

    @cached_property
    def scale(self) -> tuple[float, ...]:
        """(n,) m/s^2, gain times gravity."""
        return tuple((self.gain * self.gravity).tolist())

    @property
    def total_mass(self) -> float:
        """Kg of the links that the joints move, and of what they hold."""
        return float(self._own_mass + self.given_mass)

    @property
    def given_mass(self) -> float:
        """Kg of load and wearer: the URDF states the rest."""
        return self._held.mass

    @property
    def has_hand(self) -> bool:
        """Whether it is known where a load is held."""
        return bool(self._hand)

    @property
    def facts(self) -> Mapping[str, Sequence[float] | None]:
        """The mass of the links."""
        return {"mass (kg)": (self._own_mass,)}

    @cached_property
    def links(self) -> UrdfLinks:
        """The inertia of links, load, wearer and rotors."""
        return UrdfLinks(self._pin, self._by_mass, self._moves, self._rotors)

    def worn_links(self, mass: Vector, cog: Vector) -> UrdfLinks:
        """Return the inertia with the wearer's whole arm. mass, cog: as in `with_wearer`."""
        return self.with_wearer(mass, cog).links

    @property
    def fixed(self) -> tuple[str, ...]:
        """The joints that are not the arm's, change its torque, and are taken to be at 0: none is reported."""
        return self._moves.fixed

    def follow(self, names: Sequence[str], positions: Sequence[float]) -> None:
        """Take the positions (m,) of all joints that are reported, by their names (m,), for all copies of this arm.

        Raises ParameterError if one that changes the torque is missing or not finite.
        """
        self._moves.follow(names, positions)

    def torque(self, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (n,) in Nm that holds the arm at `theta` (n,) rad.

        Raises ParameterError while a joint on which it depends is not known (`follow`).
        """
        felt = self.gravity * tilt.magnitude
        return self._holding(theta, [felt * component for component in tilt.gravity_in_trunk], ZERO)

    def torques(self, theta: ArrayLike, direction: ArrayLike) -> np.ndarray:
        """Return the torque (m, n) in Nm that holds the arm at `theta` (m, n) rad.

        direction: (m, 3), gravity's unit vectors in the left arm's base frame, as `Tilt.direction`.
        """
        x, y, z = np.transpose(direction)
        return self.gain * self._torques(np.asarray(theta), self.gravity * np.transpose((y, x, -z)))

    def turning_torque(self, side: str, theta: Sequence[float], angular_acceleration: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm that turns the arm at `theta` (n,) rad along with its base.

        angular_acceleration: of the trunk, (3,) rad/s^2 in its own axes, which the root link has on either side.
        """
        return self._holding(theta, ZERO, [-component for component in angular_acceleration])

    def scaled(self, gain: Sequence[float], gravity: float) -> UrdfArm:
        """Return this arm with other gains, (n,), and another gravity, m/s^2. Raises ParameterError."""
        arm = copy.copy(self)
        arm.gain = floats("gain", gain, len(self.gain), 0.0, MAX_GAIN)
        arm.gravity = one_float("gravity", gravity, 0.0, MAX_GRAVITY, "m/s^2")
        arm._anew().__dict__["links"] = self.links  # what takes long to compute, the least inertia, is computed once
        return arm

    def corrected(self, change: np.ndarray) -> UrdfArm:
        """Return this arm with other first moments of its links, in place of any other change. Raises ParameterError.

        change: (n, 3) kg m, by which the moment of the link of each joint differs from the URDF's, along x, y, z of the
        joint's frame. The masses stay the URDF's: the centres of gravity move.
        """
        if np.array_equal(change, self._change):
            return self
        arm = copy.copy(self)
        arm._bare = self._bodies.shifted(self._bare, change - self._change, "urdf.moment")
        arm._change = np.array(change)
        return arm._holding_all()

    def turned(self, turn: np.ndarray) -> UrdfArm:
        """Return this arm with joints whose axes lie otherwise, in place of any other turn.

        turn: (n, 3) rad, rotation vector by which the place of each joint differs from the URDF's, in the joint's
        frame. `base` remains that of the URDF: axes that are nearly parallel show next to nothing more.
        """
        if np.array_equal(turn, self._turn):
            return self
        arm, _ = copy.copy(self), self.base
        arm._bare = self._bare.copy()
        for joint, old, new in zip(self._joints, self._turn, turn, strict=True):
            place = arm._bare.jointPlacements[joint]
            place.rotation = place.rotation @ self._pin.exp3(old).T @ self._pin.exp3(new)
        arm._turn = np.array(turn)
        return arm._holding_all()

    def with_wearer_moments(self, moments: ArrayLike, support: float = 1.0) -> UrdfArm:
        """Return this arm plus a share `support` (0..1) of what a wearer's arm adds to the first moments of the links.

        moments: (n, 3) kg m, along x, y, z of each joint's frame, in place of any other wearer. The inertia is that of
        the arm alone. Raises ParameterError.
        """
        carried = one_float("support", support, 0.0, 1.0) * np.asarray(moments, dtype=float)
        return self._with(replace(self._held, worn=(), moments=tuple(map(tuple, carried.tolist()))))

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors (n, 3) along the links in their joints' frames, zeros for one without length."""
        length = np.array(self.length)[:, None]
        return np.divide(self._along, length, out=np.zeros((len(length), 3)), where=length >= LEAST_LENGTH)

    @property
    def change(self) -> np.ndarray:
        """By what `corrected` changed the moments, (n, 3) kg m."""
        return self._change

    @property
    def turn(self) -> np.ndarray:
        """By what `turned` turned the joints' places, (n, 3) rad."""
        return self._turn

    @property
    def names(self) -> tuple[str, ...]:
        """The joints (n,)."""
        return self._moves.names

    @property
    def moves_alone(self) -> bool:
        """Whether the links move with the arm's joints alone, and no joint follows another one."""
        return len(self._joints) == self._bare.njoints - 1

    @cached_property
    def ranges(self) -> np.ndarray:
        """The joints' limits in the URDF, (2, n) rad."""
        return np.transpose([self._moves.limits(name) for name in self.names])

    @cached_property
    def base(self) -> tuple[tuple[int, np.ndarray], ...]:
        """The k moments that gravity's torque can show: each a joint's number, and a unit vector (3,) in its frame.

        Of a link's first moment the part along its joint's axis turns with the link before, as masses do: both count as
        the first moments of that link. The rest are columns of the regressor, from which a QR decomposition in random
        poses leaves out those that depend on others (M. Gautier, ICRA 1990).
        """
        across = []
        for n, joint in enumerate(self._joints):
            if self._bare.inertias[joint].mass:
                across += [(n, way) for way in self._across(n)]
        rows = self._rows(*self._sampled(0), across).reshape(-1, len(across))
        size = np.abs(np.diag(np.linalg.qr(rows, mode="r")))
        return tuple(one for one, own in zip(across, size, strict=True) if own > DEPENDENT * size.max())

    def regressor(self, theta: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the torque of each joint per unit of each moment of `base`: (m, n, k) in Nm per kg m.

        theta: (m, n) rad. direction: (3,) or (m, 3), gravity's unit vector in the root link's axes. Gains do not count.
        """
        return self._rows(theta, self.gravity * np.broadcast_to(direction, (len(theta), 3)), self.base)

    @property
    def moments(self) -> np.ndarray:
        """The moments (k,) in kg m of `base`, of all that the arm holds."""
        sampled = self._sampled(1)
        rows, torque = self._rows(*sampled, self.base), self._torques(*sampled)
        return np.asarray(np.linalg.lstsq(rows.reshape(-1, rows.shape[-1]), torque.ravel(), rcond=None)[0])

    def with_more_moments(self, moments: np.ndarray) -> UrdfArm:
        """Return this arm with `moments` (k,) kg m of `base` added to those of the robot. Raises ParameterError."""
        change = self._change.copy()
        for (n, way), more in zip(self.base, moments, strict=True):
            change[n] += more * way
        return self.corrected(change)

    @property
    def _axes(self) -> np.ndarray:
        """The joints' axes (n, 3) in their own frames."""
        return self._tree.axes[self._numbers]

    @cached_property
    def turns(self) -> np.ndarray:
        """Of each joint's frame its axis and two unit vectors across it, (n, 3, 3), one a row."""
        return np.array([np.vstack((axis, self._across(n))) for n, axis in enumerate(self._axes)])

    def frames(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how the joints' frames are turned at `theta` (m, n) rad, (m, n, 3, 3) to the root link's axes.

        First as they would be with the joint itself at 0, then as they are.
        """
        before, after, _ = self._frames(theta)
        return before, after

    @property
    def moved_by(self) -> np.ndarray:
        """Whether a joint moves the link of another, (n, n): the first index is that joint's."""
        return self._tree.moves[np.ix_(self._numbers, self._numbers)]

    def _across(self, n: int) -> np.ndarray:
        """Return two unit vectors (2, 3) across the axis of joint n, in its frame."""
        return np.asarray(np.linalg.svd(self._axes[n][None])[2][1:])

    def pose(self, theta: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where the arm is at `theta` (n,) rad, in the root link's axes.

        The origins (n + 1, 3) in m of the joints and the hand, the axes (n, 3) about which the joints turn, and unit
        vectors (n, 3) across them, as far as possible along the links.
        """
        own, along = self._axes, []
        for n, (axis, way) in enumerate(zip(own, self._along, strict=True)):
            across = way - axis * (axis @ way)
            size = float(np.linalg.norm(across))
            along.append(across / size if size > LEAST_LENGTH else self._across(n)[0])
        poses = np.array([theta])
        turns = self.frames(poses)[1][0]
        axes, links = (np.einsum("nab,nb->na", turns, ways) for ways in (own, along))
        return self.places(poses)[0], axes, links

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mass (n,) kg of each joint's link, and where its centre of gravity is from the joint, (n, 3) m.

        While all angles are 0, in the root link's axes.
        """
        links = [self._bare.inertias[joint] for joint in self._joints]
        turns = self.frames(np.zeros((1, len(links))))[1][0]
        centres = [turn @ link.lever for turn, link in zip(turns, links, strict=True)]
        return np.array([link.mass for link in links]), np.array(centres)

    def skeleton(self) -> Skeleton | None:
        """Return axes, links and largest moments of all that the arm holds; None if its joints are no single chain."""
        parents = [self._model.parents[joint] for joint in self._joints]
        if not self.moves_alone or parents[1:] != self._joints[:-1]:
            return None
        turns, carried = self.frames(np.zeros((1, len(parents))))[1][0], self._tree.masses[self._numbers]
        ways, moments, beside = self.directions, np.zeros(len(turns)), np.zeros(len(turns))
        for n, (joint, way, length) in enumerate(zip(self._joints, ways, self.length, strict=True)):
            link = self._model.inertias[joint]
            own = link.mass * link.lever
            beyond = length * (carried[n] - link.mass)
            moments[n] = max(0.0, float(own @ way) + beyond) if np.any(way) else 0.0
            beside[n] = np.linalg.norm(own + beyond * ways[n] - moments[n] * ways[n])
        axes = np.einsum("nab,nb->na", turns, self._axes)
        return Skeleton(axes, np.einsum("nab,nb->na", turns, ways), moments, np.cumsum(beside[::-1])[::-1])

    def places(self, theta: np.ndarray) -> np.ndarray:
        """Return where the joints are at `theta` (m, n) rad, and the hand or the last joint again: (m, n + 1, 3) m.

        In the root link's axes.
        """
        _, after, origins = self._frames(theta)
        return np.concatenate((origins, origins[:, -1:] + after[:, -1:] @ self._along[-1]), axis=1)

    @cached_property
    def _tree(self) -> JointTree:
        """The joints with all that the arm holds."""
        return JointTree(self._pin, self._model)

    def _frames(self, theta: np.ndarray) -> Frames:
        """Return the frames of the arm's joints at `theta` (m, n) rad."""
        return Frames(*(part[:, self._numbers] for part in self._tree.frames(self._moves.positions(theta))))

    def _torques(self, theta: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        """Return the torque (m, n) in Nm, gains of 1, at `theta` (m, n) rad. gravity: (m, 3) m/s^2 in root axes."""
        return self._moves.folded(self._tree.torques(self._moves.positions(theta), gravity).T).T

    def _rows(self, theta: np.ndarray, gravity: np.ndarray, base: Base) -> np.ndarray:
        """Return the torque (m, n, k) in Nm of moments of 1 kg m at `theta` (m, n) rad. gravity: (m, 3) m/s^2."""
        links, ways = [self._numbers[n] for n, _ in base], np.array([way for _, way in base])
        return self._moves.folded(self._tree.rows(self._moves.positions(theta), gravity, links, ways))

    def _sampled(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return poses (m, n) in rad at random, each with a vector of gravity (m, 3) in m/s^2."""
        random = np.random.default_rng(seed)
        poses = random.uniform(-math.pi, math.pi, (BASE_POSES, len(self.names)))
        return poses, random.normal(size=(BASE_POSES, 3))

    def massless(self, gravity: float) -> UrdfArm:
        """Return an arm with these joints, without any mass, with gains of 1, where gravity is `gravity` m/s^2."""
        arm = self.scaled(np.ones(len(self.gain)).tolist(), gravity)
        arm._own_mass = 0.0
        arm._bare = self._bare.copy()
        for joint in range(arm._bare.njoints):
            arm._bare.inertias[joint] = self._pin.Inertia.Zero()
        return arm._with(Held())

    def with_payload(self, mass: float, cog: Vector = ZERO) -> UrdfArm:
        """Return this arm with a load of `mass` kg in its hand, instead of any other. Raises ParameterError.

        cog: (3,) m, its centre of gravity in the frame of the link `hand`.
        """
        mass = one_float("payload.mass", mass, 0.0, MAX_PAYLOAD, "kg")
        if mass and not self._hand:
            raise ParameterError("payload.mass", mass, "0 without urdf.hand, which says where a load is held")
        x, y, z = floats("payload.cog", cog, 3, -MAX_REACH, MAX_REACH, "m").tolist()
        return self._with(replace(self._held, payload=(mass, x, y, z)))

    def with_wearer(self, mass: Vector, cog: Vector, support: float = 1.0) -> UrdfArm:
        """Return this arm plus a share `support` (0..1) of the wearer's arm. Raises ParameterError.

        mass, cog: of the wearer's segment on each link, (n,) kg, and (n,) m from the link's joint along the link.
        """
        count = len(self.gain)
        carried = floats("wearer.mass", mass, count, 0.0, MAX_MASS, "kg") * one_float("support", support, 0.0, 1.0)
        distance = floats("wearer.cog", cog, count, 0.0, math.inf, "m")
        if any(distance > self.length):
            raise ParameterError("wearer.cog", cog, f"within its link, at most {[round(x, 3) for x in self.length]} m")
        for number, (own, length) in enumerate(zip(carried, self.length, strict=True), start=1):
            if own and length < LEAST_LENGTH:
                raise ParameterError("wearer.mass", mass, f"0 on link {number}, which has no length and no direction")
        worn = tuple(zip(carried.tolist(), distance.tolist(), strict=True))
        return self._with(replace(self._held, worn=worn, moments=()))

    def _anew(self) -> UrdfArm:
        """Forget what was computed for the arm that this is a copy of."""
        for name in ("scale", "links", "_tree"):
            self.__dict__.pop(name, None)
        self._data = self._model.createData()
        return self

    def _with(self, held: Held) -> UrdfArm:
        """Return this arm with all that it is to hold."""
        arm = copy.copy(self)
        arm._held = held
        return arm._holding_all()

    def _holding_all(self) -> UrdfArm:
        """Put load and wearer on the links."""
        self._by_mass, self._model = self._held.on(self._bodies, self._bare)
        return self._anew()

    def _holding(self, theta: Sequence[float], gravity: Sequence[float], turning: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm where gravity is `gravity` (3,) m/s^2, as the root link feels it.

        turning: (3,) rad/s^2, less the root link's angular acceleration.
        """
        model = self._model
        model.gravity.linear, model.gravity.angular = np.array(gravity), np.array(turning)
        torque = self._pin.computeGeneralizedGravity(model, self._data, self._moves.configuration(theta))
        return tuple((self.gain * self._moves.folded(torque)).tolist())

    def _ways(self) -> list[np.ndarray]:
        """Return the way (3,) in m from each joint to the next one in its chain, or to the hand, in its own frame."""
        model, ways = self._model, []
        hand = model.frames[model.getBodyId(self._hand)] if self._hand else None
        for joint in self._joints:
            following = [other for other in self._joints if model.parents[other] == joint]
            if len(following) == 1:
                ways.append(model.jointPlacements[following[0]].translation.copy())
            elif hand is not None and hand.parentJoint == joint:
                ways.append(hand.placement.translation.copy())
            else:
                ways.append(np.zeros(3))
        return ways


def _pinocchio() -> Any:
    try:
        import pinocchio
    except ImportError:
        raise ParameterError("law", "urdf", f"used with Pinocchio: {with_extra('urdf')}") from None
    return pinocchio
