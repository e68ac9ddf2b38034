"""Riding through: for a moment the last efforts, and damping that rises, hold the arm as well as new efforts would.

A compensator that is late for a moment on a busy computer, or whose tilt is late, needs no descent. While efforts are
older than `command_timeout`, or computed from a late tilt, the motors apply the newest ones, and their damping rises as
in a descent; once the efforts are sound again it falls, and the arm is carried on. The ride ends in a fault once it is
too long, efforts are too old, or they have been late too often: ordinary computers are late for less than RECOVERY of
the time. Up to LONGEST_AGE an arm that moves on at 1 rad/s makes the torque wrong by 18 % of gravity's largest.
"""

from __future__ import annotations

import math

from exo_gravity.core.safety.drive import Fault, FaultCode

LONGEST_AGE = 0.18  # s of efforts; less than the break after which the compensator ramps in from zero
LONGEST_RIDE = 0.13  # s
RECOVERY = 0.1  # s of riding that each s with sound efforts makes good


class RideThrough:
    """Whether late efforts may still be used. timeout: s, from which age on efforts are late.

    is_riding: whether they are late and still used. rides: how often that began. why: of the last ride; ended: s, when
    it was last going on.
    """

    def __init__(self, timeout: float) -> None:
        self.is_riding = False
        self.rides = 0
        self.why, self.ended = "", -math.inf
        self._timeout = timeout
        self._left = LONGEST_RIDE

    def step(self, now: float, dt: float, age: float, held: bool) -> Fault | None:
        """Take the `age` (s) of the newest efforts at `now` s; return a fault if they can no longer be used.

        dt: s that the loop ran since the last call. held: whether the efforts are computed from a late tilt.
        """
        if age <= self._timeout and not held:
            self.is_riding = False
            self._left = min(LONGEST_RIDE, self._left + RECOVERY * dt)
            return None
        self.rides += not self.is_riding
        self.is_riding, self.ended = True, now
        self._left -= dt
        self.why = f"efforts {1000.0 * age:.0f} ms old" + (", of a tilt that is late" if held else "")
        if self._left >= 0.0 and age <= LONGEST_AGE:
            return None
        self.is_riding = False
        limit = f"{1000.0 * self._timeout:.0f} ms, or {1000.0 * LONGEST_RIDE:.0f} ms more for a moment"
        return Fault(FaultCode.COMMAND_STALE, f"{self.why}: must be less than {limit}")
