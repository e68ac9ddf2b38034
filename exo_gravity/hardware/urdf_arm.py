# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Any serial arm, from its URDF, by Pinocchio (`pip install pin`).

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
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from exo_gravity import packaged
from exo_gravity.core.arm.interface import (
    MAX_GAIN,
    MAX_GRAVITY,
    MAX_MASS,
    MAX_PAYLOAD,
    MAX_REACH,
    NO_LOAD,
    STANDARD_GRAVITY,
    Payload,
)
from exo_gravity.core.arm.rotation import ZERO, Floats3
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Torque, Vector, floats, one_float
from exo_gravity.hardware.urdf_checks import carrier_of, checked, unused_efforts
from exo_gravity.hardware.urdf_model import LEAST_LENGTH, UrdfJoints, UrdfShape

PACKAGE = "package://"
# The compensator's parameters.
MOMENT_NAMES, TURN_NAMES = (tuple(f"urdf.{what}_{axis}" for axis in "xyz") for what in ("moment", "turn"))
LEAST_POSES = 500  # at random, for the least inertia


def read_urdf(path: str) -> str:
    """Return the text of a URDF file, whose path may begin with package://NAME/. Raises ParameterError."""
    try:
        return _located(path).read_text(encoding="utf-8-sig")  # some editors of Windows begin a file with a mark
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError("urdf.file", path, f"a URDF file in UTF-8 ({error})") from None


def _located(path: str) -> Path:
    if not path.startswith(PACKAGE):
        return Path(path).expanduser()
    name, _, rest = path.removeprefix(PACKAGE).partition("/")
    if name == "exo_gravity" and (own := packaged(rest.removeprefix("config/"))):
        return own
    shares = [Path(prefix, "share", name) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if prefix]
    return next((file for share in shares if (file := share / rest).exists()), Path(path))


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


def arm_in_file(values: Mapping[str, Any], why: str) -> UrdfArm | None:
    """Return the same arm from the file `urdf.file`; None for the paper's arm, which has no such parameter.

    why: ends the sentence that it must be a file.

    Raises ParameterError, also if the URDF comes from a topic.
    """
    if "urdf.file" not in values:
        return None
    if not values["urdf.file"]:
        raise ParameterError("urdf.file", "", f"a file{why}")
    return arm_from(values, read_urdf(values["urdf.file"]))


@dataclass(frozen=True)
class Carried:
    """What an arm of n joints holds: a load in its hand, and a wearer's arm on its links.

    Both are points of mass. A wearer's segment lies on the line from its link's joint to the next joint, or from the
    last joint to the hand. First moments of a wearer's arm, as `calibrate wearer` finds them, take the place of its
    points in all but the inertia: they move the links' centres of gravity.
    """

    payload: Payload = NO_LOAD
    worn: tuple[tuple[float, float], ...] = ()  #: (n,) kg of the wearer's segment, and m from the link's joint
    moments: tuple[tuple[float, ...], ...] = ()  #: (n, 3) kg m of the wearer's arm, in place of `worn`

    @property
    def mass(self) -> float:
        """Kg of load and wearer."""
        return self.payload.mass + sum(mass for mass, _ in self.worn)


