"""Checks, before an arm is carried, that each motor pushes its joint the way its encoder counts.

While the arm hangs, joint after joint: wait until it is still, push it gently and slowly under damping until it moves
by about a degree, then push it back the other way. A joint that moves backwards has its torque or its encoder reversed:
gravity compensation would double its weight. A joint that does not move has no torque, or is held. A joint that moves
before it is pushed is being moved by the wearer: the check starts again, a few times.

This check cannot detect a `direction` that reverses torque and encoder alike: such a joint moves as expected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from exo_gravity.core.safety.faults import Fault, FaultCode
from exo_gravity.core.safety.limits import JointSample

RISE = 2.0  # Nm/s
FALL = 10.0  # Nm/s
MIN_PUSH = 0.1  # Nm; motion under a smaller push is not caused by it
MOVED = 0.02  # rad; fifty codes of the position
STILL = 0.003  # rad within which a joint counts as still
STILL_TIME = 0.2  # s for which it must stay within STILL
PUSH_TIMEOUT = 0.5  # s at full torque
REST_TIMEOUT = 5.0  # s for the joint to come to rest
MAX_DISTURBED = 5  # times that a joint may move without a push


class SignCheck:
    """The check of four joints. effort: (4,) Nm to apply now. done: whether every joint has passed.

    torque: (4,) Nm, the largest push on each joint; a joint with 0 is skipped. rate: Nm/s, the fastest change.
    hint: what the wearer should do, '' for nothing.
    """

    def __init__(self, names: Sequence[str], torque: Sequence[float], rate: float) -> None:
        self.effort = [0.0] * len(names)
        self.done = False
        self.hint = ""
        self._names = names
        self._torque = torque
        self._rise, self._fall = min(RISE, rate), min(FALL, rate)
        self._joint = -1
        self._disturbed = 0
        self._sign = 1  # of the push; 0 once both pushes have passed
        self._start = math.inf  # where the joint was before the push, rad
        self._still_time = self._waited = 0.0
        self._next_joint()

    def step(self, dt: float, joints: Sequence[JointSample]) -> Fault | None:
        """Advance by `dt` s with the joints' readings; return the fault that they show, if any."""
        if self.done:
            return None
        position = joints[self._joint].position
        if self._still_time < STILL_TIME:
            self._release(dt)
            return self._wait_for_rest(dt, position)
        if self._sign == 0:  # both pushes have passed
            if self._release(dt):
                self._next_joint()
            return None
        return self._push(dt, position)

    def _push(self, dt: float, position: float) -> Fault | None:
        push, most = self.effort[self._joint], self._torque[self._joint]
        moved = self._sign * (position - self._start)
        if moved >= MOVED or moved <= -MOVED:
            if self._sign * push < MIN_PUSH:
                return self._restart()
            if moved < 0.0:
                reason = f"{push:.2f} Nm moved it backwards: torque or encoder is reversed"
                return self._fault(FaultCode.WRONG_SIGN, reason)
            self._turn(position)
        elif abs(push) >= most and self._waited > PUSH_TIMEOUT:
            return self._fault(FaultCode.SIGN_UNPROVEN, f"{push:.2f} Nm did not move it: let it hang freely")
        else:
            self._waited += dt if abs(push) >= most else 0.0
            # A push in the old direction is released faster than a new one is built up.
            step = (self._fall if push * self._sign < 0.0 else self._rise) * dt
            self.effort[self._joint] = max(-most, min(most, push + self._sign * step))
            if push * self._sign <= 0.0:
                self._start = position
        return None

    def _turn(self, position: float) -> None:
        """Continue with the push the other way, or end the joint after that."""
        self._sign = {1: -1, -1: 0}[self._sign]
        self._start, self._waited = position, 0.0

    def _restart(self) -> Fault | None:
        self._disturbed += 1
        if self._disturbed > MAX_DISTURBED:
            return self._fault(FaultCode.SIGN_UNPROVEN, "it moves without being pushed: hold still and let it hang")
        self.hint = f"{self._names[self._joint]} moves without being pushed: hold still"
        self._start_joint()
        return None

    def _next_joint(self) -> None:
        self._joint += 1
        while self._joint < len(self._names) and not self._torque[self._joint]:
            self._joint += 1
        self.done = self._joint == len(self._names)
        self._disturbed, self.hint = 0, ""
        self._start_joint()

    def _start_joint(self) -> None:
        self._start = math.inf
        self._still_time = self._waited = 0.0
        self._sign = 1

    def _release(self, dt: float) -> bool:
        """Take back the push on the present joint; return whether it is gone."""
        push, step = self.effort[self._joint], self._fall * dt
        self.effort[self._joint] = push - max(-step, min(step, push))
        return push == 0.0

    def _wait_for_rest(self, dt: float, position: float) -> Fault | None:
        self._still_time += dt
        self._waited += dt
        if not abs(position - self._start) <= STILL or self.effort[self._joint] != 0.0:
            self._start, self._still_time = position, 0.0
        if self._still_time >= STILL_TIME:
            self._waited = 0.0
        elif self._waited > REST_TIMEOUT:
            return self._fault(FaultCode.SIGN_UNPROVEN, "it does not come to rest: hold still and let it hang")
        return None

    def _fault(self, code: FaultCode, reason: str) -> Fault:
        return Fault(code, f"{self._names[self._joint]}: {reason}")
