"""The arm model: four links, each with a length, a mass and a centre of gravity.

Table 1 of the paper (standard Denavit-Hartenberg): a = `length`, alpha = (-pi/2, +pi/2, 0, 0), d = 0, joint offsets
(0, -pi/2, 0, 0), z0 along gravity when the trunk is upright. Joint order everywhere: shoulder rotation about the
vertical, shoulder abduction, shoulder flexion, elbow flexion. At theta = (any, 0, 0, 0) the arm hangs straight down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from exo_gravity.core.errors import ParameterError

Vector = Sequence[float] | np.ndarray  # numbers in joint order, or the components of a vector

JOINT_COUNT = 4
STANDARD_GRAVITY = 9.80665  # m/s^2, ISO 80000-3; the paper rounds to 9.8

# These bounds catch wrong units (grams for kilograms, millimetres for metres), not unusual designs.
MAX_LENGTH = 1.0  # m
MAX_MASS = 20.0  # kg per link; the whole arm of a 150 kg person weighs about 8 kg
MAX_TOTAL_MASS = 40.0  # kg, all links together
MAX_GAIN = 2.0
MAX_GRAVITY = 25.0  # m/s^2


def four_floats(name: str, values: Vector, low: float, high: float, unit: str = "") -> np.ndarray:
    """Return `values` as a read-only array (4,), or raise ParameterError unless they are 4 numbers in [low, high]."""
    expected = f"{JOINT_COUNT} numbers from {low:g} to {high:g}{' ' + unit if unit else ''}"
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(name, values, expected) from None
    # NaN fails both comparisons, so this check rejects it too.
    if array.shape != (JOINT_COUNT,) or not np.all((array >= low) & (array <= high)):
        raise ParameterError(name, values, expected)
    array.setflags(write=False)
    return array


def one_float(name: str, value: float, low: float, high: float, unit: str = "") -> float:
    """Return `value` as a float, or raise ParameterError unless it is one number in [low, high]."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not low <= number <= high:
        raise ParameterError(name, value, f"a number from {low:g} to {high:g}{' ' + unit if unit else ''}")
    return number


@dataclass(frozen=True, eq=False, init=False)
class ArmModel:
    """Lengths, centres of gravity, masses and gains of a 4-joint arm.

    length: (4,) m, link lengths l_n (the a_n of Table 1).
    cog: (4,) m, distance d_n of link n's centre of gravity from joint n along the link, 0 <= d_n <= l_n.
    mass: (4,) kg, link masses m_n.
    gain: (4,), the paper's c_n, which scales the torque of joint n; 0..2, 1 by default.
    gravity: m/s^2.

    Immutable. Raises ParameterError that names the invalid value. Two derived values, in plain floats for the control
    loop: `first_moment`, M1..M4 in kg m, is the mass of link n times d_n plus all mass beyond link n times l_n;
    `scale` is c_n times gravity.
    """

    length: np.ndarray
    cog: np.ndarray
    mass: np.ndarray
    gain: np.ndarray
    gravity: float
    first_moment: tuple[float, ...] = field(init=False, repr=False)
    scale: tuple[float, ...] = field(init=False, repr=False)

    def __init__(
        self,
        length: Vector,
        cog: Vector,
        mass: Vector,
        gain: Vector = (1.0, 1.0, 1.0, 1.0),
        gravity: float = STANDARD_GRAVITY,
    ) -> None:
        lengths = four_floats("length", length, 0.0, MAX_LENGTH, "m")
        cogs = four_floats("cog", cog, 0.0, MAX_LENGTH, "m")
        if np.any(cogs > lengths):
            raise ParameterError("cog", cog, f"within its link, at most length = {lengths.tolist()} m")
        masses = four_floats("mass", mass, 0.0, MAX_MASS, "kg")
        gains = four_floats("gain", gain, 0.0, MAX_GAIN)
        gravity = one_float("gravity", gravity, 0.0, MAX_GRAVITY, "m/s^2")
        beyond = np.append(np.cumsum(masses[::-1])[-2::-1], 0.0)  # mass carried at the far end of each link
        moment = tuple((masses * cogs + beyond * lengths).tolist())
        scale = tuple((gains * gravity).tolist())
        values = (lengths, cogs, masses, gains, gravity, moment, scale)
        for own_field, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, own_field.name, value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ArmModel) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[object, ...]:
        return (*(tuple(a.tolist()) for a in (self.length, self.cog, self.mass, self.gain)), self.gravity)

    @property
    def total_mass(self) -> float:
        """Mass of the four links in kg."""
        return float(self.mass.sum())

    def with_wearer(self, mass: Vector, cog: Vector, support: float = 1.0) -> ArmModel:
        """Return this arm plus a share `support` (0..1) of the wearer's arm: 0 is One-G, 1 is full Zero-G.

        mass: (4,) kg and cog: (4,) m of the wearer's segments on each link. Masses add up, and so do first moments.
        """
        carried = four_floats("wearer.mass", mass, 0.0, MAX_MASS, "kg") * one_float("support", support, 0.0, 1.0)
        distance = four_floats("wearer.cog", cog, 0.0, MAX_LENGTH, "m")
        if np.any(distance > self.length):
            raise ParameterError("wearer.cog", cog, f"within its link, at most length = {self.length.tolist()} m")
        total = self.mass + carried
        moment = self.mass * self.cog + carried * distance
        combined = np.divide(moment, total, out=self.cog.copy(), where=total > 0)
        return ArmModel(self.length, np.minimum(combined, self.length), total, self.gain, self.gravity)
