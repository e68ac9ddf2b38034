"""The last step before a torque leaves the compensator: ramp in, clamp, rate limit; for any number of joints."""

from __future__ import annotations

import math
from collections.abc import Sequence

RAMP_TIME = 1.0  # s from zero to full torque, at the start and after a break
# s without an answer, after which the torque ramps in from zero. This is longer than any command_timeout: the arm is
# already being let down, so the restart from zero cannot drop it.
BREAK = 0.2
LONGEST_STEP = 0.01  # s counted by the rate limit after a pause, so that the torque does not catch up in one step


class EffortLimiter:
    """Ramp and rate limit of the torques of `count` joints. last_answer: s, when the last torque was limited."""

    def __init__(self, count: int) -> None:
        self.last_answer = -math.inf
        self._zero = self._effort = (0.0,) * count
        self._ramp_start = -math.inf

    def limit(
        self,
        now: float,
        torque: Sequence[float],
        added: Sequence[float],
        max_effort: Sequence[float],
        max_effort_rate: float,
    ) -> tuple[tuple[float, ...], tuple[int, ...]]:
        """Return the effort (n,) in Nm at `now` s, and the indices of the joints whose `torque` exceeds `max_effort`.

        torque, added: (n,) Nm, of gravity and on top of it. max_effort: (n,) Nm. max_effort_rate: Nm/s.
        """
        dt = now - self.last_answer
        if not 0.0 <= dt <= BREAK:
            self._ramp_start, self._effort, dt = now, self._zero, 0.0
        self.last_answer = now
        ramp = min(1.0, (now - self._ramp_start) / RAMP_TIME)
        step = max_effort_rate * min(dt, LONGEST_STEP)
        effort, clamped = [], []
        for joint, (gravity, more, last, limit) in enumerate(zip(torque, added, self._effort, max_effort, strict=True)):
            if not -limit <= gravity <= limit:
                clamped.append(joint)
            wanted = gravity + more
            target = ramp * (limit if wanted > limit else -limit if wanted < -limit else wanted)
            effort.append(last + step if target > last + step else last - step if target < last - step else target)
        self._effort = tuple(effort)
        return self._effort, tuple(clamped)
