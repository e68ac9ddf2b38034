"""The start gate: what must hold before the motors of an arm are switched on, and before they carry it.

`StartGate` waits until, for CALM seconds, every motor has replied without a fault, at rest and within its limits, and
fresh efforts have arrived. `SwitchOnCheck` then checks that the motors are on, and `SignCheck` that their signs are
right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from exo_gravity.core.safety.drive import Fault, FaultCode
from exo_gravity.core.safety.limits import MAX_EFFORT_RATE, JointSample, Limits

AT_REST = 0.1  # rad/s; two to four codes of the 12-bit velocity
CALM = 1.0  # s without a fault before the motors are switched on: middleware and machine stutter while nodes start
# The gate waits for these to pass; other faults refuse the start.
WAITED_OUT = frozenset({FaultCode.MOTOR_SILENT, FaultCode.OVER_SPEED, FaultCode.OUTSIDE_LIMITS})

TEST_TORQUE = 0.4  # Nm, each way, that shows that a motor is on
TEST_TIME = 0.06  # s, each way
TEST_SHARE = 0.5  # of the test torque that must appear in the replies
TEST_LAG = 0.02  # s, time constant: replies are one command old and behind a current loop, a batch, a stall
TEST_TIMEOUT = 0.48  # s until every motor has shown that it is on: four pushes each way

RISE = 2.0  # Nm/s
FALL = 10.0  # Nm/s
MIN_PUSH = 0.1  # Nm; motion under a smaller push is not caused by it
MOVED = 0.02  # rad; fifty codes of the position
STILL = 0.003  # rad within which a joint is still
STILL_TIME = 0.2  # s for which it must stay within STILL
PUSH_TIMEOUT = 0.5  # s at full torque
REST_TIMEOUT = 5.0  # s for the joint to come to rest
MAX_DISTURBED = 5  # times that a joint may move without a push


class StartGate:
    """Waits for the conditions of a start. waiting_for: the condition that is not met; passed: whether all were.

    hindrance: what else must end first, set by the caller; '' for nothing.
    """

    def __init__(self, limits: Limits, now: float) -> None:
        self.waiting_for = "the first replies of the motors"
        self.hindrance = ""
        self.passed = False
        self._limits = limits
        self._calm_since = now

    def step(
        self,
        now: float,
        joints: Sequence[JointSample],
        fault: Fault | None,
        efforts_are_fresh: bool,
        zeros_are_trusted: bool,
    ) -> Fault | None:
        """Check the newest readings at `now` (s), and the `fault` that they show; return one that refuses the start."""
        outside = self._outside(joints)
        if not fault and not outside and not zeros_are_trusted:
            fault = self._limits.find_wrong_zero(joints)
        if fault and fault.code not in WAITED_OUT:
            return fault
        if fault and fault.code is not FaultCode.OUTSIDE_LIMITS:
            self.waiting_for = fault.reason
        elif outside:
            self.waiting_for = outside
        elif any(abs(joint.velocity) > AT_REST for joint in joints):
            self.waiting_for = "the arm to be at rest"
        elif self.hindrance:
            self.waiting_for = self.hindrance
        elif not efforts_are_fresh:
            self.waiting_for = "effort commands"
        else:
            self.waiting_for = f"{CALM:g} s without a fault"
            self.passed = now - self._calm_since >= CALM
            return None
        self._calm_since = now
        return None

    def _outside(self, joints: Sequence[JointSample]) -> str:
        """Return which joint must be moved, how far and which way to be within its limits, or ''."""
        limits = self._limits
        columns = (limits.joint_names, joints, limits.position_min, limits.position_max)
        for name, joint, low, high in zip(*columns, strict=True):
            if excess := joint.position - max(low, min(high, joint.position)):
                return f"{name} to be moved by {-excess:+.2f} rad, within its limits {low:g} to {high:g}"
        return ""


class SwitchOnCheck:
    """Checks that all four motors are on: short pushes each way, under damping, must appear in their replies.

    A motor is on if the regression of its replied on its commanded torque is at least TEST_SHARE; each pair of pushes
    tells 1 from 0 by nine standard deviations of a noise of 0.15 Nm at 100 Hz. A motor that has not shown it after a
    pair may have missed its ENTER: it gets another one, until TEST_TIMEOUT.

    effort: (4,) Nm to apply now. enter: (4,) which motors to switch on again now. done: whether the check has ended.
    """

    def __init__(self, limits: Limits) -> None:
        self.done = False
        self._names = limits.joint_names
        self._torque = [min(TEST_TORQUE, most) for most in limits.max_effort]
        count = len(self._torque)
        self.effort, self.enter = [0.0] * count, [False] * count
        self._last_time = [-math.inf] * count
        self._commanded = [0.0] * count  # Nm, as the replies show it
        self._is_on = [False] * count
        self._elapsed, self._pushes = 0.0, 0
        self._begin()

    def _begin(self) -> None:
        self._products = [0.0] * len(self._torque)  # of replied and commanded torque, summed
        self._squares = [0.0] * len(self._torque)  # of commanded torque

    def step(self, dt: float, joints: Sequence[JointSample], damping: Sequence[float]) -> Fault | None:
        """Advance by `dt` s with the replies to the last commands; return the fault that they show, if any.

        damping: (4,) Nm s/rad, last sent. Its torque is part of the replies, and a light joint moves.
        """
        self._elapsed += dt
        self.enter = [False] * len(self.enter)
        for i, joint in enumerate(joints):
            self._commanded[i] += min(1.0, dt / TEST_LAG) * (self.effort[i] - self._commanded[i])
            if joint.time > self._last_time[i]:
                self._last_time[i] = joint.time
                replied = joint.effort + damping[i] * joint.velocity
                self._products[i] += self._commanded[i] * replied
                self._squares[i] += self._commanded[i] ** 2
        pushes = int(self._elapsed / TEST_TIME)
        if pushes > self._pushes and pushes % 2 == 0 and (fault := self._judge()):
            return fault
        self._pushes = pushes
        for i, torque in enumerate(self._torque):
            target = 0.0 if all(self._is_on) else -torque if pushes % 2 else torque
            step = MAX_EFFORT_RATE * dt
            self.effort[i] += max(-step, min(step, target - self.effort[i]))
        self.done = all(self._is_on) and not any(self.effort)
        return None

    def _judge(self) -> Fault | None:
        """After a push each way, note which motors are on; return a fault once the others have had their time."""
        for i, name in enumerate(self._names):
            share = self._products[i] / max(1e-9, self._squares[i])
            self._is_on[i] = self._is_on[i] or share >= TEST_SHARE
            self.enter[i] = not self._is_on[i]
            if self.enter[i] and self._elapsed >= TEST_TIMEOUT - 1e-9:
                reason = f"{name}: the motor did not switch on: {share * 100:.0f} % of the commanded torque replied"
                return Fault(FaultCode.TORQUE_NOT_DELIVERED, reason)
        self._begin()
        return None


class SignCheck:
    """Checks that each motor pushes its joint the way that its encoder shows, while the arm hangs.

    Joint after joint: wait until it is still, push it gently and slowly under damping until it moves by about a degree,
    then push it back the other way. A joint that moves backwards has its torque or its encoder reversed: gravity
    compensation would double its weight. A joint that does not move has no torque, or is held. A joint that moves
    before it is pushed is being moved by the wearer: the check starts again, a few times. It cannot detect a
    `direction` that reverses torque and encoder alike: such a joint moves as expected.

    torque: (4,) Nm, the largest push on each joint; a joint with 0 is skipped. effort: (4,) Nm to apply now. done:
    whether every joint has passed. hint: what the wearer should do, '' for nothing.
    """

    def __init__(self, names: Sequence[str], torque: Sequence[float]) -> None:
        self.effort = [0.0] * len(names)
        self.done = False
        self.hint = ""
        self._names = names
        self._torque = torque
        self._joint = -1
        self._sign = 1  # of the push; 0 once both pushes have passed
        self._start = math.inf  # where the joint was before the push, rad
        self._next_joint()

    def step(self, dt: float, joints: Sequence[JointSample]) -> Fault | None:
        """Advance by `dt` s with the joints' readings, until `done`; return the fault that they show, if any."""
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
            self._sign = {1: -1, -1: 0}[self._sign]  # the push the other way, or the end of this joint
            self._start, self._waited = position, 0.0
        elif abs(push) >= most and self._waited > PUSH_TIMEOUT:
            return self._fault(FaultCode.SIGN_UNPROVEN, f"{push:.2f} Nm did not move it: let it hang freely")
        else:
            self._waited += dt if abs(push) >= most else 0.0
            # A push in the old direction is released faster than a new one is built up.
            step = (FALL if push * self._sign < 0.0 else RISE) * dt
            self.effort[self._joint] = max(-most, min(most, push + self._sign * step))
            if push * self._sign <= 0.0:
                self._start = position
        return None

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
        self._start, self._sign = math.inf, 1
        self._still_time = self._waited = 0.0

    def _release(self, dt: float) -> bool:
        """Take back the push on the present joint; return whether it is gone."""
        push, step = self.effort[self._joint], FALL * dt
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
