"""The load of the motors over minutes: RMS torque against rated torque, and mechanical power.

A motor's heat grows with the square of its torque, and its rated torque is what it bears for ever. So the mean square
of the torque is averaged over a thermal time constant. THERMAL_TIME is an assumption for motors of this size: the
data sheets state none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from exo_gravity.core.safety.limits import JointSample

THERMAL_TIME = 60.0  # s


class MotorLoad:
    """RMS torque and power of each joint's motor, which starts cold. rated: (n,) Nm, bearable without end."""

    def __init__(self, rated: Sequence[float]) -> None:
        self._rated = tuple(rated)
        self._mean_square = [0.0] * len(self._rated)  # Nm^2
        self._time: float | None = None
        self.power: tuple[float, ...] = (0.0,) * len(self._rated)

    def update(self, now: float, joints: Sequence[JointSample]) -> None:
        """Add the readings `joints` (n,), the newest at `now` s. Ten a second are enough.

        A motor that never replied adds nothing. `power` is then torque times speed in W, > 0 where the motor drives.
        """
        share = 0.0 if self._time is None else -math.expm1(-max(0.0, now - self._time) / THERMAL_TIME)
        self._time = now
        self.power = tuple(0.0 if joint.time == -math.inf else joint.effort * joint.velocity for joint in joints)
        for i, joint in enumerate(joints):
            if joint.time > -math.inf:
                self._mean_square[i] += share * (joint.effort**2 - self._mean_square[i])

    @property
    def rms(self) -> tuple[float, ...]:
        """RMS torque (n,) in Nm."""
        return tuple(map(math.sqrt, self._mean_square))

    @property
    def share(self) -> tuple[float, ...]:
        """RMS torque (n,) as a share of rated torque; above 1 the motor overheats if the load stays."""
        return tuple(rms / rated for rms, rated in zip(self.rms, self._rated, strict=True))
