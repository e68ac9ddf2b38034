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

A compensator that is late for a moment is waited for (ride.py): the last torque stays, and damping rises.

Zeros and signs are trusted once they were checked, until a motor may have lost its turn count (readings.py), or a fault
casts doubt on them (`DOUBTFUL`). Until then `resume` carries an arm on from any pose after a fault that was no one's
(`NO_ONES`).
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import Peaks
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.delivery import DeliveryMonitor
from exo_gravity.core.safety.descent import DAMPING_RISE, ArmDescent, RestTracker
from exo_gravity.core.safety.drive import CARRYING, DOUBTFUL, NO_ONES, NOTHING, OFF, Drive, Fault, FaultCode, State
from exo_gravity.core.safety.gate import SignCheck, StartGate, SwitchOnCheck
from exo_gravity.core.safety.limits import DAMPING, JointSample, Limits, guide_damping
from exo_gravity.core.safety.motion_monitor import MotionMonitor
from exo_gravity.core.safety.readings import Readings
from exo_gravity.core.safety.ride import RideThrough
from exo_gravity.core.safety.supply import SupplyMonitor

RAMP_TIME = 1.0  # s from no torque to full torque: the arm becomes light without a jolt


class SafetyMachine:
    """Decides, cycle by cycle, what the motors of one arm receive. Not thread-safe: one thread owns it.

    period: s of a cycle. After a pause the torque continues as if only one period had passed: it never catches up.
    peaks: the most that the motors apply; by default `max_effort`, and any damping.

    state: the State. fault: the latched Fault or None. waiting_for: what CHECKING or PROVING waits for. refusal: why
    the last enable was refused without a fault, or "". acted: for each limit that has acted, by name, the last time.
    is_unreached: whether a motor that may be on cannot be reached. ride: through late efforts.
    motion: judges the efforts by gravity alone.
    """

    def __init__(self, limits: Limits, period: float, peaks: Peaks | None = None) -> None:
        self.limits = limits
        self.state = State.DISABLED
        self.fault: Fault | None = None
        self.waiting_for = self.refusal = ""
        self.acted: dict[str, float] = {}
        self.is_unreached = False
        self.ride = RideThrough(limits.command_timeout)
        self._period = period
        self._peaks = peaks or Peaks(tuple(limits.max_effort))
        self._since = 0.0
        self._now = -math.inf
        self._sent = OFF  # last sent to the motors
        self._descent = ArmDescent(0.0, NOTHING, NOTHING, NOTHING)
        self._rest = RestTracker()
        self._readings = Readings(limits)
        self._is_found_on = False  # by this cycle's replies
        self._is_trusted = False  # zeros and signs
        self._delivery = DeliveryMonitor(limits, self._peaks.effort)
        self.motion = MotionMonitor(limits)
        self._supply = SupplyMonitor()
        self._gate = StartGate(limits, 0.0)
        self._switch_on = SwitchOnCheck(limits)
        self._signs = SignCheck(limits.joint_names, NOTHING)
        #: What else CHECKING waits for, set from outside; '' for nothing.
        self.hindrance = ""

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

    @property
    def why_not_resumed(self) -> str:
        """Why `resume` would be refused; '' if it would not."""
        if self.state is not State.FAULT or self.fault is None:
            return f"the arm is {self.state.value}, must be in fault"
        if self.fault.code not in NO_ONES:
            return f"{self.fault.code} has a cause to look for: then clear the fault and enable the arm"
        return "" if self._is_trusted else "zeros are no longer sure: let the arm hang, clear the fault, enable the arm"

    def resume(self, now: float) -> bool:
        """Clear the fault and enable, on the operator's request only. Return False, and do nothing, if refused."""
        return not self.why_not_resumed and self.clear(now) and self.enable(now)

    def trip(self, code: FaultCode, reason: str, now: float) -> None:
        """Latch a fault detected elsewhere (a broken bus, an impossible command). The first fault stays.

        While the arm is off only a foreign command is a fault: it may have switched a motor on.
        """
        if code in DOUBTFUL:
            self._is_trusted = False
        if self.state is State.FAULT or (self.state is State.DISABLED and code is not FaultCode.FOREIGN_COMMAND):
            return
        self.fault = self.fault or Fault(code, reason)
        if self.state in (State.CHECKING, State.DISABLED):
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
        self._descent = ArmDescent(now, NOTHING, (DAMPING,) * JOINT_COUNT, self.limits.max_effort)
        self._supply.doubt(NOTHING)

    def settled(self, now: float) -> bool:
        """Return whether no replying joint has moved for a while."""
        return self._rest.is_settled(now)

    def step(
        self,
        now: float,
        joints: Sequence[JointSample],
        effort: Sequence[float] | None,
        effort_time: float,
        damped: bool = False,
        held: bool = False,
    ) -> Drive:
        """Return what the motors receive in the cycle at `now` s.

        joints: the 4 newest readings. effort: (4,) Nm requested, None if withdrawn or never requested; effort_time:
        when the joint readings that it answers were taken. damped: whether the joints are to be damped too, because the
        load changes; held: whether the efforts are computed from a tilt that is late. All times are on one clock.
        """
        now = max(now, self._now)  # a call may carry a slightly later time than the cycle that follows it
        dt = min(now - self._now, self._period)
        self._now = now
        joints = self._track(now, joints, dt)
        if self.state is State.CHECKING:
            self._check(now, joints, effort, effort_time)
        if self._sent.powered:
            self._check_delivery(now, joints, dt)
        if self.state in CARRYING:
            self._watch(now, dt, effort, now - effort_time, held)
        if effort is not None and self.state in (State.RAMPING_IN, State.ACTIVE):
            effort, fault = self.motion.step(dt, joints, effort, now - effort_time)
            if fault:
                self.trip(*fault, now)
        drive = self._drive(now, joints, effort, damped, dt).within(self._peaks.damping)
        self._sent = drive
        return drive

    def _drive(
        self, now: float, joints: Sequence[JointSample], effort: Sequence[float] | None, damped: bool, dt: float
    ) -> Drive:
        if self.state is State.PROVING:
            self._prove(now, joints, dt)
        if self.state in (State.RAMPING_IN, State.ACTIVE):
            try:
                return self._carry(now, joints, effort or NOTHING, damped, dt)
            except ParameterError as error:
                self.trip(FaultCode.COMMAND_IMPOSSIBLE, str(error), now)
        if self.state is State.PROVING:
            damping = DAMPING * min(1.0, (now - self._since) / DAMPING_RISE)
            if self._switch_on.done:
                return Drive(tuple(self._signs.effort), (damping,) * 4, True)
            return Drive(tuple(self._switch_on.effort), (damping,) * 4, True, tuple(self._switch_on.enter))
        if self.state is State.LETTING_DOWN:
            return self._descend(now, joints, dt)
        return self._stand(now, joints, dt)

    def _check(
        self, now: float, joints: Sequence[JointSample], effort: Sequence[float] | None, effort_time: float
    ) -> None:
        """Continue to PROVING once the start gate has passed, or trip on a fault that refuses the start."""
        self._gate.hindrance = self.hindrance
        are_fresh = effort is not None and now - effort_time <= self.limits.command_timeout
        fault = self._gate.step(now, joints, self._readings.fault, are_fresh, self._is_trusted)
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

    def _watch(self, now: float, dt: float, effort: Sequence[float] | None, age: float, held: bool) -> None:
        fault = self._readings.fault
        if fault is None and effort is None:
            fault = Fault(FaultCode.COMMAND_WITHDRAWN, "the compensator withdrew its efforts; see its diagnostics")
        elif fault is None:
            fault = self.ride.step(now, dt, age, held)
        if fault:
            self.trip(*fault, now)

    def _prove(self, now: float, joints: Sequence[JointSample], dt: float) -> None:
        if self._switch_on.done:
            fault = self._signs.step(dt, joints)
        else:
            fault = self._switch_on.step(dt, joints, self._sent.damping)
            self._delivery.reset()
        self.waiting_for = self._signs.hint
        if fault:
            self.trip(*fault, now)
        elif self._switch_on.done and self._signs.done:
            self._is_trusted = True
            self.motion.reset()
            self._enter(State.RAMPING_IN, now)

    def _carry(
        self, now: float, joints: Sequence[JointSample], effort: Sequence[float], damped: bool, dt: float
    ) -> Drive:
        ramp = 1.0
        if self.state is State.RAMPING_IN:
            ramp = (now - self._since) / RAMP_TIME
            if ramp >= 1.0:
                ramp = 1.0
                self._enter(State.ACTIVE, now)
        shaped, acted = self.limits.shape(effort, ramp, joints, self._sent.effort, dt)
        self.acted.update(dict.fromkeys(acted, now))
        # A wall's damping rises at once, since it already rises with the position. That of a ride or a changing load
        # rises over DAMPING_RISE, and any damping falls so.
        step = DAMPING / DAMPING_RISE * dt
        guided = [guide_damping(joint.velocity) if damped else 0.0 for joint in joints]
        wanted = (DAMPING,) * len(guided) if self.ride.is_riding else guided
        columns = zip(self.limits.wall_damping(joints), wanted, self._sent.damping, strict=True)
        damping = tuple(max(wall, last - step, min(last + step, most)) for wall, most, last in columns)
        return Drive(shaped, damping, True)

    def _descend(self, now: float, joints: Sequence[JointSample], dt: float) -> Drive:
        descent, supply, silent = self._descent, self._supply, self._readings.silent
        descent.step(now, dt, joints, tuple(map(operator.or_, silent, supply.returning)))
        if self.state is not State.LETTING_DOWN:  # a motor that could not be reached replies again
            self._enter(State.LETTING_DOWN, now)
        are_off = supply.all_unsure and supply.are_off
        if are_off or descent.is_down(now, self._rest.since):
            self.is_unreached = any(silent)
            supply.settle(silent)
            self._enter(State.FAULT if self.fault else State.DISABLED, now)
            return self._stand(now, joints, dt)
        columns = zip(self._delivery.missing, silent, supply.unsure, strict=True)
        enter = tuple(missing and not is_silent and not is_unsure for missing, is_silent, is_unsure in columns)
        if any(enter):
            self._is_trusted = False
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
        if not self._is_found_on and (is_doubtful or any(self._readings.silent)):
            return Drive(self._descent.effort, self._descent.damping, True, unsure=supply.unsure)
        if self.state is State.CHECKING:
            self._refuse("a motor was still on: it is let down", now)
        self.is_unreached = False
        return self._descend(now, joints, dt)

    def _refuse(self, reason: str, now: float) -> None:
        self.refusal = reason
        self._enter(State.DISABLED, now)

    def _track(self, now: float, joints: Sequence[JointSample], dt: float) -> Sequence[JointSample]:
        """Follow the readings: who is silent, who applies torque, whether the arm rests; return those that count."""
        readings = self._readings
        readings.step(now, joints, self._sent.powered)
        if readings.lost or (readings.fault and readings.fault.code is FaultCode.POSITION_JUMP):
            self._is_trusted = False
        self._rest.step(now, readings.joints, readings.silent)
        if all(readings.silent) and self._sent.powered:
            self._supply.doubt(self._sent.effort)
        self._is_found_on = self._supply.step(dt, readings.joints, readings.silent)
        return readings.joints

    def _let_down(self, now: float) -> None:
        applied = self._delivery.applied(self._sent, self._readings.silent)
        self._descent = ArmDescent(now, *applied, self.limits.max_effort)
        self._enter(State.LETTING_DOWN, now)

    def _enter(self, state: State, now: float) -> None:
        self.state = state
        self._since = self._now = max(now, self._now)
