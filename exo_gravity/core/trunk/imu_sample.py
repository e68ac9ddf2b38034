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


def check_living(acceleration: Floats3, last: Floats3 | None) -> None:
    """Raise ParameterError for an accelerometer that is dead, or in g; last: the acceleration before, None at first."""
    x, y, z = acceleration
    if x * x + y * y + z * z > ALMOST_NOTHING**2:
        return
    if max(map(abs, acceleration)) < DEAD:
        raise ParameterError("linear_acceleration", acceleration, "not zero, as a dead accelerometer reports")
    if last and math.dist([STANDARD_GRAVITY * v for v in acceleration], last) < SAME * STANDARD_GRAVITY:
        raise ParameterError("linear_acceleration", acceleration, "in m/s^2, not in g")


def in_range(values: Sequence[float] | None, name: str, limit: float, expected: str) -> tuple[Floats3, bool]:
    """Return `values` as 3 floats, and whether one is saturated; raise ParameterError if one is beyond `limit`."""
    vector = x, y, z = three_floats(name, values)
    usual = SATURATED * limit
    if -usual < x < usual and -usual < y < usual and -usual < z < usual:
        return vector, False
    if max(map(abs, vector)) > BEYOND * limit:
        raise ParameterError(name, vector, f"at most {expected}")
    return vector, True


def three_floats(name: str, values: Sequence[float] | None) -> Floats3:
    """Return `values` as 3 finite floats, or raise ParameterError that names them."""
    try:
        x, y, z = map(float, values)  # type: ignore[arg-type]  # None is one of the wrong values
        if -math.inf < x + y + z < math.inf:
            return x, y, z
    except (TypeError, ValueError):
        pass
    raise ParameterError(name, values, "3 finite numbers")
