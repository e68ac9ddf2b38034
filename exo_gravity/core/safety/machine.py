"""The state machine between the requested efforts and the motors. Pure: time is an argument.

    DISABLED --enable--> CHECKING --all well--> PROVING --motors on, signs right--> RAMPING_IN --RAMP_TIME--> ACTIVE
        ^                 |    |                   |                                    |                       |
        |         disable |    | fault             |     disable, fault                 |                       |
        +-----------------+    v                   v                                    v                       |
        +------clear------- FAULT <--------- LETTING_DOWN <-----------------------------+-----------------------+
        +-------------------------------------------+ down: FAULT after a fault, else DISABLED

- DISABLED, CHECKING, FAULT: the motors are off. Zero commands poll their positions.
- CHECKING waits for the start gate (gate.py), at most `enable_timeout`. If zeros are not trusted, the arm must hang, a
  person must confirm it unless `start_pose` says that they have, and little torque may be asked for.
- PROVING: each motor must show in its replies that it is on. If signs are not trusted, each joint is pushed gently, and
  must move the right way (gate.py).
- LETTING_DOWN lowers each joint at a bounded speed (descent.py). The motors are switched off once nothing holds
  the arm and nothing moves it. A motor that cannot be reached is still watched for: if it replies again, however
  late, its joint is lowered from the torque that it then applies. If all were silent at once, their supply may have
  been cut: a motor that returns without torque stays off (`SupplyMonitor`).
- FAULT latches the code and reason of the first fault. Only `clear` leaves it, and only to DISABLED: clearing a fault
  never enables the arm.

A compensator that is late for a moment is waited for (`RideThrough`): the last torque stays, and damping rises.

Zeros and signs are trusted once they were checked, for as long as the angles are continuous (trust.py). So long
`resume` carries an arm on from any pose after a fault that leaves nothing to repair.
"""

import math
import operator
from collections.abc import Iterable, Sequence

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import JointMotor, JointSample
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.delivery import DeliveryMonitor
from exo_gravity.core.safety.descent import DESCENT, ArmDescent
from exo_gravity.core.safety.drive import CARRYING, NO_MOTOR, OFF, Drive, Efforts, Fault, FaultCode, State
from exo_gravity.core.safety.gate import (
    HANGING_ARM,
    START_GATE,
    PoseQuestion,
    SignCheck,
    SwitchOnCheck,
    missing_for_a_start,
    torque_while_hanging,
)
from exo_gravity.core.safety.limits import CONFIRM, DAMPING, Limits, guide_damping
from exo_gravity.core.safety.monitors import REST, RestTracker, RideThrough, SupplyMonitor
from exo_gravity.core.safety.motion_monitor import MotionMonitor
from exo_gravity.core.safety.trust import Readings

RAMP_TIME = 1.0  # s from no torque to full torque: the arm becomes light without a jolt


