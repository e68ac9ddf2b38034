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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from exo_gravity import packaged
from exo_gravity.core.arm.arm_data import MAX_GAIN, MAX_GRAVITY, MAX_MASS, MAX_PAYLOAD, MAX_REACH, STANDARD_GRAVITY
from exo_gravity.core.arm.gravity import Torque
from exo_gravity.core.arm.rotation import ZERO
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Vector, floats, one_float
from exo_gravity.hardware.urdf_checks import checked, unused_efforts
from exo_gravity.hardware.urdf_held import Bodies, Held
from exo_gravity.hardware.urdf_links import UrdfLinks
from exo_gravity.hardware.urdf_model import LEAST_LENGTH, UrdfShape

PACKAGE = "package://"
# The compensator's parameters.
MOMENT_NAMES, TURN_NAMES = (tuple(f"urdf.{what}_{axis}" for axis in "xyz") for what in ("moment", "turn"))
BASE_POSES = 60  # at random, from which the moments are found that torque can show
DEPENDENT = 1e-6  # of the largest column: what is left of one that depends on others
INERTIAL, MOMENT = 10, slice(1, 4)  # parameters of a link in Pinocchio's regressor, and those of its first moment
Base = Sequence[tuple[int, np.ndarray]]


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
        self._held = Held()
        self._rotors = tuple(rotors) or (0.0,) * len(names)
        self._change = np.zeros((len(names), 3))  # kg m, beyond the URDF
        self._turn = np.zeros((len(names), 3))  # rad, likewise
        self._identity = text, names
        self._by_mass = self._model  # with the wearer's points of mass, for the inertia
        self._data = self._model.createData()
        # All that the joints move: each of several chains counts once, by its first joint.
        joints, supports = {*self._joints}, self._model.supports
        first = [n for n, joint in enumerate(self._joints) if not joints & {*supports[joint]} - {joint}]
        self._own_mass = float(np.sum(self.masses[first]))
        self.notes = checked("arm", self)
        unused = {name for name, *_ in unused_efforts(self)}
        efforts = zip(names, self.moves.efforts, strict=True)
        self.max_effort = tuple(0.0 if name in unused else effort for name, effort in efforts)
        self._bodies = Bodies(self._pin, self._joints, names, self._along, hand)

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
        return UrdfLinks(self._pin, self._by_mass, self.moves, self._rotors)

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
        _, arm = self.base, copy.copy(self)  # the copy keeps the base, which is computed before
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
    def change(self) -> np.ndarray:
        """By what `corrected` changed the moments, (n, 3) kg m."""
        return self._change

    @property
    def turn(self) -> np.ndarray:
        """By what `turned` turned the joints' places, (n, 3) rad."""
        return self._turn

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
        return self._rows(theta, self.gravity * np.reshape(direction, (-1, 3)), self.base)

    def by_moments(self, moments: np.ndarray) -> Callable[[Sequence[float], Tilt], Torque]:
        """Return a function that computes the torque (n,) in Nm from theta (n,) rad and tilt, with moments per joint.

        moments: (n, k) kg m of `base`, a row for each joint. Gains do not count. The function has
        data of its own; use it on one thread at a time.
        """
        rows_at = self._rows_at(self.base)

        def torque(theta: Sequence[float], tilt: Tilt) -> Torque:
            gravity = self.gravity * tilt.magnitude * np.array(tilt.gravity_in_trunk)
            rows = rows_at(self.moves.configuration(theta), gravity)
            return tuple(np.einsum("jk,jk->j", rows, moments).tolist())

        return torque

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

    def _torques(self, theta: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        """Return the torque (m, n) in Nm, gains of 1, at `theta` (m, n) rad. gravity: (m, 3) m/s^2 in root axes."""
        model, data = self._model.copy(), self._model.createData()  # its own gravity: another thread may use the arm
        model.gravity.angular = np.zeros(3)
        torques = np.empty((len(theta), model.nv))
        for row, down, at in zip(torques, gravity, self.moves.configurations(theta), strict=True):
            model.gravity.linear = down
            row[:] = self._pin.computeGeneralizedGravity(model, data, at)
        return torques @ self.moves.own

    def _rows(self, theta: np.ndarray, gravity: np.ndarray, base: Base) -> np.ndarray:
        """Return the torque (m, n, k) in Nm of moments of 1 kg m at `theta` (m, n) rad. gravity: (m, 3) m/s^2."""
        rows_at, rows = self._rows_at(base), np.empty((len(theta), len(self.names), len(base)))
        downs = np.broadcast_to(gravity, (len(theta), 3))
        for row, down, at in zip(rows, downs, self.moves.configurations(theta), strict=True):
            row[:] = rows_at(at, down)
        return rows

    def _rows_at(self, base: Base) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """Return a function that returns the same (n, k) for one configuration and gravity (3,) in m/s^2.

        Its model is its own: another thread may use the arm.
        """
        model, data = self._model.copy(), self._model.createData()
        model.gravity.angular, still, shape = np.zeros(3), np.zeros(model.nv), (len(self.names), -1, INERTIAL)
        links, ways = zip(*base, strict=True)
        columns, along = np.take(self._joints, links) - 1, np.array(ways)

        def rows_at(at: np.ndarray, gravity: np.ndarray) -> np.ndarray:
            model.gravity.linear = gravity
            rows = self._pin.computeJointTorqueRegressor(model, data, at, still, still).reshape(model.nv, -1)
            parts = (self.moves.own.T @ rows).reshape(shape)[..., MOMENT]
            return np.einsum("nka,ka->nk", parts[:, columns], along)

        return rows_at

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
        for name in ("scale", "links"):
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
        torque = self._pin.computeGeneralizedGravity(model, self._data, self.moves.configuration(theta))
        return tuple((self.gain * (self.moves.own.T @ torque)).tolist())
