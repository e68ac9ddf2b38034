"""The state machine between the requested efforts and the motors. Pure: time is an argument.

    DISABLED --enable--> CHECKING --all well--> PROVING --motors on, signs right--> RAMPING_IN --RAMP_TIME--> ACTIVE
        ^                 |    |                   |                                    |                       |
        |         disable |    | fault             |     disable, fault                 |                       |
        +-----------------+    v                   v                                    v                       |
        +------clear------- FAULT <--------- LETTING_DOWN <-----------------------------+-----------------------+
        +-------------------------------------------+ down: FAULT after a fault, else DISABLED

- DISABLED, CHECKING, FAULT: the motors are off. Zero commands poll their positions.
- CHECKING waits for the start gate (gate.py), at most `enable_timeout`. If zeros are not trusted, the arm must hang.
- PROVING: each motor must show in its replies that it is on. If signs are not trusted, each joint is pushed gently, and
  must move the right way (gate.py).
- LETTING_DOWN lowers each joint at a bounded speed (descent.py). The motors are switched off once nothing holds
  the arm and nothing moves it. A motor that cannot be reached stays in this state's care: if it replies again, however
  late, its joint is lowered from the torque that it then applies. If all were silent at once, their supply may have
  been cut: a motor that returns without torque stays off (supply.py).
- FAULT latches the code and reason of the first fault. Only `clear` leaves it, and only to DISABLED: clearing a fault
  never enables the arm.

Zeros and signs are trusted once they were checked, until a motor is silent or a fault casts doubt on them (`DOUBTFUL`).
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import Peaks
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.delivery import DeliveryMonitor
from exo_gravity.core.safety.descent import DAMPING, DAMPING_RISE, ArmDescent, RestTracker
from exo_gravity.core.safety.drive import CARRYING, DOUBTFUL, NOTHING, OFF, Drive, Fault, FaultCode, State
from exo_gravity.core.safety.gate import SignCheck, StartGate, SwitchOnCheck
from exo_gravity.core.safety.limits import UNKNOWN, JointSample, Limits
from exo_gravity.core.safety.supply import SupplyMonitor

RAMP_TIME = 1.0  # s from no torque to full torque: the arm becomes light without a jolt


class SafetyMachine:
    """Decides, cycle by cycle, what the motors of one arm receive. Not thread-safe: one thread owns it.

    period: s of a cycle. After a pause the torque continues as if only one period had passed: it never catches up.
    peaks: the most that the motors apply; by default `max_effort`, and any damping.

    state: the State. fault: the latched Fault or None. waiting_for: what CHECKING or PROVING waits for. refusal: why
    the last enable was refused without a fault, or "". acted: for each limit that has acted, by name, the last time.
    is_unreached: whether a motor that may be on cannot be reached.
    """

    def __init__(self, limits: Limits, period: float, peaks: Peaks | None = None) -> None:
        self.limits = limits
        self.state = State.DISABLED
        self.fault: Fault | None = None
        self.waiting_for = self.refusal = ""
        self.acted: dict[str, float] = {}
        self.is_unreached = False
        self._period = period
        self._peaks = peaks or Peaks(tuple(limits.max_effort))
        self._since = 0.0
        self._now = -math.inf
        self._sent = OFF  # last sent to the motors
        self._descent = ArmDescent(0.0, NOTHING, NOTHING, self._peaks.effort)
        self._rest = RestTracker()
        self._before: Sequence[JointSample] = (UNKNOWN,) * 4
        self._silent: Sequence[bool] = (True,) * 4
        self._is_found_on = False  # by this cycle's replies
        self._is_trusted = False  # zeros and signs
        self._delivery = DeliveryMonitor(limits, self._peaks.effort)
        self._supply = SupplyMonitor()
        self._gate = StartGate(limits, 0.0)
        self._switch_on = SwitchOnCheck(limits)
        self._signs = SignCheck(limits.joint_names, NOTHING)

    def enable(self, now: float) -> bool:
        """Start the checks, after which torque ramps in. Return False, and do nothing, unless DISABLED."""
        if self.state is not State.DISABLED:
            return False
        self._gate = StartGate(self.limits, now)
        self.waiting_for, self.refusal = self._gate.waiting_for, ""
        self._enter(State.CHECKING, now)
        return True

    def disable(self, now: float) -> None:
        """Let the arm down if it is carried, then go to DISABLED. A latched fault stays."""
        if self.state in CARRYING:
            self._let_down(now)
        elif self.state is State.CHECKING:
            self._enter(State.DISABLED, now)

    def clear(self, now: float) -> bool:
        """Clear a latched fault, on the operator's request only. Return False, and do nothing, unless in FAULT."""
        if self.state is not State.FAULT:
            return False
        self.fault = None
        self._enter(State.DISABLED, now)
        return True

    def trip(self, code: FaultCode, reason: str, now: float) -> None:
        """Latch a fault detected elsewhere (a broken bus, an impossible command). The first fault stays."""
        if code in DOUBTFUL:
            self._is_trusted = False
        if self.state in (State.DISABLED, State.FAULT):
            return
        self.fault = self.fault or Fault(code, reason)
        if self.state is State.CHECKING:
            self._enter(State.FAULT, now)
        elif self.state is not State.LETTING_DOWN:
            self._let_down(now)

    def take_over(self, effort: Sequence[float], damping: Sequence[float], now: float) -> None:
        """Let down an arm whose controller has died while its motors applied `effort` (4,) Nm and `damping` (4,)."""
        self._sent = Drive(tuple(effort), tuple(damping), True)
        self._supply.doubt(effort)
        self._let_down(now)

    def meet(self, now: float) -> None:
        """Find out, under damping, whether motors are on that a dead controller may have left; let them down if so."""
        self._descent = ArmDescent(now, NOTHING, (DAMPING,) * JOINT_COUNT, self._peaks.effort)
        self._supply.doubt(NOTHING)

    def settled(self, now: float) -> bool:
        """Return whether no replying joint has moved for a while."""
        return self._rest.is_settled(now)

    def step(
        self, now: float, joints: Sequence[JointSample], effort: Sequence[float] | None, effort_time: float
    ) -> Drive:
        """Return what the motors receive in the cycle at `now` s.

        joints: the 4 newest readings. effort: (4,) Nm requested, None if withdrawn or never requested; effort_time:
        when the joint readings that it answers were taken. All times are on one monotonic clock.
        """
        now = max(now, self._now)  # a call may carry a slightly later time than the cycle that follows it
        dt = min(now - self._now, self._period)
        self._now = now
        self._track(now, joints, dt)
        if self.state is State.CHECKING:
            self._check(now, joints, effort, effort_time)
        if self._sent.powered:
            self._check_delivery(now, joints, dt)
        if self.state in CARRYING:
            self._watch(now, joints, effort, effort_time)
        drive = self._drive(now, joints, effort, dt).within(self._peaks.damping)
        self._before = joints
        self._sent = drive
        return drive

    def _drive(self, now: float, joints: Sequence[JointSample], effort: Sequence[float] | None, dt: float) -> Drive:
        if self.state is State.PROVING:
            self._prove(now, joints, dt)
        if self.state in (State.RAMPING_IN, State.ACTIVE):
            try:
                return self._carry(now, joints, effort or NOTHING, dt)
            except ParameterError as error:
                self.trip(FaultCode.COMMAND_IMPOSSIBLE, str(error), now)
        if self.state is State.PROVING:
            damping = DAMPING * min(1.0, (now - self._since) / DAMPING_RISE)
            check = self._signs if self._switch_on.done else self._switch_on
            return Drive(tuple(check.effort), (damping,) * 4, True)
        if self.state is State.LETTING_DOWN:
            return self._descend(now, joints, dt)
        return self._stand(now, joints, dt)

    def _check(
        self, now: float, joints: Sequence[JointSample], effort: Sequence[float] | None, effort_time: float
    ) -> None:
        """Continue to PROVING once the start gate has passed, or trip on a fault that refuses the start."""
        are_fresh = effort is not None and now - effort_time <= self.limits.command_timeout
        fault = self._gate.step(now, joints, self._before, are_fresh, self._is_trusted)
        self.waiting_for = self._gate.waiting_for
        if fault:
            self.trip(*fault, now)
        elif self._gate.passed:
            self.waiting_for = ""
            largest = 0.0 if self._is_trusted else self.limits.sign_check_torque
            self._switch_on = SwitchOnCheck(self.limits)
            self._signs = SignCheck(self.limits.joint_names, [min(largest, most) for most in self.limits.max_effort])
            self._delivery.reset()
            self._enter(State.PROVING, now)
        elif now - self._since >= self.limits.enable_timeout:
            self._refuse(f"not enabled within {self.limits.enable_timeout:g} s: waited for {self.waiting_for}", now)

    def _check_delivery(self, now: float, joints: Sequence[JointSample], dt: float) -> None:
        fault = self._delivery.step(dt, joints, self._sent.effort, self._sent.damping)
        is_proven = self.state in (State.RAMPING_IN, State.ACTIVE) or self._switch_on.done
        if fault and self.state in CARRYING and is_proven:
            self.trip(*fault, now)

    def _watch(
        self, now: float, joints: Sequence[JointSample], effort: Sequence[float] | None, effort_time: float
    ) -> None:
        fault = self.limits.find_fault(now, joints, self._before)
        if fault is None and effort is None:
            fault = Fault(FaultCode.COMMAND_WITHDRAWN, "the compensator withdrew its efforts; see its diagnostics")
        elif fault is None and not now - effort_time <= self.limits.command_timeout:
            limit = self.limits.command_timeout * 1000
            fault = Fault(FaultCode.COMMAND_STALE, f"no effort command younger than {limit:.0f} ms")
        if fault:
            self.trip(*fault, now)

    def _prove(self, now: float, joints: Sequence[JointSample], dt: float) -> None:
        if self._switch_on.done:
            fault = self._signs.step(dt, joints)
        else:
            fault = self._switch_on.step(dt, joints, self._sent.damping)
        self.waiting_for = self._signs.hint
        if fault:
            self.trip(*fault, now)
        elif self._switch_on.done and self._signs.done:
            self._is_trusted = True
            self._enter(State.RAMPING_IN, now)

    def _carry(self, now: float, joints: Sequence[JointSample], effort: Sequence[float], dt: float) -> Drive:
        ramp = 1.0
        if self.state is State.RAMPING_IN:
            ramp = (now - self._since) / RAMP_TIME
            if ramp >= 1.0:
                ramp = 1.0
                self._enter(State.ACTIVE, now)
        shaped, acted = self.limits.shape(effort, ramp, joints, self._sent.effort, dt)
        self.acted.update(dict.fromkeys(acted, now))
        # Damping rises at once, since the soft wall already rises with the position, and falls over DAMPING_RISE.
        fall = DAMPING / DAMPING_RISE * dt
        walls = zip(self.limits.wall_damping(joints), self._sent.damping, strict=True)
        return Drive(shaped, tuple(max(wall, last - fall) for wall, last in walls), True)

    def _descend(self, now: float, joints: Sequence[JointSample], dt: float) -> Drive:
        descent, supply = self._descent, self._supply
        descent.step(now, dt, joints, tuple(map(operator.or_, self._silent, supply.returning)))
        if self.state is not State.LETTING_DOWN:  # a motor that could not be reached replies again
            self._enter(State.LETTING_DOWN, now)
        are_off = supply.all_unsure and supply.are_off
        if are_off or descent.is_down(now, self._rest.since):
            self.is_unreached = any(self._silent)
            supply.settle(self._silent)
            self._enter(State.FAULT if self.fault else State.DISABLED, now)
            return self._stand(now, joints, dt)
        columns = zip(self._delivery.missing, self._silent, supply.unsure, strict=True)
        enter = tuple(missing and not is_silent and not is_unsure for missing, is_silent, is_unsure in columns)
        if any(enter):
            self._delivery.reset()
        return Drive(descent.effort, descent.damping, True, enter, supply.unsure)

    def _stand(self, now: float, joints: Sequence[JointSample], dt: float) -> Drive:
        """Return what the motors receive while the arm is off: nothing, unless one of them may be on."""
        supply = self._supply
        if supply.are_off:
            supply.settle()
            if self.is_unreached and self.state is State.CHECKING:
                self._refuse("the motors have just returned, switched off: enable them again", now)
            self.is_unreached = False
        is_doubtful = any(supply.unsure)
        if not (self.is_unreached or is_doubtful or self._is_found_on):
            return OFF
        if not self._is_found_on and (is_doubtful or any(self._silent)):
            return Drive(self._descent.effort, self._descent.damping, True, unsure=supply.unsure)
        if self.state is State.CHECKING:
            self._refuse("a motor was still on: it is let down", now)
        self.is_unreached = False
        return self._descend(now, joints, dt)

    def _refuse(self, reason: str, now: float) -> None:
        self.refusal = reason
        self._enter(State.DISABLED, now)

    def _track(self, now: float, joints: Sequence[JointSample], dt: float) -> None:
        """Note who is silent, who returned, who applies torque, and whether the arm rests as far as motors reply."""
        silent = [self.limits.is_silent(now, joint) for joint in joints]
        if any(silent) or any(map(self.limits.is_jump, range(JOINT_COUNT), joints, self._before)):
            self._is_trusted = False  # a motor may have lost power, and with it the turn count of its encoder
        self._rest.step(now, joints, silent)
        if all(silent) and self._sent.powered:
            self._supply.doubt(self._sent.effort)
        self._is_found_on = self._supply.step(dt, joints, silent)
        self._silent = silent

    def _let_down(self, now: float) -> None:
        applied = self._delivery.applied(self._sent, self._silent)
        self._descent = ArmDescent(now, *applied, self._peaks.effort)
        self._enter(State.LETTING_DOWN, now)

    def _enter(self, state: State, now: float) -> None:
        self.state = state
        self._since = self._now = max(now, self._now)
