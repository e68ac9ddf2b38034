# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether each motor is on, as far as its replies and silences tell, and what it is sent for that.

No frame of an AK motor says whether it is on. What is known follows from what it was sent, whether it has replied, and
what torque it shows. The replies of other families say it (`JointSample.on`), and are believed. `NEXT` has the
transitions of a motor, `SENT` what a motor receives in each state. Both hold for every family: where two differ, they
are what is safe on both.

- Only an operator's enable switches a motor on. There is one exception: a motor that is found off while it carries its
  joint, and was never silent for long, has restarted or obeyed a foreign EXIT. It is switched on again once, and comes
  back with damping and without torque.
- A motor that is silent is taken to obey: it may hear what it is sent. Its command cannot switch a V1 or V2 board on. A
  command switches a V3 board on, so it gets none once its power may have been cut.
- A motor is off once it has replied to EXIT. A late reply to the command before must not count: the second EXIT's does.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.drive import Send


@dataclass(frozen=True)
class PowerTuning:
    """What in its replies shows a motor on or off.

    A motor that is off may report 0.15 Nm of noise (standard deviation); smoothed at 100 Hz that is 0.05 Nm, so one
    read in ten thousand takes such a motor for one that is on.
    """

    torque: float = 0.2  #: Nm, smoothed, from which on it is on; less cannot throw an arm when it is switched off
    smoothing: float = 0.05  #: s, time constant
    read_time: float = 0.2  #: s without torque that show a motor off; an arm that sinks under damping shows it sooner
    #: s of silence after which an operator may have cut its power: nobody releases an emergency stop sooner, and a
    #: brownout is over by then
    cut: float = 0.2
    off_share: float = 0.25  #: of the torque asked for, less of which a motor gives that does not deliver: it is off
    told_off: int = 2  #: replies in a row that say that a motor is off; one may be wrong, or older than its ENTER
    exit_period: float = 0.5  #: s between two EXIT frames to a motor that is off, in case it was switched on unseen


POWER = PowerTuning()


class Power(str, Enum):
    """The state of one motor."""

    UNKNOWN = "unknown"  #: at the start of a process; nothing that it sent can have switched it on
    OFF = "off"
    ENTERING = "entering"  #: is being switched on; not shown yet
    ON = "on"
    SILENT = "silent"  #: was on, does not reply
    UNSURE = "unsure"  #: may be on: another process left it, or it was silent for long
    LEAVING = "leaving"  #: is being switched off; not confirmed yet


class PowerChange(str, Enum):
    """What changes a motor's state: an order of the safety machine, or what its replies show."""

    SWITCH_ON = "order: switch on"
    SWITCH_OFF = "order: switch off"
    TAKEN_OVER = "left on by another process"
    PROBED = "start of the process"
    SHOWN_ON = "torque shown"
    SILENT = "no reply"
    CUT = "no reply for long"
    REPLIES = "replies again"
    CONFIRMED = "replied to EXIT"


NEXT: dict[tuple[Power, PowerChange], Power] = {
    (Power.OFF, PowerChange.SWITCH_ON): Power.ENTERING,
    (Power.ENTERING, PowerChange.SHOWN_ON): Power.ON,
    (Power.ON, PowerChange.SILENT): Power.SILENT,
    (Power.SILENT, PowerChange.REPLIES): Power.ON,
    (Power.SILENT, PowerChange.CUT): Power.UNSURE,
    (Power.UNSURE, PowerChange.SHOWN_ON): Power.ON,
    (Power.UNKNOWN, PowerChange.SHOWN_ON): Power.ON,
    (Power.LEAVING, PowerChange.CONFIRMED): Power.OFF,
    **{(state, PowerChange.SWITCH_OFF): Power.LEAVING for state in Power if state is not Power.OFF},
    **{(state, PowerChange.TAKEN_OVER): Power.UNSURE for state in Power},
    **{(state, PowerChange.PROBED): Power.UNKNOWN for state in Power},
}
# What a motor is sent: on V1 and V2 boards, and on V3 boards, which a command switches on.
SENT: dict[Power, tuple[Send, Send]] = {
    Power.UNKNOWN: (Send.COMMAND, Send.NOTHING),
    Power.OFF: (Send.POLL, Send.NOTHING),
    Power.ENTERING: (Send.COMMAND, Send.COMMAND),
    Power.ON: (Send.COMMAND, Send.COMMAND),
    Power.SILENT: (Send.COMMAND, Send.COMMAND),
    Power.UNSURE: (Send.COMMAND, Send.NOTHING),
    Power.LEAVING: (Send.EXIT, Send.EXIT),
}


