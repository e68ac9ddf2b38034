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
from exo_gravity.core.model.rotation import Floats3
from exo_gravity.core.numbers import one_float

# The usual widest ranges of a MEMS sensor, and those that any sensor may have.
GYROSCOPE_RANGE, GYROSCOPE_RANGES = 34.9, (1.0, 200.0)  # rad/s; 2000 deg/s
ACCELEROMETER_RANGE, ACCELEROMETER_RANGES = 156.9, (15.0, 4000.0)  # m/s^2; 16 g
SATURATED = 0.995  # share of the range
BEYOND = 1.03  # share of the range: scale factors of MEMS sensors are wrong by up to 3 %
DEAD = 0.02  # m/s^2: even in free fall noise and bias make more
ALMOST_NOTHING = 1.5  # m/s^2
SAME = 0.15  # share of 1 g


class ImuSample(NamedTuple):
    """One sample in the IMU's own axes; None marks what the IMU does not report.

    Without an orientation the other two are required.
    """

    #: s, when it was taken, not when it arrived
    time: float
    #: (3,) rad/s
    angular_velocity: Sequence[float] | None
    #: (3,) m/s^2, +9.8 upward at rest (REP-145)
    acceleration: Sequence[float] | None
    #: (x, y, z, w), world from IMU, world z up
    orientation: Sequence[float] | None = None


class Ranges:
    """The sensor's ranges, each for one axis."""

    def __init__(self, gyroscope: float, accelerometer: float) -> None:
        """Take the ranges in rad/s and m/s^2. Raises ParameterError for one that no IMU has."""
        self.gyroscope = one_float("gyroscope_range", gyroscope, *GYROSCOPE_RANGES, "rad/s")
        self.accelerometer = one_float("accelerometer_range", accelerometer, *ACCELEROMETER_RANGES, "m/s^2")
        self._usual = SATURATED * self.gyroscope, SATURATED * self.accelerometer

    def angular_velocity(self, values: Sequence[float] | None) -> tuple[Floats3, bool]:
        """Return the rates, and whether one is saturated; raises ParameterError if one is impossible."""
        rate = x, y, z = three_floats("angular_velocity", values)
        usual = self._usual[0]
        if -usual < x < usual and -usual < y < usual and -usual < z < usual:
            return rate, False
        if max(map(abs, rate)) > BEYOND * self.gyroscope:
            expected = f"at most gyroscope_range = {self.gyroscope:.4g} rad/s about each axis (is it in deg/s?)"
            raise ParameterError("angular_velocity", rate, expected)
        return rate, True

    def acceleration(self, values: Sequence[float] | None, last: Floats3 | None) -> Floats3 | None:
        """Return the acceleration, None if an axis is saturated; raises ParameterError if it is impossible.

        last: the acceleration before it, None at first.
        """
        acceleration = x, y, z = three_floats("linear_acceleration", values)
        usual, square = self._usual[1], x * x + y * y + z * z
        if square > ALMOST_NOTHING**2 and -usual < x < usual and -usual < y < usual and -usual < z < usual:
            return acceleration
        largest = max(map(abs, acceleration))
        expected = ""
        if largest > BEYOND * self.accelerometer:
            expected = f"at most accelerometer_range = {self.accelerometer:.4g} m/s^2 along each axis"
        elif largest < DEAD:
            expected = "not zero, as a dead accelerometer reports"
        elif last and square < ALMOST_NOTHING**2:
            in_g = tuple(STANDARD_GRAVITY * component for component in acceleration)
            expected = "in m/s^2, not in g" if math.dist(in_g, last) < SAME * STANDARD_GRAVITY else ""
        if expected:
            raise ParameterError("linear_acceleration", acceleration, expected)
        return acceleration if largest < usual else None


def three_floats(name: str, values: Sequence[float] | None) -> Floats3:
    """Return `values` as 3 finite floats, or raise ParameterError that names them."""
    try:
        x, y, z = map(float, values)  # type: ignore[arg-type]  # None is one of the wrong values
        if -math.inf < x + y + z < math.inf:
            return x, y, z
    except (TypeError, ValueError):
        pass
    raise ParameterError(name, values, "3 finite numbers")
