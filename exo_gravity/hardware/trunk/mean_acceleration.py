"""The mean acceleration in the world must be gravity, because a person's velocity is bounded.

Over a time T a change of velocity by v shifts the mean by v / T. For a person who starts to walk v is known; for any
other movement it is the deviation of the acceleration from its mean times the time for which it keeps its direction. A
larger shift means that the estimate turns the wrong way (a wrong axis, sign or scale of the gyroscope; a slow clock) or
that the accelerometer is wrong (its unit, a dead axis).
"""

from __future__ import annotations

import math

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.quaternion import Floats3

AVERAGE_TIME = 2.0  # s
OFFSET = 0.04  # share of 1 g: bias and scale of an accelerometer that was never calibrated
WALK = 0.75 / STANDARD_GRAVITY  # s: m/s, per 1 g; 0.45 m/s is needed for an IMU swung in a circle by hand
DIRECTION_TIME = 0.3  # s
LEAST_TIME = 0.5  # s of samples
MEAN = "mean linear_acceleration in the world"


class MeanAcceleration:
    """Follows one estimate."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin anew with the next sample."""
        self._age = 0.0  # s
        self._x = self._y = self._z = 0.0  # mean, in 1 g
        self._square = 0.0  # of the deviation from it

    def update(self, dt: float, acceleration_in_world: Floats3) -> None:
        """Raise ParameterError if the mean of `acceleration_in_world` (3,) m/s^2 cannot be gravity."""
        self._age += dt
        share = dt / (self._age if self._age < AVERAGE_TIME else AVERAGE_TIME) if dt else 1.0
        x, y, z = acceleration_in_world
        x, y, z = x / STANDARD_GRAVITY - self._x, y / STANDARD_GRAVITY - self._y, z / STANDARD_GRAVITY - self._z
        self._x, self._y, self._z = self._x + share * x, self._y + share * y, self._z + share * z
        self._square += share * ((1.0 - share) * (x * x + y * y + z * z) - self._square)
        if self._age < LEAST_TIME or not dt:
            return
        shift = math.hypot(self._x, self._y, self._z - 1.0)
        limit = OFFSET + (WALK + DIRECTION_TIME * math.sqrt(self._square)) / min(self._age, AVERAGE_TIME)
        if shift > limit:
            mean = [round(STANDARD_GRAVITY * component, 2) for component in (self._x, self._y, self._z)]
            expected = f"within {STANDARD_GRAVITY * limit:.2f} m/s^2 of gravity upwards: check units, axes and signs"
            raise ParameterError(MEAN, mean, expected)