class SafetyMachine:
    """Decides, cycle by cycle, what the motors of one arm receive. Not thread-safe: one thread owns it.

    period: s of a cycle. After a pause the torque continues as if only one period had passed: it never catches up.
    motors: of the arm, which bound its torque and damping; by default `max_effort` does, and nothing.

    state: the State. fault: the latched Fault or None. waiting_for: what CHECKING or PROVING waits for. refusal: why
    the last enable was refused without a fault, or "". acted: for each limit that has acted, by name, the last time.
    is_unreached: whether a motor that may be on cannot be reached. ride: through late efforts.
    motion: judges the efforts by gravity alone. pose: the question to the operator whether the arm hangs as drawn.
    """

    def __init__(self, limits: Limits, period: float, motors: Sequence[JointMotor] = ()) -> None:
        self.limits = limits
        self.state = State.DISABLED
        self.fault: Fault | None = None
        self.waiting_for = self.refusal = ""
        self.acted: dict[str, float] = {}
        self.is_unreached = False
        self.ride = RideThrough(limits.command_timeout)
        self._period = period
        self._peak_damping = [motor.peak_damping for motor in motors] or [math.inf] * JOINT_COUNT
        self._since = self._calm_since = 0.0
        self._now, self._dt = -math.inf, 0.0  # of the present cycle
        self._sent = OFF  # last sent to the motors
        self._descent = ArmDescent(0.0, NO_TORQUE, NO_TORQUE, NO_TORQUE)
        self._rest = RestTracker()
        self._readings = Readings(limits)
        self._is_found_on = False  # by this cycle's replies
        self.pose = PoseQuestion(limits.joint_names)
        self._delivery = DeliveryMonitor(limits, [motor.peak_effort for motor in motors] or limits.max_effort)
        self.motion = MotionMonitor(limits)
        self._supply = SupplyMonitor()
        self._switch_on = SwitchOnCheck(limits)
        self._signs = SignCheck(limits.joint_names, NO_TORQUE)
        #: What else CHECKING waits for, set from outside; '' for nothing.
        self.hindrance = ""

    def enable(self, now: float) -> bool:
        """Start the checks, after which torque ramps in. Return False, and do nothing, unless DISABLED."""
        if self.state is not State.DISABLED:
            return False
        self.waiting_for, self.refusal = "the first replies of the motors", ""
        self._calm_since = now
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
        if not self.fault.code.is_resumable:
            return f"{self.fault.code} has a cause to look for: then clear the fault and enable the arm"
        return (
            ""
            if self._readings.trusted
            else "zeros are no longer sure: let the arm hang, clear the fault, enable the arm"
        )

    def confirm_pose(self, now: float) -> str:
        """Take the operator's word that the arm hangs as it is drawn; return '' or why that is not asked."""
        if self.pose.confirm(now):
            return ""
        waits = f", waiting for {self.waiting_for}" if self.state is State.CHECKING else ""
        return f"nothing to confirm: the arm is {self.state.value}{waits}"

    def resume(self, now: float) -> bool:
        """Clear the fault and enable, on the operator's request only. Return False, and do nothing, if refused."""
        return not self.why_not_resumed and self.clear(now) and self.enable(now)

    def trip(self, code: FaultCode, reason: str, now: float) -> None:
        """Latch a fault detected elsewhere (a broken bus, an impossible command). The first fault stays.

        While the arm is off only a foreign command is a fault: it may have switched a motor on.
        """
        if code.needs_recheck:
            self._readings.doubt()
        if self.state is State.FAULT or (self.state is State.DISABLED and code is not FaultCode.FOREIGN_COMMAND):
            return
        self.fault = self.fault or Fault(code, reason)
        if self.state in (State.CHECKING, State.DISABLED):
            self._enter(State.FAULT, now)
        elif self.state is not State.LETTING_DOWN:
            self._let_down(now)

    def take_over(self, effort: Sequence[float], damping: Sequence[float], now: float) -> None:
        """Let down an arm whose controller has died while its motors applied `effort` (4,) Nm and `damping` (4,)."""
        self._sent = Drive(tuple(effort), tuple(damping), True, NO_MOTOR, NO_MOTOR)
        self._supply.suspect(effort)
        self._let_down(now)

    def probe(self, now: float) -> None:
        """Find out, under damping, whether motors are on that a dead controller may have left; let them down if so."""
        self._descent = ArmDescent(now, NO_TORQUE, (DAMPING,) * JOINT_COUNT, self.limits.max_effort)
        self._supply.suspect(NO_TORQUE)

    def is_at_rest(self, now: float) -> bool:
        """Return whether no replying joint has moved for a while."""
        return now - self._rest.since >= REST.time

    def step(self, now: float, joints: Sequence[JointSample], efforts: Efforts) -> Drive:
        """Return what the motors receive in the cycle at `now` s.

        joints: the newest sample of each joint, shoulder to elbow.
        efforts: what the controller asks for.
        """
        effort, answered, damped, held = efforts
        now = max(now, self._now)  # a call may carry a slightly later time than the cycle that follows it
        age = now - answered
        self._now, self._dt = now, min(now - self._now, self._period)
        readings, supply, sent = self._readings, self._supply, self._sent
        readings.step(now, joints, sent.powered)
        self._rest.step(now, readings.joints, readings.silent)
        if all(readings.silent) and sent.powered:
            supply.suspect(sent.effort)
        self._is_found_on = supply.step(self._dt, readings.joints, readings.silent)
        if self.state is State.CHECKING:
            self._check(effort if age <= self.limits.command_timeout else None)
        if sent.powered:
            fault = self._delivery.step(self._dt, readings.joints, sent.effort, sent.damping)
            is_proven = self.state in (State.RAMPING_IN, State.ACTIVE) or self._switch_on.done
            if fault and self.state in CARRYING and is_proven:
                self._trip(fault)
        if self.state in CARRYING:
            fault = readings.fault
            if fault is None and effort is None:
                fault = Fault(FaultCode.COMMAND_WITHDRAWN, "the compensator withdrew its efforts; see its diagnostics")
            elif fault is None:
                fault = self.ride.step(now, self._dt, age, held)
            self._trip(fault)
        if effort is not None and self.state in (State.RAMPING_IN, State.ACTIVE):
            effort, fault = self.motion.step(self._dt, readings.joints, effort, age)
            self._trip(fault)
        if self.state is State.PROVING:
            self._prove()
        self._sent = self._drive(effort or NO_TORQUE, damped)
        return self._sent

    def _drive(self, effort: Sequence[float], damped: bool) -> Drive:
        if self.state in (State.RAMPING_IN, State.ACTIVE):
            try:
                return self._carry(effort, damped)
            except ParameterError as error:
                self.trip(FaultCode.COMMAND_IMPOSSIBLE, str(error), self._now)
        if self.state is State.PROVING:
            damping = DAMPING * min(1.0, (self._now - self._since) / DESCENT.damping_rise)
            pushed = (self._signs if self._switch_on.done else self._switch_on).effort
            return self._powered(pushed, (damping,) * len(pushed), tuple(self._switch_on.enter), NO_MOTOR)
        return self._descend() if self.state is State.LETTING_DOWN else self._stand()

    def _powered(
        self, effort: Iterable[float], damping: Iterable[float], enter: tuple[bool, ...], unsure: tuple[bool, ...]
    ) -> Drive:
        """Return a drive of motors that are on, with no more damping than each of them can apply."""
        return Drive(tuple(effort), tuple(map(min, damping, self._peak_damping)), True, enter, unsure)

    def _check(self, effort: Sequence[float] | None) -> None:
        """Continue to PROVING once all has been well for a while, or trip on a fault that refuses the start.

        effort: (n,) Nm, what is asked for, None if that is not known.
        """
        readings, limits = self._readings, self.limits
        missing = missing_for_a_start(limits, readings.joints, readings.fault, readings.trusted)
        if isinstance(missing, Fault):
            self._trip(missing)
            return
        missing = missing or self.hindrance or ("effort commands" if effort is None else "")
        asks = not readings.trusted and limits.start_pose == CONFIRM
        patience = limits.enable_timeout + (HANGING_ARM.patience if asks else 0.0)
        if readings.fault:
            self.pose.withdraw()
        if asks:
            missing = self.pose.missing(self._now, readings.joints, missing)
        self.waiting_for = missing or f"{START_GATE.calm:g} s without a fault"
        if missing:
            self._calm_since = self._now
        if effort is not None and self._now - self._calm_since >= START_GATE.calm:
            fault = None if readings.trusted else torque_while_hanging(limits, effort)
            if fault:
                self._trip(fault)
                return
            self.waiting_for = ""
            largest = 0.0 if readings.trusted else limits.sign_check_torque
            self._switch_on = SwitchOnCheck(limits)
            self._signs = SignCheck(limits.joint_names, [min(largest, most) for most in limits.max_effort])
            self._delivery.reset()
            self._enter(State.PROVING)
        elif self._now - self._since >= patience:
            self._refuse(f"not enabled within {patience:g} s: waited for {self.waiting_for}")

    def _prove(self) -> None:
        if self._switch_on.done:
            fault = self._signs.step(self._dt, self._readings.joints)
        else:
            fault = self._switch_on.step(self._dt, self._readings.joints, self._sent.damping)
            self._delivery.reset()
        self.waiting_for = self._signs.hint
        self._trip(fault)
        if not fault and self._switch_on.done and self._signs.done:
            self._readings.prove()
            self.motion.reset()
            self._enter(State.RAMPING_IN)

    def _carry(self, effort: Sequence[float], damped: bool) -> Drive:
        joints, ramp = self._readings.joints, 1.0
        if self.state is State.RAMPING_IN:
            ramp = min(1.0, (self._now - self._since) / RAMP_TIME)
            if ramp == 1.0:
                self._enter(State.ACTIVE)
        shaped, walls, acted = self.limits.shape(effort, ramp, joints, self._sent.effort, self._dt)
        self.acted.update(dict.fromkeys(acted, self._now))
        # A wall's damping rises at once, since it already rises with the position. That of a ride or a changing load
        # rises over `damping_rise`, and any damping falls so.
        step = DAMPING / DESCENT.damping_rise * self._dt
        guided = [guide_damping(joint.velocity) if damped else 0.0 for joint in joints]
        wanted = (DAMPING,) * len(guided) if self.ride.is_riding else guided
        columns = zip(walls, wanted, self._sent.damping, strict=True)
        damping = [max(wall, last - step, min(last + step, most)) for wall, most, last in columns]
        return self._powered(shaped, damping, NO_MOTOR, NO_MOTOR)

    def _descend(self) -> Drive:
        descent, supply, silent = self._descent, self._supply, self._readings.silent
        may_differ = tuple(map(operator.or_, silent, supply.returning))
        descent.step(self._now, self._dt, self._readings.joints, may_differ)
        if self.state is not State.LETTING_DOWN:  # a motor that could not be reached replies again
            self._enter(State.LETTING_DOWN)
        if (all(supply.unsure) and supply.are_off) or descent.is_down(self._now, self._rest.since):
            self.is_unreached = any(silent)
            supply.clear(may_differ)
            self._enter(State.FAULT if self.fault else State.DISABLED)
            return self._stand()
        columns = zip(self._delivery.missing, self._unsure, strict=True)
        enter = tuple(missing and not is_unsure for missing, is_unsure in columns)
        if any(enter):
            self._readings.doubt()
            self._delivery.reset()
        return self._powered(*descent.applied, enter, self._unsure)

    @property
    def _unsure(self) -> tuple[bool, ...]:
        """Which motors (4,) may be off: those that are unsure, and those that do not reply, whose power may return."""
        return tuple(map(operator.or_, self._readings.silent, self._supply.unsure))

    def _stand(self) -> Drive:
        """Return what the motors receive while the arm is off: nothing, unless one of them may be on."""
        supply = self._supply
        if supply.are_off:
            supply.clear()
            if self.is_unreached and self.state is State.CHECKING:
                self._refuse("the motors have just returned, switched off: enable them again")
            self.is_unreached = False
        is_doubtful = any(supply.unsure)
        if not (self.is_unreached or is_doubtful or self._is_found_on):
            return OFF
        if not self._is_found_on and (is_doubtful or any(self._readings.silent)):
            return self._powered(*self._descent.applied, NO_MOTOR, self._unsure)
        if self.state is State.CHECKING:
            self._refuse("a motor was still on: it is let down")
        self.is_unreached = False
        return self._descend()

    def _refuse(self, reason: str) -> None:
        self.refusal = reason
        self._enter(State.DISABLED)

    def _let_down(self, now: float) -> None:
        applied = self._delivery.applied(self._sent, self._readings.silent)
        self._descent = ArmDescent(now, *applied, self.limits.max_effort)
        self._enter(State.LETTING_DOWN, now)

    def _trip(self, fault: Fault | None) -> None:
        if fault:
            self.trip(*fault, self._now)

    def _enter(self, state: State, now: float = -math.inf) -> None:
        self.state = state
        self.pose.withdraw()
        self._since = self._now = max(now, self._now)
