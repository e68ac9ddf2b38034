"""Detects one axis that repeats its value while the trunk turns.

The noise of a MEMS sensor changes each axis from sample to sample, except at rest where its steps are coarse. So a
repeated value counts only when the trunk turned meanwhile by what the axis should have shown:
- gyroscope: the other axes turned by more than 3 degrees while the accelerometer is too unsteady to tell whether they
  were all, or the accelerometer turned by 3 degrees more than the estimate;
- accelerometer: gravity turned along the axis by more than 1 m/s^2.
"""

from __future__ import annotations

import math

from exo_gravity.core.arm import STANDARD_GRAVITY
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.quaternion import Floats3

LEAST_COUNT = 5  # equal values
SURE_TIME = 0.05  # s
TURN = math.radians(3.0)
ACCELERATION = 1.0  # m/s^2
NEAR_GRAVITY = 0.15  # share of 1 g
AXES = "xyz"


class StuckAxis:
    """Follows one IMU that reports no orientation. is_stuck: an axis is; is_sure: it has been for SURE_TIME."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin anew with the next sample."""
        self.is_stuck = False
        self._stuck_time = 0.0  # s
        self._rate: Floats3 = (math.nan,) * 3
        self._acceleration: Floats3 = (math.nan,) * 3
        self._counts = [0] * 6  # of equal values, gyroscope and accelerometer
        self._turns = [0.0] * 3  # rad by the other axes while a gyroscope's axis repeated its value
        self._ups = [0.0] * 3  # of the estimate's vertical, when an accelerometer's axis began to repeat its value

    def update(self, dt: float, up: Floats3, rate: Floats3, acceleration: Floats3) -> None:
        """Raise ParameterError if an axis is stuck. up: the estimate's vertical in the IMU's axes."""
        counts = self._counts
        self._stuck_time = self._stuck_time + dt if self.is_stuck else 0.0
        self.is_stuck = False
        self._rate, last_rate = rate, self._rate
        self._acceleration, last_acceleration = acceleration, self._acceleration
        for axis in range(3):
            if rate[axis] != last_rate[axis]:
                counts[axis], self._turns[axis] = 0, 0.0
            else:
                counts[axis] += 1
                if counts[axis] >= LEAST_COUNT:
                    self._check_gyroscope(axis, dt, up, rate, acceleration)
            if acceleration[axis] != last_acceleration[axis]:
                counts[3 + axis], self._ups[axis] = 0, up[axis]
            else:
                counts[3 + axis] += 1
                moved = STANDARD_GRAVITY * abs(up[axis] - self._ups[axis])
                if counts[3 + axis] >= LEAST_COUNT and moved > ACCELERATION:
                    self._refuse("linear_acceleration", axis, acceleration)

    @property
    def is_sure(self) -> bool:
        """Whether an axis has been stuck for a while."""
        return self._stuck_time >= SURE_TIME

    def _check_gyroscope(self, axis: int, dt: float, up: Floats3, rate: Floats3, acceleration: Floats3) -> None:
        norm = math.hypot(*acceleration)
        if abs(norm / STANDARD_GRAVITY - 1.0) < NEAR_GRAVITY:
            self._turns[axis] = 0.0
            error = math.dist(up, (acceleration[0] / norm, acceleration[1] / norm, acceleration[2] / norm))
        else:
            self._turns[axis] += math.hypot(*rate[:axis], *rate[axis + 1 :]) * dt
            error = self._turns[axis]
        if error > TURN:
            self._refuse("angular_velocity", axis, rate)

    def _refuse(self, name: str, axis: int, values: Floats3) -> None:
        self.is_stuck = True
        expected = f"different from sample to sample while the trunk turns: the {AXES[axis]} axis is stuck"
        raise ParameterError(name, values, expected)
