# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arm model: four links, each with a length, and their masses and centres of gravity or their first moments.

Table 1 of the paper (standard Denavit-Hartenberg): a = `length`, alpha = (-pi/2, +pi/2, 0, 0), d = 0, joint offsets
(0, -pi/2, 0, 0), z0 along gravity when the trunk is upright. Joint order everywhere: shoulder rotation about the
vertical, shoulder abduction, shoulder flexion, elbow flexion. At theta = (any, 0, 0, 0) the arm hangs straight down.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, fields
from typing import TypeVar

import numpy as np

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import JOINT_COUNT, Vector, floats, four_floats, one_float
from exo_gravity.core.params import check_owned, owned

STANDARD_GRAVITY = 9.80665  # m/s^2, ISO 80000-3; the paper rounds to 9.8

# These bounds catch wrong units (grams for kilograms, millimetres for metres), not unusual designs.
MAX_LENGTH = 1.0  # m
MAX_MASS = 20.0  # kg per link; the whole arm of a 150 kg person weighs about 8 kg
MAX_PAYLOAD = 5.0  # kg in the hand; at 0.7 m from the shoulder it takes 34 Nm, about twice an AK80-9's peak torque
MAX_REACH = 0.5  # m of its centre of gravity from the hand
MAX_MOMENT = 10.0  # kg m; it takes 98 Nm to hold, several times a motor's peak torque
MAX_WORN_MOMENT = 4.0  # kg m, of a wearer's arm along a link; stretched out, that of a 150 kg person has 2
MAX_WORN_BESIDE = 0.5  # kg m, of the same across the links: 7 kg at 7 cm
MAX_GAIN = 2.0
MAX_GRAVITY = 25.0  # m/s^2

Self = TypeVar("Self", bound="ArmData")

NO_PAYLOAD = (0.0, 0.0, 0.0, 0.0)
NOT_KNOWN = np.full(JOINT_COUNT, np.nan)  # masses and centres of gravity of an arm given by its moments


