"""Detects one axis that repeats its value while the trunk turns.

The noise of a MEMS sensor changes each axis from sample to sample, except at rest where its steps are coarse. So a
repeated value counts only when the trunk turned meanwhile by what the axis should have shown:
- gyroscope: the other axes turned by more than 3 degrees while the accelerometer is too unsteady to tell whether they
  were all, or the accelerometer turned by 3 degrees more than the estimate;
- accelerometer: gravity turned along the axis by more than 1 m/s^2.
"""

from __future__ import annotations

import math
import operator

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.quaternion import Floats3

LEAST_COUNT = 5  # equal values
SURE_TIME = 0.05  # s
TURN = math.radians(3.0)
ACCELERATION = 1.0  # m/s^2
NEAR_GRAVITY = 0.15  # share of 1 g
AXES = "xyz"


class StuckAxis:
    """Follows one IMU that reports no orientation.

    is_stuck: an axis is, by the last sample. is_sure: it has been for SURE_TIME; it is then stuck until its value
    changes, even after a restart.
    """

    def __init__(self) -> None:
        self.is_stuck = self.is_sure = False
        self._values: tuple[float, ...] = (math.nan,) * 6  # gyroscope and accelerometer
        self._counts = [0] * 6  # of equal values
        self._stuck_times = [0.0] * 6  # s
        self._turns = [0.0] * 3  # rad by the other axes while a gyroscope's axis repeated its value
        self._ups = [0.0] * 3  # of the estimate's vertical, when an accelerometer's axis began to repeat its value

    def update(self, dt: float, up: Floats3, rate: Floats3, acceleration: Floats3) -> None:
        """Raise ParameterError if an axis is stuck. up: the estimate's vertical in the IMU's axes."""
        self.is_stuck = self.is_sure = False
        values, last = (*rate, *acceleration), self._values
        self._values = values
        equal = tuple(map(operator.eq, values, last))
        if any(equal) or any(self._counts):
            for axis in range(6):
                if not equal[axis]:
                    self._counts[axis], self._stuck_times[axis] = 0, 0.0
                elif self._repeats(axis, dt, up, rate, acceleration):
                    self._refuse(axis, dt, values)

    def _repeats(self, axis: int, dt: float, up: Floats3, rate: Floats3, acceleration: Floats3) -> bool:
        """Count an equal value; return whether the axis is stuck."""
        if self._counts[axis] == 0:
            if axis < 3:
                self._turns[axis] = 0.0
            else:
                self._ups[axis - 3] = up[axis - 3]
        self._counts[axis] += 1
        return self._counts[axis] >= LEAST_COUNT and self._is_stuck(axis, dt, up, rate, acceleration)

    def _is_stuck(self, axis: int, dt: float, up: Floats3, rate: Floats3, acceleration: Floats3) -> bool:
        if self._stuck_times[axis] >= SURE_TIME:
            return True
        if axis >= 3:
            return STANDARD_GRAVITY * abs(up[axis - 3] - self._ups[axis - 3]) > ACCELERATION
        norm = math.hypot(*acceleration)
        if abs(norm / STANDARD_GRAVITY - 1.0) < NEAR_GRAVITY:
            self._turns[axis] = 0.0
            return math.dist(up, (acceleration[0] / norm, acceleration[1] / norm, acceleration[2] / norm)) > TURN
        self._turns[axis] += math.hypot(*rate[:axis], *rate[axis + 1 :]) * dt
        return self._turns[axis] > TURN

    def _refuse(self, axis: int, dt: float, values: tuple[float, ...]) -> None:
        self._stuck_times[axis] += dt
        self.is_stuck, self.is_sure = True, self._stuck_times[axis] >= SURE_TIME
        name, shown = ("angular_velocity", values[:3]) if axis < 3 else ("linear_acceleration", values[3:])
        expected = f"different from sample to sample while the trunk turns: the {AXES[axis % 3]} axis is stuck"
        raise ParameterError(name, shown, expected)
