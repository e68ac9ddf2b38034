# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A compensator that a test drives through time."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from exo_gravity.core.compensation.compensator import Compensation, Compensator
from exo_gravity.core.compensation.settings import Settings

from . import ROBOT

THETA = (0.2, 0.7, 0.6, 0.5)  # rad
PERIOD = 0.002  # s


def settings_with(**changes: Any) -> Settings:
    """Return settings of a left arm without an IMU, with `changes`."""
    defaults = {
        "side": "left",
        "robot": ROBOT,
        "support": 1.0,
        "wearer_mass": (0.0, 0.0, 2.0, 1.6),
        "wearer_cog": (0.0, 0.0, 0.16, 0.17),
        "max_effort": (9.0, 18.0, 9.0, 9.0),
        "use_imu": False,
    }
    return Settings(**{**defaults, **changes})


class CompensatorRun:
    """A compensator, its clock `now` in s, and all `efforts` (4,) in Nm so far."""

    def __init__(self, **changes: Any) -> None:
        self.compensator = Compensator(settings_with(**changes))
        self.now = 50.0
        self.efforts: list[Sequence[float] | None] = []

    def cycle(
        self,
        seconds: float = PERIOD,
        theta: Sequence[float] = THETA,
        period: float = PERIOD,
        velocity: Sequence[float] | None = (0.0,) * 4,
    ) -> Compensation:
        """Run the compensator for `seconds`, at least one cycle, and return its last answer."""
        for _ in range(max(1, round(seconds / period))):
            self.now += period
            answer = self.compensator.step(self.now, theta, velocity)
            self.efforts.append(answer.effort)
        return answer

    @property
    def largest_step(self) -> float:
        """The largest torque step in Nm between two cycles."""
        return float(np.abs(np.diff(np.array(self.efforts), axis=0)).max())