class UrdfLinks:
    """The inertia of an arm by Pinocchio: `Links` of core/arm/interface.py.

    moves: how the joints of `model` move.
    rotors: (n,) kg m^2 at the joints.
    """

    def __init__(self, pin: Any, model: Any, moves: UrdfJoints, rotors: Sequence[float]) -> None:
        self._pin, self._moves, self._rotors = pin, moves, np.array(rotors)
        self._model, self._data = model, model.createData()

    def torque(self, theta: Sequence[float], velocity: Sequence[float], acceleration: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm for theta rad, velocity rad/s and acceleration rad/s^2, (n,) each."""
        self._model.gravity.linear = self._model.gravity.angular = np.zeros(3)
        rates = (self._moves.own @ values for values in (velocity, acceleration))
        torque = self._pin.rnea(self._model, self._data, self._moves.configuration(theta), *rates)
        return tuple((self._moves.own.T @ torque + self._rotors * acceleration).tolist())

    def momentum(
        self, theta: Sequence[float], velocity: Sequence[float], turning: Floats3 = ZERO
    ) -> tuple[Torque, Torque]:
        """Return the generalized momentum p = M v, (n,) kg m^2/s, and C^T v, (n,) Nm, with M' = C + C^T.

        turning: angular velocity of the base, (3,) rad/s, whose part is neglected.
        """
        speed, at = self._moves.own @ velocity, self._moves.configuration(theta)
        momentum = self.matrix(theta) @ np.asarray(velocity)
        coriolis = self._pin.computeCoriolisMatrix(self._model, self._data, at, speed)
        return tuple(momentum.tolist()), tuple((self._moves.own.T @ (coriolis.T @ speed)).tolist())

    def matrix(self, theta: Sequence[float]) -> np.ndarray:
        """Return the mass matrix (n, n) in kg m^2 at `theta` (n,) rad."""
        upper = np.triu(self._pin.crba(self._model, self._data, self._moves.configuration(theta)))
        own = self._moves.own
        return np.asarray(own.T @ (upper + np.triu(upper, 1).T) @ own + np.diag(self._rotors))

    @cached_property
    def least(self) -> tuple[float, ...]:
        """The least inertia (n,) in kg m^2 that each joint feels, the other joints being free, in poses at random."""
        poses = np.random.default_rng(0).uniform(-math.pi, math.pi, (LEAST_POSES, len(self._moves.names)))
        return tuple(np.min([1.0 / np.diag(np.linalg.inv(self.matrix(pose))) for pose in poses], axis=0).tolist())


class UrdfArm(UrdfShape):
    """The arm that `joint_names` (n,) move in the URDF `text`; other joints are where `follow` says, or at 0.

    It is an `Arm` of core/arm/interface.py, of which tilts are those of the left arm.

    hand: the link that holds a load, '' if there is none.
    rotors: inertia of the motors' rotors at the joints, (n,) kg m^2, which a URDF does not state; () for none.

    Raises ParameterError if the text is not a URDF, its links have no mass, Pinocchio is missing, the hand is no link,
    a joint is missing or does not turn, or a description is incomplete (`urdf_checks`).

    max_effort: (n,) Nm, the joints' effort limits in the URDF, 0 where it has none that a joint can have.
    notes: sentences on what is doubtful in the URDF, for the log.
    """

    def __init__(self, text: str, joint_names: Sequence[str], hand: str = "", rotors: Sequence[float] = ()) -> None:
        super().__init__(text, joint_names, hand)
        names = self.names
        self.gain, self.gravity = np.ones(len(names)), STANDARD_GRAVITY
        self._held = Carried()
        self._rotors = tuple(rotors) or (0.0,) * len(names)
        self.change = np.zeros((len(names), 3))  #: (n, 3) kg m, by what `corrected` changed the moments
        self.turn = np.zeros((len(names), 3))  #: (n, 3) rad, by what `turned` turned the joints' places
        self._identity = text, names
        self._by_mass = self._model  # with the wearer's points of mass, for the inertia
        self._data = self._model.createData()
        # Pinocchio's configuration is the angles of the arm's joints: no other one moves, and none is continuous.
        self._is_chain = self._model.nq == len(names) and np.array_equal(self.moves.own, np.eye(len(names)))
        self._own_mass = sum(link.mass for link in self.moves.moved)
        self.notes = checked("arm", self)
        unused = {name for name, *_ in unused_efforts(self)}
        efforts = zip(names, self.moves.efforts, strict=True)
        self.max_effort = tuple(0.0 if name in unused else effort for name, effort in efforts)

    def __eq__(self, other: object) -> bool:
        return self._key == getattr(other, "_key", None)

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[object, ...]:
        own = self._own_mass, self.change.tobytes(), self.turn.tobytes()
        return (*self._identity, self._hand, self._rotors, self.scale, self._held, *own)

    @property
    def payload(self) -> Payload:
        """The load in the hand."""
        return self._held.payload

    @property
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
        return UrdfLinks(self._pin, self._by_mass, self.moves, self._rotors)

    def with_masses(self, law: str) -> NoReturn:
        """Raise ParameterError: no law of the paper's arm covers another one."""
        raise ParameterError("law", law, "urdf for an arm from a URDF")

    def worn_links(self, mass: Vector, cog: Vector) -> UrdfLinks:
        """Return the inertia with the wearer's whole arm. mass, cog: as in `with_wearer`."""
        return self.with_wearer(mass, cog).links

    @property
    def fixed(self) -> tuple[str, ...]:
        """The joints that are not the arm's, change its torque, and are taken to be at 0: none is reported."""
        return self.moves.fixed

    def follow(self, names: Sequence[str], positions: Sequence[float]) -> None:
        """Take the positions (m,) of all joints that are reported, by their names (m,), for all copies of this arm.

        Raises ParameterError if one that changes the torque is missing or not finite.
        """
        self.moves.follow(names, positions)

    def torque(self, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (n,) in Nm that holds the arm at `theta` (n,) rad.

        Raises ParameterError while a joint on which it depends is not known (`follow`).
        """
        return self._holding(theta, [self.gravity * tilt.magnitude * part for part in tilt.gravity_in_trunk], ZERO)

    def torques(self, theta: ArrayLike, direction: ArrayLike) -> np.ndarray:
        """Return the torque (m, n) in Nm that holds the arm at `theta` (m, n) rad.

        direction: (m, 3), gravity's unit vectors in the left arm's base frame, as `Tilt.direction`.
        """
        x, y, z = np.transpose(direction)
        model, data = self._model.copy(), self._model.createData()  # its own gravity: another thread may use the arm
        model.gravity.angular = np.zeros(3)
        poses = np.asarray(theta)
        torques = np.empty((len(poses), model.nv))
        downs = self.gravity * np.transpose((y, x, -z))
        for row, down, at in zip(torques, downs, self.moves.configurations(poses), strict=True):
            model.gravity.linear = down
            row[:] = self._pin.computeGeneralizedGravity(model, data, at)
        return np.asarray(self.gain * (torques @ self.moves.own))

    def turning_torque(self, side: str, theta: Sequence[float], angular_acceleration: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm that turns the arm at `theta` (n,) rad along with its base.

        angular_acceleration: of the trunk, (3,) rad/s^2 in its own axes, which the root link has on either side.
        """
        return self._holding(theta, ZERO, [-component for component in angular_acceleration])

    def scaled(self, gain: Sequence[float], gravity: float) -> UrdfArm:
        """Return this arm with other gains, (n,), and another gravity, m/s^2. Raises ParameterError."""
        _, arm = self.links, copy.copy(self)  # what takes long to compute, the least inertia, is computed once
        arm.gain = floats("gain", gain, len(self.gain), 0.0, MAX_GAIN)
        arm.gravity = one_float("gravity", gravity, 0.0, MAX_GRAVITY, "m/s^2")
        arm._data = arm._model.createData()
        return arm

    def corrected(self, change: np.ndarray) -> UrdfArm:
        """Return this arm with other first moments of its links, in place of any other change. Raises ParameterError.

        change: (n, 3) kg m, by which the moment of the link of each joint differs from the URDF's, along x, y, z of the
        joint's frame. The masses stay the URDF's: the centres of gravity move.
        """
        if np.array_equal(change, self.change):
            return self
        bare = self._shifted(self._bare, change - self.change, "urdf.moment")
        return self._with(_bare=bare, change=np.array(change))

    def turned(self, turn: np.ndarray) -> UrdfArm:
        """Return this arm with joints whose axes lie otherwise, in place of any other turn.

        turn: (n, 3) rad, rotation vector by which the place of each joint differs from the URDF's, in the joint's
        frame.
        """
        if np.array_equal(turn, self.turn):
            return self
        bare = self._bare.copy()
        for joint, old, new in zip(self._joints, self.turn, turn, strict=True):
            place = bare.jointPlacements[joint]
            place.rotation = place.rotation @ self._pin.exp3(old).T @ self._pin.exp3(new)
        return self._with(_bare=bare, turn=np.array(turn))

    def with_wearer_moments(self, moments: ArrayLike, support: float = 1.0) -> UrdfArm:
        """Return this arm plus a share `support` (0..1) of what a wearer's arm adds to the first moments of the links.

        moments: (n, 3) kg m, along x, y, z of each joint's frame, in place of any other wearer. The inertia is that of
        the arm alone. Raises ParameterError.
        """
        carried = one_float("support", support, 0.0, 1.0) * np.asarray(moments, dtype=float)
        return self._with(_held=replace(self._held, worn=(), moments=tuple(map(tuple, carried.tolist()))))

    def massless(self, gravity: float) -> UrdfArm:
        """Return an arm with these joints, without any mass, with gains of 1, where gravity is `gravity` m/s^2."""
        bare = self._bare.copy()
        for joint in range(bare.njoints):
            bare.inertias[joint] = self._pin.Inertia.Zero()
        arm = self.scaled(np.ones(len(self.gain)).tolist(), gravity)
        return arm._with(_bare=bare, _own_mass=0.0, _held=Carried())

    def with_payload(self, mass: float, cog: Vector = ZERO) -> UrdfArm:
        """Return this arm with a load of `mass` kg in its hand, instead of any other. Raises ParameterError.

        cog: (3,) m, its centre of gravity in the frame of the link `hand`.
        """
        mass = one_float("payload.mass", mass, 0.0, MAX_PAYLOAD, "kg")
        if mass and not self._hand:
            raise ParameterError("payload.mass", mass, "0 without urdf.hand, which says where a load is held")
        x, y, z = floats("payload.cog", cog, 3, -MAX_REACH, MAX_REACH, "m").tolist()
        return self._with(_held=replace(self._held, payload=Payload(mass, (x, y, z))))

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
        return self._with(_held=replace(self._held, worn=worn, moments=()))

    def _with(self, **changes: object) -> UrdfArm:
        """Return this arm with other values of attributes, and with all that it then holds on its links."""
        arm = copy.copy(self)
        arm.__dict__.update(changes)
        arm._by_mass, (mass, place) = arm._bare.copy(), arm._held.payload
        if mass:
            joint, at = carrier_of(arm._by_mass, self._hand)
            arm._add(joint, mass, at.act(np.array(place)))
        for joint, (worn, cog), way in zip(self._joints, arm._held.worn, self.directions, strict=False):
            arm._add(joint, worn, way * cog)
        arm._model = self._shifted(arm._by_mass, np.array(arm._held.moments), "wearer.moment")
        arm._data = arm._model.createData()
        arm.__dict__.pop("links", None)  # the inertia of the other arm
        return arm

    def _add(self, joint: int, mass: float, place: np.ndarray) -> None:
        """Add a point of `mass` kg to the link of `joint`, at `place` (3,) m in the joint's frame."""
        point = self._pin.Inertia(mass, place, np.zeros((3, 3)))
        self._by_mass.appendBodyToJoint(joint, point, self._pin.SE3.Identity())

    def _shifted(self, model: Any, moments: np.ndarray, what: str) -> Any:
        """Return a copy of `model` whose links have these `moments` (n, 3) kg m more: their centres of gravity move.

        moments: (0,) for none. Raises ParameterError that names `what` if a link without mass has one.
        """
        shifted = model.copy()
        for joint, name, own in zip(self._joints, self.names, moments, strict=False):
            link = shifted.inertias[joint]
            if any(own) and not link.mass:
                raise ParameterError(f"{what} of {name}", own.tolist(), "0: its link has no mass in the URDF")
            if any(own):
                shifted.inertias[joint] = self._pin.Inertia(link.mass, link.lever + own / link.mass, link.inertia)
        return shifted

    def _holding(self, theta: Sequence[float], gravity: Sequence[float], turning: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm where gravity is `gravity` (3,) m/s^2, as the root link feels it.

        turning: (3,) rad/s^2, less the root link's angular acceleration.
        """
        felt = self._model.gravity
        felt.linear[:], felt.angular[:] = gravity, turning  # in place, which takes a fifth of the time of assigning
        at = np.array(theta, dtype=float) if self._is_chain else self.moves.configuration(theta)
        torque = self._pin.computeGeneralizedGravity(self._model, self._data, at)
        return tuple((self.gain * (torque if self._is_chain else self.moves.own.T @ torque)).tolist())
