"""One sample of an inertial measurement unit (IMU), and the checks that it must pass by itself.

Limits come from the sensor's ranges, not from what a trunk does. A value at the end of the range is saturated: the true
one is not known, only its sign. A value beyond the range cannot come from the sensor: a unit or a parameter is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.quaternion import Floats3
from exo_gravity.core.numbers import one_float

GYROSCOPE_RANGE = math.radians(2000.0)  # rad/s, the usual widest range of a MEMS gyroscope
ACCELEROMETER_RANGE = 16.0 * STANDARD_GRAVITY  # m/s^2
SATURATED = 0.995  # share of the range
BEYOND = 1.03  # share of the range: scale factors of MEMS sensors are wrong by up to 3 %
DEAD = 0.02  # m/s^2: even in free fall noise and bias make more
ALMOST_NOTHING = 1.5  # m/s^2
SAME = 0.15  # share of 1 g


class ImuSample(NamedTuple):
    """One sample in the IMU's own axes.

    time: s, when it was taken, not when it arrived. angular_velocity: (3,) rad/s; acceleration: (3,) m/s^2, +9.8
    upward at rest (REP-145). orientation: (x, y, z, w), world from IMU, world z up. None marks what the IMU does not
    report; without an orientation the other two are required.
    """

    time: float
    angular_velocity: Sequence[float] | None
    acceleration: Sequence[float] | None
    orientation: Sequence[float] | None = None


class Ranges(NamedTuple):
    """The sensor's ranges: gyroscope in rad/s, accelerometer in m/s^2, each for one axis."""

    gyroscope: float = GYROSCOPE_RANGE
    accelerometer: float = ACCELEROMETER_RANGE

    @classmethod
    def of(cls, gyroscope: float, accelerometer: float) -> Ranges:
        """Return checked ranges; raises ParameterError for one that no IMU has."""
        return cls(
            one_float("gyroscope_range", gyroscope, 1.0, 200.0, "rad/s"),
            one_float("accelerometer_range", accelerometer, 15.0, 4000.0, "m/s^2"),
        )

    def angular_velocity(self, values: Sequence[float] | None) -> tuple[Floats3, bool]:
        """Return the rates, and whether one is saturated; raises ParameterError if one is impossible."""
        rate = three_floats("angular_velocity", values)
        largest = max(map(abs, rate))
        if largest > BEYOND * self.gyroscope:
            expected = f"at most gyroscope_range = {self.gyroscope:.4g} rad/s about each axis (is it in deg/s?)"
            raise ParameterError("angular_velocity", rate, expected)
        return rate, largest >= SATURATED * self.gyroscope

    def acceleration(self, values: Sequence[float] | None, last: Floats3 | None) -> tuple[Floats3, bool]:
        """Return the acceleration, and whether an axis is saturated; raises ParameterError if it is impossible.

        last: the acceleration before it, None at first.
        """
        acceleration = three_floats("linear_acceleration", values)
        largest = max(map(abs, acceleration))
        if largest > BEYOND * self.accelerometer:
            expected = f"at most accelerometer_range = {self.accelerometer:.4g} m/s^2 along each axis"
            raise ParameterError("linear_acceleration", acceleration, expected)
        if largest < DEAD:
            raise ParameterError("linear_acceleration", acceleration, "not zero, as a dead accelerometer reports")
        if largest < ALMOST_NOTHING and last is not None and _is_in_g(acceleration, last):
            raise ParameterError("linear_acceleration", acceleration, "in m/s^2, not in g")
        return acceleration, largest >= SATURATED * self.accelerometer


def _is_in_g(acceleration: Floats3, last: Floats3) -> bool:
    """Return whether `last` was at rest, and `acceleration` is the same divided by 9.8."""
    was_at_rest = abs(math.hypot(*last) / STANDARD_GRAVITY - 1.0) < SAME
    x, y, z = (STANDARD_GRAVITY * component for component in acceleration)
    return was_at_rest and math.dist((x, y, z), last) < SAME * STANDARD_GRAVITY


def three_floats(name: str, values: Sequence[float] | None) -> Floats3:
    """Return `values` as 3 finite floats, or raise ParameterError that names them."""
    try:
        x, y, z = map(float, values)  # type: ignore[arg-type]  # None is one of the wrong values
    except (TypeError, ValueError):
        raise ParameterError(name, values, "3 finite numbers") from None
    if not math.isfinite(x + y + z):
        raise ParameterError(name, values, "3 finite numbers")
    return x, y, z