@dataclass(frozen=True, eq=False, init=False)
class ArmData:
    """Lengths, centres of gravity, masses and gains of a 4-joint arm.

    Immutable. Raises ParameterError that names the invalid value. `from_moments` makes an arm whose masses are not
    known.
    """

    length: np.ndarray  #: (4,) m, link lengths l_n (the a_n of Table 1)
    cog: np.ndarray  #: (4,) m, d_n of link n's centre of gravity from joint n along the link, 0 <= d_n <= l_n
    mass: np.ndarray  #: (4,) kg, link masses m_n
    gain: np.ndarray  #: (4,), the paper's c_n, which scales the torque of joint n; 0..2, 1 by default
    gravity: float  #: m/s^2
    off_axis: tuple[float, ...]  #: (W, Z, Y3, Y4) kg m across the links, see `core.arm.gravity`; 0 by default
    #: M1..M4 in kg m: the mass of link n times d_n plus all mass beyond link n times l_n; plain floats
    first_moment: tuple[float, ...] = field(init=False, repr=False)
    #: (4,) m/s^2, c_n times gravity; plain floats
    scale: tuple[float, ...] = field(init=False, repr=False)
    #: whether the arm was made by `from_moments`; then `cog` and `mass` are NaN
    by_moments: bool = field(init=False, repr=False)
    #: load in the hand, by `with_payload`: kg, and its centre of gravity in m in frame 4; the moments contain it
    payload: tuple[float, float, float, float] = field(init=False, repr=False)

    def __init__(
        self,
        length: Vector,
        cog: Vector,
        mass: Vector,
        gain: Vector = (1.0,) * JOINT_COUNT,
        gravity: float = STANDARD_GRAVITY,
        off_axis: Vector = (0.0,) * JOINT_COUNT,
        first_moment: Vector | None = None,
    ) -> None:
        lengths = four_floats("length", length, 0.0, MAX_LENGTH, "m")
        if first_moment is None:
            cogs = four_floats("cog", cog, 0.0, MAX_LENGTH, "m")
            if np.any(cogs > lengths):
                raise ParameterError("cog", cog, f"within its link, at most length = {lengths.tolist()} m")
            masses = four_floats("mass", mass, 0.0, MAX_MASS, "kg")
            moments = moments_along(lengths, cogs, masses)
        else:
            cogs = masses = NOT_KNOWN
            moments = four_floats("first_moment", first_moment, 0.0, MAX_MOMENT, "kg m")
        gains = four_floats("gain", gain, 0.0, MAX_GAIN)
        gravity = one_float("gravity", gravity, 0.0, MAX_GRAVITY, "m/s^2")
        across = tuple(four_floats("off_axis", off_axis, -MAX_MOMENT, MAX_MOMENT, "kg m").tolist())
        scale = tuple((gains * gravity).tolist())
        given = (lengths, cogs, masses, gains, gravity, across, tuple(moments.tolist()), scale, masses is NOT_KNOWN)
        values = (*given, NO_PAYLOAD)
        for own_field, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, own_field.name, value)

    @classmethod
    def from_moments(
        cls: type[Self],
        length: Vector,
        first_moment: Vector,
        off_axis: Vector = (0.0,) * JOINT_COUNT,
        gain: Vector = (1.0,) * JOINT_COUNT,
        gravity: float = STANDARD_GRAVITY,
    ) -> Self:
        """Return the arm with links of `length` (4,) m that is given by its moments, (4,) kg m each.

        first_moment: M1..M4, 0..MAX_MOMENT. The other arguments are those of the constructor. Raises ParameterError.
        """
        return cls(length, NOT_KNOWN, NOT_KNOWN, gain, gravity, off_axis, first_moment)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ArmData) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[object, ...]:
        arrays = (self.length, self.gain, self.cog, self.mass)
        return (*(a.tobytes() for a in arrays), self.first_moment, self.off_axis, self.gravity, self.payload)

    @property
    def total_mass(self) -> float:
        """Mass of links and load in kg; of an arm given by its moments, the least mass that can have them."""
        if not self.by_moments:
            return float(self.mass.sum()) + self.payload[0]
        moment = np.array(self.first_moment)
        return float(np.max(np.divide(moment, self.length, out=np.zeros(JOINT_COUNT), where=self.length > 0)))

    def check_masses(self, what: str) -> None:
        """Raise ParameterError unless masses are known and all centres of gravity lie on the links, as `what` needs."""
        if self.payload[0]:
            raise ParameterError("payload.mass", self.payload[0], f"0 for {what}, which knows no load in the hand")
        if self.by_moments:
            raise ParameterError("robot.first_moment", self.first_moment, f"0 for {what}, which needs mass and cog")
        if any(self.off_axis):
            raise ParameterError("robot.off_axis", self.off_axis, f"0 for {what}, which knows no moments across links")

    def with_payload(self: Self, mass: float, cog: Vector = (0.0, 0.0, 0.0)) -> Self:
        """Return this arm with a load of `mass` kg in its hand, instead of any other.

        cog: (3,) m, its centre of gravity in frame 4 of Table 1: from the end of link 4, along link 4 (x_4), across it
        in the plane in which the elbow bends (y_4), and along the elbow's axis (z_4). Raises ParameterError.
        """
        mass = one_float("payload.mass", mass, 0.0, MAX_PAYLOAD, "kg")
        loaded, bare = copy(self), _payload_moments(self.length, self.payload)
        payload = (mass, *floats("payload.cog", cog, 3, -MAX_REACH, MAX_REACH, "m").tolist())
        change = _payload_moments(self.length, payload) - bare
        for name, moments in zip(("first_moment", "off_axis"), change, strict=True):
            object.__setattr__(loaded, name, tuple(np.add(getattr(self, name), moments).tolist()))
        object.__setattr__(loaded, "payload", payload)
        return loaded

    def with_wearer(self: Self, mass: Vector, cog: Vector, support: float = 1.0) -> Self:
        """Return this arm plus a share `support` (0..1) of the wearer's arm: 0 is One-G, 1 is full Zero-G.

        mass: (4,) kg and cog: (4,) m of the wearer's segments on each link. Masses add up, and so do first moments.
        """
        carried = four_floats("wearer.mass", mass, 0.0, MAX_MASS, "kg") * one_float("support", support, 0.0, 1.0)
        distance = four_floats("wearer.cog", cog, 0.0, MAX_LENGTH, "m")
        if np.any(distance > self.length):
            raise ParameterError("wearer.cog", cog, f"within its link, at most length = {self.length.tolist()} m")
        bare, scale = self.with_payload(0.0), (self.gain, self.gravity)
        if self.by_moments:
            moment = np.add(bare.first_moment, moments_along(self.length, distance, carried))
            worn = type(self).from_moments(self.length, moment, bare.off_axis, *scale)
        else:
            total = self.mass + carried
            moment = self.mass * self.cog + carried * distance
            combined = np.divide(moment, total, out=self.cog.copy(), where=total > 0)
            worn = type(self)(self.length, np.minimum(combined, self.length), total, *scale, bare.off_axis)
        return worn.with_payload(self.payload[0], self.payload[1:])

    def with_wearer_moments(self: Self, moments: Sequence[Vector], support: float = 1.0) -> Self:
        """Return this arm plus a share `support` (0..1) of a wearer's arm that is known by its moments.

        moments: what it adds to M1..M4 and to W, Z, Y3, Y4, (2, 4) kg m. Raises ParameterError.
        """
        first_moment, off_axis = moments
        share = one_float("support", support, 0.0, 1.0)
        along = four_floats("wearer.first_moment", first_moment, 0.0, MAX_WORN_MOMENT, "kg m")
        across = four_floats("wearer.off_axis", off_axis, -MAX_WORN_BESIDE, MAX_WORN_BESIDE, "kg m")
        bare = self.with_payload(0.0)
        whole = bare.first_moment + share * along, bare.off_axis + share * across
        worn = type(self).from_moments(self.length, *whole, self.gain, self.gravity)
        return worn.with_payload(self.payload[0], self.payload[1:])


