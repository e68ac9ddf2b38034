"""What the motors' readings show: which motors are silent, and faults that two readings in a row confirm.

Chosen against ordinary equipment: 3 % of the frames lost each way, a computer that is late by 20 ms in one cycle of
ten, adapters that deliver in batches of 1 ms, and a motor that reports one wrong reading now and then.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.drive import Fault, FaultCode
from exo_gravity.core.safety.limits import UNKNOWN, JointSample, Limits

# Cycles in a row without a reply. At 3 % lost each way one arm loses so many in a row once in 270 hours at 100 Hz.
MISSED = 7
# s without a reply, while the motors hold the arm and while they are off, for which a motor's turn count stays trusted
# if its angle is then within `home_tolerance` of the one before: a lost turn is twice as large, less what the joint has
# moved. A forearm whose motor has lost its power falls by 0.3 rad in 0.1 s; an arm that is down, only a person moves.
TRUSTED_SILENCE, TRUSTED_SILENCE_OFF = 0.1, 0.3


class Readings:
    """Follows the readings of an arm's motors, cycle by cycle.

    joints: (4,) the newest ones, less those in doubt: a reading that shows a fault counts once the next one shows one
    too. silent: (4,) whether a motor is silent: no reply for `reply_timeout`, nor in MISSED cycles: a loop that stood
    still has not asked. fault: what the newest readings show, or None. lost: whether a motor may have lost its power
    now, and with it the turn count of its encoder.
    """

    def __init__(self, limits: Limits) -> None:
        self.joints: tuple[JointSample, ...] = (UNKNOWN,) * JOINT_COUNT
        self.silent: Sequence[bool] = (True,) * JOINT_COUNT
        self.fault: Fault | None = None
        self.lost = True
        self._limits = limits
        self._newest = [-math.inf] * JOINT_COUNT  # s
        self._missed = [MISSED] * JOINT_COUNT
        self._asked = [-math.inf] * JOINT_COUNT  # s; each of `joints` was taken later
        self._is_doubted = [False] * JOINT_COUNT
        self._now = -math.inf  # s, of the last cycle

    def step(self, now: float, joints: Sequence[JointSample], powered: bool = True) -> None:
        """Take the newest readings `joints` (4,) in the cycle at `now` s; powered: whether the motors are on."""
        limits = self._limits
        longest = TRUSTED_SILENCE if powered else TRUSTED_SILENCE_OFF
        counting = list(self.joints)
        self.fault, self.lost = None, False
        for i, joint in enumerate(joints):
            if joint.time > self._newest[i]:
                gap = joint.time - self._newest[i]
                moved = abs(joint.position - self.joints[i].position)
                self.lost |= gap > limits.reply_timeout and moved > limits.home_tolerance[i]
                self._newest[i], self._missed[i] = joint.time, 0
                counting[i], fault = self._taken(i, joint)
                self.fault = self.fault or fault
            else:
                self._missed[i] += 1
                self.lost |= self._missed[i] >= MISSED and now - joint.time > longest
        self.joints = tuple(counting)
        asked = zip(joints, self._missed, strict=True)
        self.silent = [missed >= MISSED and limits.is_silent(now, joint) for joint, missed in asked]
        if any(self.silent):
            name = limits.joint_names[self.silent.index(True)]
            reason = f"{name}: no reply for more than {limits.reply_timeout * 1000:.0f} ms"
            self.fault = Fault(FaultCode.MOTOR_SILENT, reason)
        self._now = now

    def _taken(self, i: int, joint: JointSample) -> tuple[JointSample, Fault | None]:
        """Return the reading that counts now, and the fault of `joint` if the reading before it showed one, too."""
        fault = self._limits.find_fault(i, joint, self.joints[i], self._asked[i])
        is_confirmed = self._is_doubted[i]
        self._is_doubted[i] = fault is not None
        if fault and not is_confirmed and self.joints[i] is not UNKNOWN:
            return self.joints[i], None
        self._asked[i] = self._now
        return joint, fault if is_confirmed else None