class MotorPower:
    """The power of one motor.

    replies: whether its board replies to commands (V1, V2), or reports on its own timer (V3).

    state: of the motor. may_return: whether it may be switched on again, once, if it is found off while it carries.
    is_clearing: whether it has yet to forget its error: its last reply still shows it.
    """

    def __init__(self, replies: bool) -> None:
        self.state = Power.OFF
        self.may_return = False
        self._board = 0 if replies else 1
        self._newest = -math.inf  # s, of its last reply
        self._silent_for = self._heard_for = 0.0  # s
        self._torque = 0.0  # Nm, smoothed since it replies
        self._told_off = 0  # replies in a row that said that it is off
        self._exits: list[float] = []  # s, of the last two
        self.is_clearing = False

    @property
    def may_be_on(self) -> bool:
        """Whether the motor was switched on or left on, and has not confirmed that it is off."""
        return self.state not in (Power.OFF, Power.UNKNOWN)

    @property
    def is_heard(self) -> bool:
        """Whether it replies."""
        return self._heard_for > 0.0

    @property
    def is_quiet(self) -> bool:
        """Whether it has shown no torque for long enough to be off, or its replies say that it is."""
        return self._heard_for >= POWER.read_time or self.is_told_off

    @property
    def is_told_off(self) -> bool:
        """Whether its replies say that it is off."""
        return self._told_off >= POWER.told_off

    def change(self, change: PowerChange) -> None:
        """Go to the state that `NEXT` has for this change; stay where it has none."""
        before, self.state = self.state, NEXT.get((self.state, change), self.state)
        if self.state is before:
            return
        if self.state is Power.ENTERING:
            self.may_return = True
            self.is_clearing = False
        elif self.state in (Power.UNSURE, Power.UNKNOWN):
            self.may_return = False
            self._torque = self._heard_for = 0.0
            self._told_off = 0
        elif self.state is Power.LEAVING:
            self._exits = []

    def clear_error(self) -> None:
        """Let the motor forget its error, once, while it is off: an operator has cleared the fault."""
        self.is_clearing = self._board == 0

    def step(self, dt: float, joint: JointSample, is_silent: bool) -> None:
        """Take the newest reply, `dt` s after the last call."""
        if is_silent:
            self._silent_for += dt
            self._torque = self._heard_for = 0.0
            self._told_off = 0
            self.change(PowerChange.SILENT)
            if self._silent_for >= POWER.cut:
                self.change(PowerChange.CUT)
            return
        self._silent_for = 0.0
        self.change(PowerChange.REPLIES)
        if joint.time > self._newest:
            self._torque += min(1.0, dt / POWER.smoothing) * (joint.effort - self._torque)
            self._heard_for += dt
            self._told_off = self._told_off + 1 if joint.on is False else 0
            if self._is_confirmed_off(joint):
                self.change(PowerChange.CONFIRMED)
        self._newest = max(self._newest, joint.time)
        shows_torque = joint.on is None and abs(self._torque) > POWER.torque
        if (joint.on or shows_torque) and self.state in (Power.UNSURE, Power.UNKNOWN):
            self.change(PowerChange.SHOWN_ON)

    def _is_confirmed_off(self, joint: JointSample) -> bool:
        """Return whether a new reading shows that the motor has obeyed EXIT."""
        is_answer = len(self._exits) == 2 and joint.time >= self._exits[1]
        if joint.on is not None:
            return is_answer and not joint.on
        return is_answer and (self._board == 0 or abs(joint.effort) < POWER.torque)

    def send(self, now: float) -> Send:
        """Return what the motor is sent at `now` s."""
        send = SENT[self.state][self._board]
        if send is Send.POLL and self.is_clearing:
            self.is_clearing = False
            return Send.CLEAR_ERROR
        if self.state is Power.OFF and (not self._exits or now - self._exits[-1] >= POWER.exit_period):
            send = Send.EXIT
        if send is Send.EXIT:
            self._exits = [*self._exits[-1:], now]
        return send


class SwitchingOn:
    """Switches an arm's motors on one after another, and first clears what they remember.

    ENTER resumes the last command that a motor had while it was on, also that of another tool. Some firmware ignores
    commands while it is off, so that a zero command before ENTER clears nothing there. So each motor gets ENTER and,
    at once, a command without torque; then EXIT. Only the next ENTER carries it. Every other frame waits for the
    reply to the one before: command and reply share an ID, and would collide.

    replies: (n,) whether a motor's board replies to commands; what a V3 board remembers, no frame carries out.

    done: whether each motor has been sent ENTER.
    """

    def __init__(self, replies: Sequence[bool]) -> None:
        self.done = False
        self._replies = replies
        self._sends = [Send.POLL if board else Send.NOTHING for board in replies]
        self._course = self._run()

    def step(self) -> tuple[Send, ...]:
        """Return what each motor (n,) is sent in the next cycle."""
        return next(self._course)

    def _run(self) -> Iterator[tuple[Send, ...]]:
        for i, board in enumerate(self._replies):
            if board:
                yield self._with(i, Send.CLEAR)
                yield self._with(i, Send.EXIT)
        for i, board in enumerate(self._replies):
            if board:
                yield self._with(i, Send.ENTER)
            self._sends[i] = Send.COMMAND
        self.done = True
        while True:
            yield tuple(self._sends)

    def _with(self, i: int, send: Send) -> tuple[Send, ...]:
        return (*self._sends[:i], send, *self._sends[i + 1 :])
