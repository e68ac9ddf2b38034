# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The state machine between the requested efforts and the motors. Pure: time is an argument.

`command.TRANSITIONS` has every transition, `watch.NEXT` those of a single motor.

- CHECKING waits for the start gate (start.py), at most `enable_timeout`. Its calm second passes before the arm is
  enabled, too. If zeros are not trusted, the arm must hang, a person must confirm it unless `start_pose` says that they
  have, and little torque may be asked for.
- PROVING switches the motors on one by one (`SwitchingOn`). Each must show in its replies that it is on. If signs are
  not trusted, each joint is pushed gently, and must move the right way (`SignCheck`). Any fault, and `disable`, takes
  the push back without a step and without damping, and switches the motors off.
- RAMPING_IN: the torque begins as a guided motion (guidance.py), which ends at the full torque.
- LETTING_DOWN lowers each joint at a bounded speed (descent.py). The motors are switched off once nothing holds
  the arm and nothing moves it. A motor that does not reply is taken to obey, and is still watched for: if it replies
  again, however late, its joint is lowered from the torque that it then applies.
- FAULT latches the code and reason of the first fault.

A compensator that is late for a moment is waited for (`StaleEfforts`): the last torque stays, and damping rises.

Zeros and signs are trusted once they were checked, for as long as the angles are continuous (watch.py). So long
`resume` carries an arm on from any pose after a fault that leaves nothing to repair.
"""

import math
import operator
from collections.abc import Iterable, Sequence

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import JointMotor, JointSample
from exo_gravity.core.numbers import rate_limited
from exo_gravity.core.safety.command import (
    CARRYING,
    TRANSITIONS,
    Command,
    Efforts,
    Fault,
    FaultCode,
    Send,
    State,
    StateEvent,
)
from exo_gravity.core.safety.descent import ArmDescent
from exo_gravity.core.safety.explain import MotionMonitor, StaleEfforts
from exo_gravity.core.safety.guidance import GuidedMotion
from exo_gravity.core.safety.limits import CONFIRM, DAMPING, DAMPING_RATE, MAX_EFFORT_RATE, Limits
from exo_gravity.core.safety.shape import STILLNESS, Shaper
from exo_gravity.core.safety.start import (
    HANGING_ARM,
    START_GATE,
    SWITCH_ON,
    PoseQuestion,
    SignCheck,
    SwitchingOn,
    SwitchOnCheck,
    missing_for_a_start,
    missing_of_trunk,
    torque_while_hanging,
)
from exo_gravity.core.safety.watch import POWER, ArmWatch, Power, PowerChange
from exo_gravity.core.vocabulary import NO_REASON, Motors, Resume, Status, Wait

CARRIED = (State.RAMPING_IN, State.ACTIVE)


class SafetyMachine:
    """Decides, cycle by cycle, what the motors of one arm receive. Not thread-safe: one thread owns it.

    period: s of a cycle. After a pause the torque continues as if only one period had passed: it never catches up.
    motors: of the arm, which bound its torque and damping; by default `max_effort` does, and nothing.

    state: the State. fault: the latched Fault or None. waiting_for: what CHECKING or PROVING waits for. refusal: why
    the last enable was refused without a fault. acted, damped: when each limit of a torque, and each cause of damping,
    has acted last, by name. watch: what is known of each motor. stale: efforts that are late. motion: judges the
    efforts by gravity alone. pose: the question to the operator whether the arm hangs as it is drawn. signs: the proof
    of signs.
    """

    def __init__(self, limits: Limits, period: float, motors: Sequence[JointMotor] = ()) -> None:
        self.limits = limits
        self.state = State.DISABLED
        self.fault: Fault | None = None
        self.waiting_for = self.refusal = NO_REASON
        self.acted: dict[str, float] = {}
        self.damped: dict[str, float] = {}
        self.stale = StaleEfforts(limits.command_timeout)
        self._period = period
        count = len(limits.joint_names)
        self._none, self._commands = (0.0,) * count, (Send.COMMAND,) * count
        #: the last hand on every command
        self.shaper = Shaper(limits, [motor.peak_damping for motor in motors] or [math.inf] * count)
        self.watch = ArmWatch(limits, period, motors)
        self._since, self._calm_since = 0.0, math.inf  # s; the latter infinite until an arm that is off is looked at
        self._now, self._dt = -math.inf, 0.0  # of the present cycle
        self._sent = self._off = Command.off(count)  # last sent to the motors
        self._descent = ArmDescent(0.0, self._none, self._none, self._none)
        self._rise = GuidedMotion(count)  # of the torque, where it begins
        self.pose = PoseQuestion(limits.joint_names)
        self.motion = MotionMonitor(limits)
        self.signs = SignCheck(limits.joint_names, limits.max_effort)
        self._left: Sequence[float] = ()  # Nm, what another process left the motors with
        self._attempts = 0  # to switch a motor on again that shows no torque while it is pushed
        #: Whether the last command did not leave for each motor (n,), set from outside: that motor holds what it had.
        self.unsent: Sequence[bool] = (False,) * count
        #: Whether each motor (n,) was sent nothing in the last cycle on purpose, set from outside: it owes no reply.
        self.held_back: Sequence[bool] = (False,) * count
        #: What else CHECKING waits for, set from outside.
        self.setup_error = NO_REASON

    @property
    def is_unreached(self) -> bool:
        """Whether the arm counts as down, but a motor that may be on does not reply."""
        return self._is_standing and any(motor.may_be_on and motor.is_silent for motor in self.watch.joints)

    @property
    def is_off(self) -> bool:
        """Whether the arm is down, and each motor has confirmed that it is off."""
        return self._is_standing and not any(motor.may_be_on for motor in self.watch.joints)

    @property
    def motors(self) -> Motors:
        """Whether motors may be on."""
        if self.is_unreached:
            return Motors.UNREACHED
        return Motors.OFF if self.is_off else Motors.ON

    def enable(self, now: float) -> bool:
        """Start the checks, after which torque ramps in. Return False, and do nothing, unless DISABLED."""
        if self.state is not State.DISABLED:
            return False
        self.waiting_for, self.refusal = Status(Wait.REPLIES, "the first replies of the motors"), NO_REASON
        self._on(StateEvent.ENABLE, now)
        return True

    def disable(self, now: float) -> None:
        """Let the arm down if it is carried, else switch it off; then go to DISABLED. A latched fault stays."""
        self._on(StateEvent.DISABLE, now)

    def clear(self, now: float) -> bool:
        """Clear a latched fault, on the operator's request only. Return False, and do nothing, unless in FAULT."""
        if self.state is not State.FAULT:
            return False
        self.fault = None
        for motor in self.watch.joints:
            motor.clear_error()
        self._on(StateEvent.CLEAR, now)
        return True

    @property
    def why_not_resumed(self) -> Status:
        """Why `resume` would be refused; false if it would not."""
        if self.state is not State.FAULT or self.fault is None:
            return Status(Resume.NO_FAULT, f"the arm is {self.state.value}, must be in fault")
        if not self.fault.code.is_resumable:
            return Status(
                Resume.HAS_CAUSE, f"{self.fault.code} has a cause: look for it, clear the fault, enable the arm"
            )
        unsure = "zeros are no longer sure: let the arm hang, clear the fault, enable the arm"
        return Status(Resume.POSSIBLE, "") if self.watch.trusted else Status(Resume.ZEROS_UNSURE, unsure)

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
        self._latch(Fault(code, reason), now)

    def take_over(
        self, effort: Sequence[float], damping: Sequence[float], now: float, is_unproven: bool = False
    ) -> None:
        """Let down an arm whose controller has died while its motors applied `effort` (n,) Nm and `damping` (n,).

        is_unproven: whether signs were not proven: then the push is taken back, and the motors are switched off.
        """
        self._sent, self._left = Command(tuple(effort), tuple(damping), self._commands, True), effort
        self.watch.change_power(PowerChange.SWITCH_ON if is_unproven else PowerChange.TAKEN_OVER)
        self.state = State.PROVING if is_unproven else State.ACTIVE
        self._on(StateEvent.DISABLE, now)

    def probe(self, now: float) -> None:
        """Find out, under damping, whether motors are on that a dead controller may have left; let them down if so."""
        self._descent = ArmDescent(now, self._none, (DAMPING,) * len(self._none), self.limits.max_effort)
        self.watch.change_power(PowerChange.PROBED)

    def step(self, now: float, joints: Sequence[JointSample], efforts: Efforts) -> Command:
        """Return what the motors receive in the cycle at `now` s.

        joints: the newest sample of each joint, shoulder to elbow.
        efforts: what the controller asks for.
        """
        now = max(now, self._now)  # a call may carry a slightly later time than the cycle that follows it
        self._now, self._dt = now, min(now - self._now, self._period)
        watch = self.watch
        watch.read(now, joints, self.held_back, self._sent.powered, self._dt)
        if self._left:
            self._share_supply(self._left)
        if self.state in CARRYING:
            self._latch(self._carried_fault(efforts), self._now)
        elif self._is_standing:
            self._look(efforts)
        self._latch(watch.judge_pause(now, self._sent.effort, self.state in CARRIED), now)
        effort = efforts.effort
        if effort is not None and self.state in CARRIED:
            effort, fault = self.motion.step(self._dt, watch.samples, effort, now - efforts.answered)
            self._latch(fault, self._now)
        if self.state is State.PROVING:
            self._prove(efforts.effort or self._none)
        self._sent = self._command(effort or self._none, efforts.damped)
        return self._sent

    def _share_supply(self, left: Sequence[float]) -> None:
        """Take motors that were left with `left` (n,) Nm for on, too, once one is: the arm has one supply.

        The replies of one that holds too little do not tell.
        """
        if any(motor.power is Power.ON for motor in self.watch.joints):
            for motor, held in zip(self.watch.joints, left, strict=True):
                if motor.power is Power.UNSURE and motor.is_heard and abs(held) <= 2.0 * POWER.torque:
                    motor.change(PowerChange.SHOWN_ON)

    def _carried_fault(self, efforts: Efforts) -> Fault | None:
        """Return the fault of an arm that is about to be carried, or is: of readings, delivery, or efforts."""
        undelivered = self.watch.judge_torques(self._dt, self._sent.effort, self._sent.damping)
        if undelivered:
            if self.state in CARRIED or self._attempts == SWITCH_ON.attempts:
                return undelivered
            self._attempts += 1
        if self.watch.fault:
            return self.watch.fault
        off = [motor for motor in self.watch.joints if motor.power is Power.ON and motor.reports_off]
        if self.state in CARRIED and off:
            why = f": {off[0].sample.trouble}" if off[0].sample.trouble else ""
            return Fault.of_joint(FaultCode.TORQUE_NOT_DELIVERED, off[0].name, f"its motor says that it is off{why}")
        if self.shaper.empty_for >= STILLNESS.empty:
            why = "the arm moved off as if it were empty: is an arm in the cuff, the load in the hand, the IMU fixed?"
            return Fault(FaultCode.LOAD_MISSING, why)
        if efforts.effort is None:
            return Fault(FaultCode.COMMAND_WITHDRAWN, "the compensator withdrew its efforts; see its diagnostics")
        return self.stale.step(self._now, self._dt, self._now - efforts.answered, efforts.held)

    def _command(self, effort: Sequence[float], damped: bool) -> Command:
        if self.state in CARRIED:
            try:
                return self._carry(effort, damped)
            except ParameterError as error:
                self.trip(FaultCode.COMMAND_IMPOSSIBLE, str(error), self._now)
        if self.state is State.PROVING:
            return self._push()
        return self._descend() if self.state is State.LETTING_DOWN else self._stand()

    def _powered(self, effort: Iterable[float], damping: Iterable[float], send: Iterable[Send]) -> Command:
        """Return a command of motors that may be on, within the barrier."""
        watch, torque = self.watch, tuple(effort)
        bounded = self.shaper.damping(self._dt, watch.samples, watch.silent, torque, tuple(damping), watch.is_late)
        return Command(
            torque,
            bounded,
            tuple(send),
            powered=any(motor.may_be_on for motor in watch.joints),
            is_unproven=not watch.trusted and any(motor.power is Power.ENTERING for motor in watch.joints),
        )

    def _look(self, efforts: Efforts) -> None:
        """Note since when an arm that is off has been calm, enabled or not; if it is, check it for a start.

        Efforts may be late as they may while the arm is carried, but not in the cycle in which the checks end.
        """
        watch, age = self.watch, self._now - efforts.answered
        are_late = self.stale.step(self._now, self._dt, age, efforts.held)
        missing = missing_for_a_start(self.limits, watch.samples, watch.fault, watch.trusted) or missing_of_trunk(
            self.limits, self.motion.trunk_tilt
        )
        if not missing and not self._all_off:
            missing = Status(Wait.MOTORS_OFF, "the motors to confirm that they are off")
        if missing or are_late or self._calm_since > self._now:
            self._calm_since = self._now
        if not missing and (efforts.effort is None or are_late):
            missing = Status(Wait.EFFORTS, "effort commands")
            # While an IMU settles, the compensator answers in time without efforts.
            self._calm_since = max(self._calm_since, self._now + START_GATE.efforts - START_GATE.calm)
        if self.state is State.CHECKING:
            self._check(missing, efforts.effort)

    def _check(self, missing: Fault | Status, effort: Sequence[float] | None) -> None:
        """Continue to PROVING once all has been well for a while, or trip on a fault that refuses the start."""
        watch, limits = self.watch, self.limits
        if isinstance(missing, Fault):
            if not any(motor.is_clearing for motor in watch.joints):
                self._latch(missing, self._now)
                return
            missing = Status(missing.code, missing.reason)
        asks = not watch.trusted and limits.start_pose == CONFIRM
        patience = limits.enable_timeout + (HANGING_ARM.patience if asks else 0.0)
        if watch.fault:
            self.pose.withdraw()
        if asks:
            missing = self.pose.missing(self._now, watch.samples, missing)
        # It passes, too, while the bridge cannot switch motors on, and while the operator looks at the arm.
        self.waiting_for = self.setup_error or missing or Status(Wait.CALM, f"{START_GATE.calm:g} s without a fault")
        is_calm = not (self.setup_error or missing) and self._now - self._calm_since >= START_GATE.calm
        if is_calm and effort is not None and not self.stale.are_used:
            fault = None if watch.trusted else torque_while_hanging(limits, effort)
            if fault:
                self._latch(fault, self._now)
                return
            self.waiting_for = NO_REASON
            largest = 0.0 if watch.trusted else limits.sign_check_torque
            self._switching, self._attempts, self._calm_since = SwitchingOn(self.watch.replies), 0, math.inf
            self._switch_on = SwitchOnCheck(limits)
            self.signs = SignCheck(limits.joint_names, [min(largest, most) for most in limits.max_effort])
            watch.reset_delivery()
            self._on(StateEvent.PASSED)
        elif self._now - self._since >= patience:
            waited = f"not enabled within {patience:g} s: waited for {self.waiting_for}"
            self.refusal = Status(self.waiting_for.code, waited)
            self._on(StateEvent.REFUSED)

    def _prove(self, asked: Sequence[float]) -> None:
        """Advance the checks of motors that were just switched on; asked: (n,) Nm."""
        if not self._switching.done:
            self.watch.reset_delivery()
            return
        joints = self.watch.samples
        if self.signs.done:  # before, or there is nothing to check: they are trusted
            fault = self._switch_on.step(self._dt, joints, self._sent.damping)
            self.watch.reset_delivery()
        else:
            fault = self.signs.step(self._dt, joints, asked)
        self.waiting_for = self.signs.hint
        self._latch(fault, self._now)
        if not fault and self.signs.done and (self._switch_on.done or self.signs.pushes):
            self.watch.trusted = True
            self.motion.reset()
            self._rise.begin((1.0,) * len(self._none))
            self._on(StateEvent.PROVEN)

    def _push(self) -> Command:
        """Return a command that switches the motors on one by one, then pushes them gently.

        A joint is damped only if its signs are trusted, or have just been proven.
        """
        if not self._switching.done:
            return self._powered(self._none, self._none, self._switching.step())
        if self.signs.pushes:
            again = [motor.is_missing for motor in self.watch.joints]
            pushed, damped = self.signs.effort, self.signs.damped
        else:
            pushed, again, damped = self._switch_on.effort, self._switch_on.enter, [True] * len(self._none)
        if any(again):
            self.watch.reset_delivery()
        boards = zip(again, self.watch.replies, strict=True)
        send = [Send.ENTER if is_missing and replies else Send.COMMAND for is_missing, replies in boards]
        rise = DAMPING_RATE * self._dt
        command = self._powered(pushed, [min(DAMPING, last + rise) for last in self._sent.damping], send)
        return command._replace(damping=tuple(map(operator.mul, damped, command.damping)))

    def _carry(self, effort: Sequence[float], damped: bool) -> Command:
        joints = self.watch.samples
        if self.state is State.RAMPING_IN:
            self._rise.step(self._dt, [joint.velocity for joint in joints], self._none, effort)
            if self._rise.is_over:
                self._on(StateEvent.RAMPED)
        is_guided = damped or self.state is State.RAMPING_IN
        share = [1.0 - left for left in self._rise.shares]
        torque, damping = self.shaper.shape(
            self._dt, joints, effort, share, self._sent.effort, is_guided, DAMPING if self.stale.are_used else 0.0
        )
        command = self._powered(torque, damping, self._commands)
        for joint in self.shaper.joints:
            self.acted.update(dict.fromkeys(joint.limiting, self._now))
            self.damped[joint.cause] = self._now
        return command

    def _descend(self) -> Command:
        """Return a command that lowers the arm, or stands once it is down."""
        watch, descent, sent = self.watch, self._descent, self._sent
        descent.step(self._now, self._dt, watch.samples, watch.silent, self.unsent)
        self._switch_quiet_off()
        is_switched_off = all(motor.power in (Power.OFF, Power.LEAVING) for motor in watch.joints)
        if is_switched_off or descent.is_down(self._now, watch.rest.since):
            for motor in watch.joints:
                if not motor.is_silent:
                    motor.change(PowerChange.SWITCH_OFF)
            self._on(StateEvent.DOWN_AFTER_FAULT if self.fault else StateEvent.DOWN)
            return self._stand()
        undelivered = watch.judge_torques(self._dt, sent.effort, sent.damping)
        send = self._sends()
        for i, motor in enumerate(watch.joints):
            may_reenable = motor.power is Power.ON and motor.can_reenable and not motor.sample.error
            if may_reenable and motor.is_found_off(sent.effort[i], sent.damping[i]):
                motor.can_reenable = False
                watch.require_sign_check()
                descent.rejoin(i)
                send[i] = Send.ENTER if self.watch.replies[i] else Send.COMMAND
        if undelivered:
            watch.reset_delivery()
        return self._powered(*descent.applied, send)

    def _stand(self) -> Command:
        """Return what the motors receive while the arm is off: nothing, unless one of them may be on."""
        self._switch_quiet_off()
        if any(motor.power is Power.ON for motor in self.watch.joints):
            if self.state is State.CHECKING:
                self.refusal = Status(Wait.MOTOR_ON, "a motor was still on: it is let down")
            self._on(StateEvent.FOUND_ON)
            return self._descend()
        if any(motor.power is Power.ENTERING for motor in self.watch.joints):  # the proof has ended
            pushed = [rate_limited(0.0, push, MAX_EFFORT_RATE * self._dt) for push in self._sent.effort]
            if any(pushed):
                return self._powered(pushed, self._none, self._commands)
            self.watch.change_power(PowerChange.SWITCH_OFF)
        if self._all_off:
            return self._off._replace(send=tuple(self._sends()))
        self._descent.step(self._now, self._dt, self.watch.samples, self.watch.silent, self.unsent)
        return self._powered(*self._descent.applied, self._sends())

    def _switch_quiet_off(self) -> None:
        """Switch motors off that may be on, but reply without torque."""
        for motor in self.watch.joints:
            if motor.power in (Power.UNSURE, Power.UNKNOWN) and motor.is_quiet:
                motor.change(PowerChange.SWITCH_OFF)

    def _sends(self) -> list[Send]:
        return [motor.send(self._now) for motor in self.watch.joints]

    @property
    def _is_standing(self) -> bool:
        return self.state in (State.DISABLED, State.CHECKING, State.FAULT)

    @property
    def _all_off(self) -> bool:
        return all(motor.power is Power.OFF for motor in self.watch.joints)

    def _latch(self, fault: Fault | None, now: float) -> None:
        if not fault:
            return
        if fault.code.needs_recheck:
            self.watch.require_sign_check()
        if self.state is State.FAULT or (self.state is State.DISABLED and fault.code is not FaultCode.FOREIGN_COMMAND):
            return
        self.fault = self.fault or fault
        self._on(StateEvent.FAULT, now)

    def _on(self, event: StateEvent, now: float = -math.inf) -> None:
        """Go to the state that `TRANSITIONS` has for this event; stay where it has none."""
        before, after = self.state, TRANSITIONS.get((self.state, event))
        if after is None:
            return
        self.state = after
        self.watch.is_being_proven = after is State.PROVING
        self.pose.withdraw()
        self._since = self._now = max(now, self._now)
        if after is State.PROVING:
            self.shaper.empty_for = 0.0  # of the arm that was carried before
            self.watch.change_power(PowerChange.SWITCH_ON)
        elif after is State.RAMPING_IN:
            self.watch.change_power(PowerChange.SHOWN_ON)
        elif after is State.LETTING_DOWN and before in CARRIED:
            sent = self._sent
            self._descent = ArmDescent(self._since, sent.effort, sent.damping, self.limits.max_effort)
