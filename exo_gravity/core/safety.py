"""The state machine between what is asked of the arm and what its motors get. Pure: time is an argument.

    DISABLED --enable--> CHECKING --all well--> PROVING --signs right--> RAMPING_IN --ramp_time--> ACTIVE
        ^                 |    |                   |                         |                       |
        |         disable |    | fault             |     disable, fault      |                       |
        +-----------------+    v                   v                         v                       |
        +------clear------- FAULT <--------- LETTING_DOWN <------------------+-----------------------+
        +-------------------------------------------+ at rest: FAULT after a fault, else DISABLED

- DISABLED, CHECKING, FAULT: the motors are off. They are asked for their position with commands that ask for nothing.
- CHECKING waits until for a whole second every motor has answered, free of faults and at rest within its limits, and
  fresh efforts have come. The first time since the motors answer, the arm must hang as `Limits.home` says.
- PROVING, that first time too: each joint is pushed a little, and must give way the right way (core/sign_check.py).
- LETTING_DOWN: the last torques fade to nothing over `fade_time` under the motors' own damping, which stays until the
  arm is at rest. The motors are switched off only then. A motor that can't be reached goes on pushing: should it answer
  again, however late, it gets damping before it is switched off.
- FAULT is latched with the first fault's code and reason. Only `clear` leaves it, and only to DISABLED: clearing a
  fault never arms anything.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.faults import Fault, FaultCode
from exo_gravity.core.limits import UNKNOWN, JointSample, Limits
from exo_gravity.core.sign_check import SignCheck

AT_REST = 0.1  # rad/s; two to four codes of the 12-bit velocity
# Down is where no joint turns by more than this in this time. Velocity is too coarse: a damped arm creeps below one of
# its codes, and would drop the rest of the way.
SETTLED = 0.005  # rad
SETTLING_TIME = 0.5  # s
LONGEST_SILENCE = 5.0  # s for which a silent motor is waited for on the way down
LONGEST_DESCENT = 20.0  # s after which the motors are switched off even if somebody keeps the arm moving
CALM = 1.0  # s without trouble before the motors are switched on: while nodes start, middleware and machine stutter
DAMPING_RISE = 0.2  # s: damping that comes at once is a torque step of its own
NOTHING = (0.0, 0.0, 0.0, 0.0)


class State(str, Enum):
    """Where the arm is between off and carried."""

    DISABLED = "disabled"
    CHECKING = "checking"
    PROVING = "proving signs"
    RAMPING_IN = "ramping in"
    ACTIVE = "active"
    LETTING_DOWN = "letting down"
    FAULT = "fault"


class Drive(NamedTuple):
    """What the motors get: (4,) Nm, one damping in Nm s/rad, and whether they are switched on."""

    effort: tuple[float, ...]
    damping: float
    powered: bool


# The states in which torque flows because somebody asks for it.
CARRYING = (State.PROVING, State.RAMPING_IN, State.ACTIVE)

OFF = Drive(NOTHING, 0.0, False)


class SafetyMachine:
    """Decides, cycle by cycle, what the motors of one arm get. Not thread-safe: one thread owns it.

    period: s of a cycle. After a pause the torque goes on as if no more than that had passed: it never catches up.

    state: the State. fault: the latched Fault or None. waiting_for: why CHECKING goes on. acted: when each limit that
    ever acted did so last, by name.
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
        self._effort = NOTHING  # what the motors got last
        self._from = NOTHING  # what they got when the way down began
        self._rest_since = 0.0
        self._rest: Sequence[JointSample] = (UNKNOWN,) * 4  # where the arm was then
        self._before: Sequence[JointSample] = (UNKNOWN,) * 4
        self._unreached = False  # whether a motor was silent when the way down ended
        self._known = False  # whether zeros and signs have been checked since the motors answer
        self._sign_check: SignCheck | None = None  # while PROVING

    def enable(self, now: float) -> bool:
        """Begin the checks, after which torque ramps in. Refused (False) unless DISABLED."""
        if self.state is not State.DISABLED:
            return False
        self.waiting_for = "the motors' first replies"
        self._enter(State.CHECKING, now)
        return True

    def disable(self, now: float) -> None:
        """Let the arm down if it is carried; then DISABLED. A latched fault stays."""
        if self.state in CARRYING:
            self._let_down(now)
        elif self.state is State.CHECKING:
            self._enter(State.DISABLED, now)

    def clear(self, now: float) -> bool:
        """Forget a latched fault, by the operator's word alone. Refused (False) unless in FAULT."""
        if self.state is not State.FAULT:
            return False
        self.fault = None
        self._enter(State.DISABLED, now)
        return True

    def trip(self, code: FaultCode, reason: str, now: float) -> None:
        """Latch a fault found outside (a broken bus, an impossible command); the first one stays."""
        if self.state in (State.DISABLED, State.FAULT):
            return
        self.fault = self.fault or Fault(code, reason)
        if self.state is State.CHECKING:
            self._enter(State.FAULT, now)
        elif self.state is not State.LETTING_DOWN:
            self._let_down(now)

    def take_over(self, effort: Sequence[float], now: float) -> None:
        """Let down an arm that gets `effort` (4,) Nm from a controller that is no more."""
        limits = self.limits.max_effort
        self._effort = tuple(max(-most, min(most, e)) for e, most in zip(effort, limits, strict=True))
        self._let_down(now)

    def settled(self, now: float) -> bool:
        """Return whether no joint that answers has left its place for `SETTLING_TIME`."""
        return now - self._rest_since >= SETTLING_TIME

    def step(
        self, now: float, joints: Sequence[JointSample], effort: Sequence[float] | None, effort_time: float
    ) -> Drive:
        """Return what the motors get in the cycle at `now` s.

        joints: 4 newest readings. effort: (4,) Nm asked, or None if nothing was ever asked; effort_time: when the joint
        readings that it answers were taken. All times on one monotonic clock.
        """
        now = max(now, self._now)  # an order may have been timed a little later than the cycle that it precedes
        dt = min(now - self._now, self._period)
        self._now = now
        silent = self._note(now, joints)
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
            drive = self._carry(now, joints, effort, dt)
        elif self.state is State.LETTING_DOWN:
            drive = self._descend(now, silent, dt)
        else:
            drive = self._stand(now, silent)
        self._effort = drive.effort
        return drive

    def _check(self, now, joints, effort, effort_time) -> None:
        """Start gate: go on to RAMPING_IN, or say what is missing, or trip over what must not be waited out."""
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
            self.waiting_for = f"{CALM:g} s without trouble"
            return None
        self._since = now
        return None

    def _watch(self, now, joints, effort, effort_time) -> None:
        fault = self.limits.find_fault(now, joints, self._before)
        if fault is None and effort is None:
            fault = Fault(FaultCode.COMMAND_WITHDRAWN, "the compensator withdrew; its diagnostics say why")
        elif fault is None and not now - effort_time <= self.limits.command_timeout:
            limit = self.limits.command_timeout * 1000
            fault = Fault(FaultCode.COMMAND_STALE, f"effort commands stopped: none fresher than {limit:.0f} ms")
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

    def _carry(self, now, joints, effort, dt) -> Drive:
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

    def _descend(self, now, silent, dt) -> Drive:
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

    def _stand(self, now, silent) -> Drive:
        if self._unreached and not silent and self.settled(now):
            self._unreached = False
        return Drive(NOTHING, self.limits.damping, True) if self._unreached else OFF

    def _damping(self, now: float) -> float:
        return self.limits.damping * min(1.0, (now - self._since) / DAMPING_RISE)

    def _note(self, now: float, joints: Sequence[JointSample]) -> bool:
        """Note whether the arm is at rest, as far as its motors answer; return whether one of them is silent."""
        silent = [self.limits.is_silent(now, joint) for joint in joints]
        if any(silent):
            self._known = False  # it may have lost its power, and with it the turns of its encoder
        if any(
            not mute and not abs(joint.position - rest.position) <= SETTLED
            for joint, rest, mute in zip(joints, self._rest, silent, strict=True)
        ):
            self._rest_since, self._rest = now, joints
        # When it answers again it has moved, for all we know.
        self._rest = [UNKNOWN if mute else rest for rest, mute in zip(self._rest, silent, strict=True)]
        return any(silent)

    def _let_down(self, now: float) -> None:
        self._from = self._effort
        self._enter(State.LETTING_DOWN, now)

    def _enter(self, state: State, now: float) -> None:
        self.state = state
        self._since = self._now = max(now, self._now)
