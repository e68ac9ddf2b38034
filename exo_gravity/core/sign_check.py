"""Checks, before an arm is carried, that each motor pushes its joint the way its encoder counts.

While the arm hangs, joint after joint: wait until it is still, push it gently and slowly under damping until it moves
by about a degree, release. A joint that moves backwards has its torque or its encoder reversed: gravity compensation
would double its weight. A joint that does not move has no torque, or is held.

This check cannot detect a `direction` that reverses torque and encoder alike: such a joint moves as expected.
"""

from __future__ import annotations

from collections.abc import Sequence

from exo_gravity.core.faults import Fault, FaultCode
from exo_gravity.core.limits import JointSample

RISE = 2.0  # Nm/s
FALL = 10.0  # Nm/s
MOVED = 0.02  # rad; fifty codes of the position
STILL = 0.003  # rad within which a joint counts as still
STILL_TIME = 0.2  # s for which it must stay within STILL
PUSH_TIMEOUT = 0.5  # s at full torque
REST_TIMEOUT = 5.0  # s for the joint to come to rest


class SignCheck:
    """The check of four joints. effort: (4,) Nm to apply now. done: whether every joint has passed.

    torque: (4,) Nm, the largest push on each joint; a joint with 0 is skipped. rate: Nm/s, the fastest change.
    """

    def __init__(self, names: Sequence[str], torque: Sequence[float], rate: float) -> None:
        self.effort = [0.0] * len(names)
        self._names = names
        self._torque = torque
        self._rise, self._fall = min(RISE, rate), min(FALL, rate)
        self._joint, self._start, self._passed = 0, float("inf"), False
        self._still = self._waited = 0.0
        self.done = False
        self._start_joint(0)

    def step(self, dt: float, joints: Sequence[JointSample]) -> Fault | None:
        """Advance by `dt` s with the joints' readings; return the fault that they show, if any."""
        if self.done:
            return None
        moved = joints[self._joint].position - self._start
        push, most = self.effort[self._joint], self._torque[self._joint]
        if self._passed:
            self.effort[self._joint] = max(0.0, push - self._fall * dt)
            if push == 0.0:
                self._start_joint(self._joint + 1)
        elif self._still < STILL_TIME:
            return self._settle(dt, joints[self._joint].position)
        elif moved <= -MOVED:
            return self._fault(FaultCode.WRONG_SIGN, f"{push:.2f} Nm moved it backwards: torque or encoder is reversed")
        elif moved >= MOVED:
            self._passed = True
        elif push >= most and self._waited > PUSH_TIMEOUT:
            return self._fault(FaultCode.SIGN_UNPROVEN, f"{push:.2f} Nm did not move it: let it hang freely")
        else:
            self._waited += dt if push >= most else 0.0
            self.effort[self._joint] = min(most, push + self._rise * dt)
        return None

    def _start_joint(self, joint: int) -> None:
        while joint < len(self._names) and not self._torque[joint]:
            joint += 1
        self._joint = joint
        self.done = joint == len(self._names)
        self._start = float("inf")
        self._still = self._waited = 0.0
        self._passed = False

    def _settle(self, dt: float, position: float) -> Fault | None:
        self._still += dt
        self._waited += dt
        if not abs(position - self._start) <= STILL:
            self._start, self._still = position, 0.0
        if self._still >= STILL_TIME:
            self._waited = 0.0
        elif self._waited > REST_TIMEOUT:
            return self._fault(FaultCode.SIGN_UNPROVEN, "it does not come to rest: let it hang freely")
        return None

    def _fault(self, code: FaultCode, reason: str) -> Fault:
        return Fault(code, f"{self._names[self._joint]}: {reason}")
