"""The estimate against the accelerometer: for drivers that report an orientation that they do not have, or upside down.

The two differ while the trunk accelerates. But if they differ for long, and the accelerometer shows 1 g all the while,
the orientation is wrong.
"""

from __future__ import annotations

import math

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.quaternion import Floats3

MAX_CONTRADICTION = math.radians(20.0)
CONTRADICTION_TIME = 0.5  # s; less than the time to settle, so that a wrong orientation is never used
QUIET_TIME = 0.15  # s over which the acceleration must be near 1 g
QUIET = 0.1  # share of 1 g


class GravityCheck:
    """Follows one estimate. deviation: of the acceleration's length from 1 g, over QUIET_TIME, as a share of 1 g."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin anew with the next sample."""
        self.deviation = 0.0
        self._contradicted = 0.0  # s

    @property
    def is_quiet(self) -> bool:
        """Whether the accelerometer shows little but gravity."""
        return self.deviation < QUIET

    def update(self, dt: float, up: Floats3, acceleration: Floats3 | None) -> None:
        """Raise ParameterError once `up`, the world's z axis in the IMU's axes, has been contradicted for too long."""
        if acceleration is not None:
            x, y, z = acceleration
            norm = math.hypot(x, y, z)
            now = abs(norm / STANDARD_GRAVITY - 1.0)
            self.deviation += (now - self.deviation) * min(1.0, dt / QUIET_TIME)
            if self.is_quiet and now < QUIET:
                contradicts = up[0] * x + up[1] * y + up[2] * z < norm * math.cos(MAX_CONTRADICTION)
                self._contradicted = self._contradicted + dt if contradicts else 0.0
        if self._contradicted > CONTRADICTION_TIME:
            limit = math.degrees(MAX_CONTRADICTION)
            expected = f"within {limit:g} degrees of the accelerometer at rest: check the IMU's axes, units and signs"
            raise ParameterError("gravity_in_imu", [round(-component, 2) for component in up], expected)
