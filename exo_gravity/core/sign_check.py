"""Before an arm is carried: does each motor push its joint the way its encoder counts?

Joint after joint, while the arm hangs: wait until it is still, push gently and slowly under damping, see it give way by
about a degree, let go. A joint that gives way backwards has its torque or its encoder reversed, and gravity
compensation would double its weight; one that does not give way at all has no torque, or is held.

What this can't see: a `direction` that reverses torque and encoder alike. Such a joint gives way as it should.
"""

from __future__ import annotations

from collections.abc import Sequence

from exo_gravity.core.faults import Fault, FaultCode
from exo_gravity.core.limits import JointSample

RISE = 2.0  # Nm/s
FALL = 10.0  # Nm/s
GAVE_WAY = 0.02  # rad; a hundred codes of the encoder
STILL = 0.003  # rad within which a joint is still,
STILLNESS = 0.2  # s for so long
PATIENCE = 0.5  # s at full torque; and ten times that for the joint to come to rest


class SignCheck:
    """The check of four joints. effort: (4,) Nm to be given now. done: whether every joint has passed.

    torque: the most that each joint is pushed with, in Nm; a joint with 0 is passed over. rate: Nm/s at most.
    """

    def __init__(self, names: Sequence[str], torque: Sequence[float], rate: float):
        self.effort = [0.0] * len(names)
        self._names = names
        self._torque = torque
        self._rise, self._fall = min(RISE, rate), min(FALL, rate)
        self._begin(0)

    def step(self, dt: float, joints: Sequence[JointSample]) -> Fault | None:
        """Go on by `dt` s, given the joints' readings; return the fault that they show, if any."""
        if self.done:
            return None
        moved = joints[self._joint].position - self._start
        push, most = self.effort[self._joint], self._torque[self._joint]
        if self._passed:
            self.effort[self._joint] = max(0.0, push - self._fall * dt)
            if push == 0.0:
                self._begin(self._joint + 1)
        elif self._still < STILLNESS:
            return self._settle(dt, joints[self._joint].position)
        elif moved <= -GAVE_WAY:
            return self._fault(FaultCode.WRONG_SIGN, f"{push:.2f} Nm moved it backwards: torque or encoder is reversed")
        elif moved >= GAVE_WAY:
            self._passed = True
        elif push >= most and self._waited > PATIENCE:
            return self._fault(FaultCode.SIGN_UNPROVEN, f"{push:.2f} Nm did not move it: let it hang freely")
        else:
            self._waited += dt if push >= most else 0.0
            self.effort[self._joint] = min(most, push + self._rise * dt)
        return None

    def _begin(self, joint: int) -> None:
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
        if self._still >= STILLNESS:
            self._waited = 0.0
        elif self._waited > 10 * PATIENCE:
            return self._fault(FaultCode.SIGN_UNPROVEN, "it does not come to rest: let it hang freely")
        return None

    def _fault(self, code: FaultCode, reason: str) -> Fault:
        return Fault(code, f"{self._names[self._joint]}: {reason}")