@dataclass(frozen=True)
class ModelError:
    """How exactly an arm's model is known, as standard errors. Raises ParameterError."""

    torque: Sequence[float] = owned(
        (0.3, 0.3, 0.3, 0.1), "standard error of the robot's torque, by `calibrate`", (0.0, 5.0), "Nm"
    )
    scale: Sequence[float] = owned(
        (0.1,) * JOINT_COUNT,
        "standard error of torque_scale, as a share of it, by `calibrate`",
        (0.0, 1.0),
    )
    wearer: float = owned(
        0.15, "standard error of the wearer's arm's weight, as a share of it, by `calibrate`", (0.0, 1.0)
    )
    tilt: float = owned(0.0175, "standard error of the trunk's tilt", (0.0, 0.5), "rad")
    wearer_torque: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT,
        "standard error of the torque of the wearer's passive arm beyond that share, by `calibrate`",
        (0.0, 5.0),
        "Nm",
    )
    deflection: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT,
        "standard error of each link's angle behind its motor: play, and elasticity beyond `joint_stiffness`",
        (0.0, 0.2),
        "rad",
    )

    def __post_init__(self) -> None:
        check_owned(self)


def _payload_moments(length: np.ndarray, payload: Sequence[float]) -> np.ndarray:
    """Return what a load in the hand adds to M1..M4 and to W, Z, Y3, Y4, (2, 4) kg m."""
    mass, x, y, z = payload
    return mass * np.array(((*length[:3], length[3] + x), (0.0, z, 0.0, y)))


def moments_along(length: np.ndarray, cog: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Return the first moments M1..M4 (4,) in kg m: mass n times cog n, plus all mass beyond link n times length n."""
    beyond = np.append(np.cumsum(mass[::-1])[-2::-1], 0.0)
    return np.asarray(mass * cog + beyond * length)
