"""The arm as gravity sees it: four links, each with a length, a mass and a centre of gravity.

Table 1 of the paper (standard Denavit-Hartenberg): a = `length`, alpha = (-pi/2, +pi/2, 0, 0), d = 0, joint offsets
(0, -pi/2, 0, 0), z0 along gravity when the trunk is upright. Joint order everywhere: shoulder rotation about the
vertical, shoulder abduction, shoulder flexion, elbow flexion. theta = (any, 0, 0, 0) is the arm hanging.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from exo_gravity.core.errors import ParameterError

JOINT_COUNT = 4
STANDARD_GRAVITY = 9.80665  # m/s^2, ISO 80000-3; the paper rounds to 9.8

# Bounds that catch a slip of the unit, not a design: grams for kilograms, millimetres for metres.
MAX_LENGTH = 1.0  # m
MAX_MASS = 20.0  # kg per link: a whole arm of a 150 kg person weighs about 8 kg
MAX_TOTAL_MASS = 40.0  # kg, of all links together
MAX_GAIN = 2.0
MAX_GRAVITY = 25.0  # m/s^2


def four_floats(name: str, values: Sequence[float], low: float, high: float, unit: str = "") -> np.ndarray:
    """Return `values` as a read-only array (4,), or raise ParameterError unless they are 4 numbers in [low, high]."""
    expected = f"{JOINT_COUNT} numbers from {low:g} to {high:g}{' ' + unit if unit else ''}"
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(name, values, expected) from None
    # NaN fails both comparisons, so "not all inside" refuses it too.
    if array.shape != (JOINT_COUNT,) or not np.all((array >= low) & (array <= high)):
        raise ParameterError(name, values, expected)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Lengths, centres of gravity, masses and gains of a 4-joint arm.

    length: (4,) m, link lengths l_n (the a_n of Table 1).
    cog: (4,) m, distance d_n of link n's centre of gravity from joint n along the link, 0 <= d_n <= l_n.
    mass: (4,) kg, link masses m_n.
    gain: (4,) the paper's c_n, which scales the torque of joint n; 0..2, by default 1.
    gravity: m/s^2.

    Immutable; raises ParameterError that names the offending value. Derived, in plain floats for the control loop:
    `first_moment`, M1..M4 in kg m: the mass of link n times d_n, and all mass beyond it times l_n;
    `scale`, c_n times gravity.
    """

    length: np.ndarray
    cog: np.ndarray
    mass: np.ndarray
    gain: np.ndarray = (1.0, 1.0, 1.0, 1.0)
    gravity: float = STANDARD_GRAVITY
    first_moment: tuple[float, ...] = field(init=False, repr=False)
    scale: tuple[float, ...] = field(init=False, repr=False)

    def __post_init__(self):
        length = four_floats("length", self.length, 0.0, MAX_LENGTH, "m")
        cog = four_floats("cog", self.cog, 0.0, MAX_LENGTH, "m")
        if np.any(cog > length):
            raise ParameterError("cog", self.cog, f"within its link, at most length = {length.tolist()} m")
        mass = four_floats("mass", self.mass, 0.0, MAX_MASS, "kg")
        gain = four_floats("gain", self.gain, 0.0, MAX_GAIN)
        gravity = one_float("gravity", self.gravity, 0.0, MAX_GRAVITY, "m/s^2")
        beyond = np.append(np.cumsum(mass[::-1])[-2::-1], 0.0)  # mass carried at the far end of each link
        moment = tuple((mass * cog + beyond * length).tolist())
        scale = tuple((gain * gravity).tolist())
        for name, value in zip(
            self.__dataclass_fields__, (length, cog, mass, gain, gravity, moment, scale), strict=False
        ):
            object.__setattr__(self, name, value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ArmModel) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple:
        return (*(tuple(a.tolist()) for a in (self.length, self.cog, self.mass, self.gain)), self.gravity)

    @property
    def total_mass(self) -> float:
        """Mass of the four links in kg."""
        return float(self.mass.sum())

    def with_wearer(self, mass: Sequence[float], cog: Sequence[float], support: float = 1.0) -> ArmModel:
        """Return this arm carrying `support` (0..1) of a wearer's arm: Zero-G where it is 1, One-G where it is 0.

        mass: (4,) kg and cog: (4,) m of the wearer's segments on each link. Masses add, and so do first moments.
        """
        mass = four_floats("wearer.mass", mass, 0.0, MAX_MASS, "kg") * one_float("support", support, 0.0, 1.0)
        cog = four_floats("wearer.cog", cog, 0.0, MAX_LENGTH, "m")
        if np.any(cog > self.length):
            raise ParameterError("wearer.cog", cog, f"within its link, at most length = {self.length.tolist()} m")
        total = self.mass + mass
        moment = self.mass * self.cog + mass * cog
        combined = np.divide(moment, total, out=self.cog.copy(), where=total > 0)
        return ArmModel(self.length, np.minimum(combined, self.length), total, self.gain, self.gravity)


def one_float(name: str, value: float, low: float, high: float, unit: str = "") -> float:
    """Return `value` as a float, or raise ParameterError unless it is one number in [low, high]."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not low <= number <= high:
        raise ParameterError(name, value, f"a number from {low:g} to {high:g}{' ' + unit if unit else ''}")
    return number
