"""The state machine between the requested efforts and the motors. Pure: time is an argument.

    DISABLED --enable--> CHECKING --all well--> PROVING --signs right--> RAMPING_IN --ramp_time--> ACTIVE
        ^                 |    |                   |                         |                       |
        |         disable |    | fault             |     disable, fault      |                       |
        +-----------------+    v                   v                         v                       |
        +------clear------- FAULT <--------- LETTING_DOWN <------------------+-----------------------+
        +-------------------------------------------+ at rest: FAULT after a fault, else DISABLED

- DISABLED, CHECKING, FAULT: the motors are off. Zero commands poll their positions.
- CHECKING waits until, for one second, every motor has replied without a fault, at rest and within its limits, and
  fresh efforts have arrived. The first time after the motors began to reply, the arm must hang at `Limits.home`.
- PROVING, also that first time: each joint is pushed gently, and must move the right way (core/sign_check.py).
- LETTING_DOWN: the last torques fade to zero over `fade_time` under the motors' own damping, which stays on until the
  arm is at rest. Only then are the motors switched off. A motor that cannot be reached keeps applying its torque: if it
  replies again, however late, it is damped before it is switched off.
- FAULT latches the code and reason of the first fault. Only `clear` leaves it, and only to DISABLED: clearing a fault
  never enables the arm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from exo_gravity.core.drive import CARRYING, NOTHING, OFF, Drive, State
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.faults import Fault, FaultCode
from exo_gravity.core.limits import UNKNOWN, JointSample, Limits
from exo_gravity.core.sign_check import SignCheck

AT_REST = 0.1  # rad/s; two to four codes of the 12-bit velocity
# The arm is down when no joint turns by more than SETTLED in SETTLING_TIME. Velocity is too coarse for this: a damped
# arm creeps at less than one velocity code, and would drop the rest of the way.
SETTLED = 0.005  # rad
SETTLING_TIME = 0.5  # s
LONGEST_SILENCE = 5.0  # s for which the way down waits for a silent motor
LONGEST_DESCENT = 20.0  # s after which the motors are switched off even if the arm is kept moving
CALM = 1.0  # s without a fault before the motors are switched on: middleware and machine stutter while nodes start
DAMPING_RISE = 0.2  # s; damping that starts at once would be a torque step


class SafetyMachine:
    """Decides, cycle by cycle, what the motors of one arm receive. Not thread-safe: one thread owns it.

    period: s of a cycle. After a pause the torque continues as if only one period had passed: it never catches up.

    state: the State. fault: the latched Fault or None. waiting_for: what CHECKING waits for. acted: for each limit that
    has acted, by name, the last time.
    """

    def __init__(self, limits: Limits, period: float):
        self.limits = limits
        self._period = period
        self.state = State.DISABLED
        self.fault: Fault | None = None
        self.waiting_for = ""
        self.acted: dict[str, float] = {}
        self._since = 0.0
        self._now = -math.inf
        self._effort = NOTHING  # last sent to the motors
        self._from = NOTHING  # sent when the way down began
        self._rest_since = 0.0
        self._rest: Sequence[JointSample] = (UNKNOWN,) * 4  # where the arm was at that time
        self._before: Sequence[JointSample] = (UNKNOWN,) * 4
        self._unreached = False  # whether a motor was silent when the way down ended
        self._known = False  # whether zeros and signs have been checked since the motors began to reply
        self._sign_check = self._new_sign_check()

    def enable(self, now: float) -> bool:
        """Start the checks, after which torque ramps in. Return False, and do nothing, unless DISABLED."""
        if self.state is not State.DISABLED:
            return False
        self.waiting_for = "the first replies of the motors"
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
        if self.state in (State.DISABLED, State.FAULT):
            return
        self.fault = self.fault or Fault(code, reason)
        if self.state is State.CHECKING:
            self._enter(State.FAULT, now)
        elif self.state is not State.LETTING_DOWN:
            self._let_down(now)

    def take_over(self, effort: Sequence[float], now: float) -> None:
        """Let down an arm whose controller has died while its motors applied `effort` (4,) Nm."""
        limits = self.limits.max_effort
        self._effort = tuple(max(-most, min(most, e)) for e, most in zip(effort, limits, strict=True))
        self._let_down(now)

    def settled(self, now: float) -> bool:
        """Return whether no replying joint has moved for `SETTLING_TIME`."""
        return now - self._rest_since >= SETTLING_TIME

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
        silent = self._track_rest(now, joints)
        if self.state is State.CHECKING:
            self._check(now, joints, effort, effort_time)
        if self.state in CARRYING:
            self._watch(now, joints, effort, effort_time)
        if self.state is State.PROVING:
            self._prove(now, joints, dt)
        self._before = joints
        if self.state is State.PROVING:
            drive = Drive(tuple(self._sign_check.effort), self._damping(now), True)
        elif self.state in (State.RAMPING_IN, State.ACTIVE):
            drive = self._carry(now, joints, effort or NOTHING, dt)
        elif self.state is State.LETTING_DOWN:
            drive = self._descend(now, silent, dt)
        else:
            drive = self._stand(now, silent)
        self._effort = drive.effort
        return drive

    def _check(
        self, now: float, joints: Sequence[JointSample], effort: Sequence[float] | None, effort_time: float
    ) -> None:
        """Start gate: continue to RAMPING_IN, or note what is missing, or trip on what must not be waited out."""
        fault = self.limits.find_fault(now, joints, self._before, overshoot=0.0)
        if not fault and not self._known:
            fault = self.limits.find_wrong_zero(joints)
        if fault and fault.code not in (FaultCode.MOTOR_SILENT, FaultCode.OVER_SPEED):
            return self.trip(*fault, now)
        if fault:
            self.waiting_for = fault.reason
        elif any(abs(joint.velocity) > AT_REST for joint in joints):
            self.waiting_for = "the arm to be at rest"
        elif effort is None or now - effort_time > self.limits.command_timeout:
            self.waiting_for = "effort commands"
        elif now - self._since >= CALM:
            self.waiting_for = ""
            self._sign_check = self._new_sign_check()
            self._enter(State.RAMPING_IN if self._known else State.PROVING, now)
            return None
        else:
            self.waiting_for = f"{CALM:g} s without a fault"
            return None
        self._since = now
        return None

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
        fault = self._sign_check.step(dt, joints)
        if fault:
            self.trip(*fault, now)
        elif self._sign_check.done:
            self._known = True
            self._enter(State.RAMPING_IN, now)

    def _new_sign_check(self) -> SignCheck:
        limits = self.limits
        push = [min(limits.sign_check_torque, most) for most in limits.max_effort]
        return SignCheck(limits.joint_names, push, limits.max_effort_rate)

    def _carry(self, now: float, joints: Sequence[JointSample], effort: Sequence[float], dt: float) -> Drive:
        ramp = (now - self._since) / self.limits.ramp_time if self.state is State.RAMPING_IN else 1.0
        if ramp >= 1.0:
            ramp = 1.0
            if self.state is State.RAMPING_IN:
                self._enter(State.ACTIVE, now)
        try:
            shaped, acted = self.limits.shape(effort, ramp, joints, self._effort, dt)
        except ParameterError as error:
            self.trip(FaultCode.COMMAND_IMPOSSIBLE, str(error), now)
            return self._descend(now, False, dt)
        self.acted.update(dict.fromkeys(acted, now))
        return Drive(shaped, 0.0, True)

    def _descend(self, now: float, silent: bool, dt: float) -> Drive:
        elapsed = now - self._since
        fade = max(0.0, 1.0 - elapsed / self.limits.fade_time)
        faded = elapsed >= self.limits.fade_time + SETTLING_TIME
        waited = not silent or elapsed >= LONGEST_SILENCE
        if (faded and waited and self.settled(now)) or elapsed >= LONGEST_DESCENT:
            self._unreached = silent
            self._enter(State.FAULT if self.fault else State.DISABLED, now)
            return self._stand(now, silent)
        step = self.limits.max_effort_rate * dt
        effort = (max(e - step, min(e + step, fade * f)) for e, f in zip(self._effort, self._from, strict=True))
        return Drive(tuple(effort), self._damping(now), True)

    def _stand(self, now: float, silent: bool) -> Drive:
        if self._unreached and not silent and self.settled(now):
            self._unreached = False
        return Drive(NOTHING, self.limits.damping, True) if self._unreached else OFF

    def _damping(self, now: float) -> float:
        return self.limits.damping * min(1.0, (now - self._since) / DAMPING_RISE)

    def _track_rest(self, now: float, joints: Sequence[JointSample]) -> bool:
        """Note whether the arm is at rest, as far as its motors reply; return whether one of them is silent."""
        silent = [self.limits.is_silent(now, joint) for joint in joints]
        if any(silent):
            self._known = False  # it may have lost power, and with it the turn count of its encoder
        if any(
            not is_silent and not abs(joint.position - rest.position) <= SETTLED
            for joint, rest, is_silent in zip(joints, self._rest, silent, strict=True)
        ):
            self._rest_since, self._rest = now, joints
        # It may have moved by the time it replies again.
        self._rest = [UNKNOWN if is_silent else rest for rest, is_silent in zip(self._rest, silent, strict=True)]
        return any(silent)

    def _let_down(self, now: float) -> None:
        self._from = self._effort
        self._enter(State.LETTING_DOWN, now)

    def _enter(self, state: State, now: float) -> None:
        self.state = state
        self._since = self._now = max(now, self._now)
