"""Whether an arm is at rest, judged by position: a damped arm can creep at less than one code of the velocity."""

from __future__ import annotations

import math
from collections.abc import Sequence

from exo_gravity.core.safety.limits import UNKNOWN, JointSample

SETTLED = 0.005  # rad that a joint at rest may turn
SETTLING_TIME = 0.5  # s


class RestTracker:
    """Follows four joints. since: s, the time since which no replying joint has turned by more than SETTLED."""

    def __init__(self) -> None:
        self.since = -math.inf
        self._reference: Sequence[JointSample] = (UNKNOWN,) * 4

    def step(self, now: float, joints: Sequence[JointSample], silent: Sequence[bool]) -> None:
        """Take the newest readings at `now` (s); silent: (4,) whose motor does not reply."""
        moved = (
            not is_silent and not abs(joint.position - reference.position) <= SETTLED
            for joint, reference, is_silent in zip(joints, self._reference, silent, strict=True)
        )
        if any(moved):
            self.since, self._reference = now, joints
        if not any(silent):
            return
        # A silent joint may have moved by the time it replies again.
        self._reference = [
            UNKNOWN if is_silent else reference for reference, is_silent in zip(self._reference, silent, strict=True)
        ]

    def is_settled(self, now: float) -> bool:
        """Return whether no replying joint has moved for SETTLING_TIME."""
        return now - self.since >= SETTLING_TIME
