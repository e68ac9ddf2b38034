# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What motors did while the control loop stood still: whether their own time-out took their torque away.

A motor's firmware may let go of its joint if no command comes for a while, without damping and without a word, and the
next command brings the torque back at once (docs/wiring.md). A reply only follows that command: so the first one after
a pause is given with full damping, and the readings that follow tell whether a joint fell meanwhile.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.motors.joint_motor import UNKNOWN, JointSample
from exo_gravity.core.safety.drive import Fault, FaultCode


@dataclass(frozen=True)
class Stall:
    """What a fall in a pause of the loop looks like."""

    late: float = 0.03  #: s beyond the period of the loop; ordinary computers are late by 0.02 s
    least: float = 0.5  #: Nm that a motor must have applied: a joint that carries nothing falls nowhere
    #: rad/s that a joint gains against that torque: a fall of 20 ms under gravity alone, or a wearer's hard push
    gained: float = 0.3


STALL = Stall()


class StallWatch:
    """Follows the commands of an arm that is carried. names: of the joints (n,). period: s, of the loop."""

    def __init__(self, names: Sequence[str], period: float) -> None:
        self._names = names
        self._longest = period + STALL.late
        self._last = math.inf  # s, of the last command
        self._effort: Sequence[float] = ()
        self._before: Sequence[JointSample] = ()  # the readings before a pause, until the ones after it are judged
        self._resumed = math.inf  # s
        self._gap = 0.0

    def reset(self) -> None:
        """Begin anew, as an arm that is not carried does."""
        self._last, self._before = math.inf, ()

    def step(self, now: float, joints: Sequence[JointSample], effort: Sequence[float]) -> tuple[bool, Fault | None]:
        """Return whether the loop has just stood still, and the fault that the readings after a pause show.

        joints: (n,) the newest readings. effort: (n,) Nm, of the last command.
        """
        gap, self._last = now - self._last, now
        if gap > self._longest:
            self._before, self._effort, self._resumed, self._gap = joints, effort, now, gap
            return True, None
        if not self._before or not all(joint.time >= self._resumed for joint in joints):
            return False, None
        before, self._before = self._before, ()
        for name, old, new, torque in zip(self._names, before, joints, self._effort, strict=True):
            gained = (new.velocity - old.velocity) * math.copysign(1.0, torque)
            if abs(torque) >= STALL.least and gained < -STALL.gained and old is not UNKNOWN:
                reason = (
                    f"{name} fell while the loop stood still for {1000.0 * self._gap:.0f} ms: "
                    "its motor's own time-out is shorter; set it to 0.15 to 0.5 s"
                )
                return False, Fault(FaultCode.TORQUE_DIPPED, reason, name)
        return False, None
