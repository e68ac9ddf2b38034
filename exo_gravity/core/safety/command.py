# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the safety machine decides: its state, what the motors receive, and the fault that let a worn arm down.

Two states are safe. While nothing is proven (checking, proving), any fault switches the motors off, as soon as their
push is taken back (3 Nm in 60 ms): the arm hangs, and a motor that damps with the wrong sign would drive it. Once the
arm is carried, it is lowered under damping.

A fault is latched in `FAULT`, which only the operator leaves, and only to `DISABLED`: that never enables the arm.

Every fault has a code for programs and a sentence for people.
"""

import math
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple


class State(str, Enum):
    """The state of the arm between off and carried."""

    DISABLED = "disabled"
    CHECKING = "checking"
    PROVING = "proving signs"
    RAMPING_IN = "ramping in"
    ACTIVE = "active"
    LETTING_DOWN = "letting down"
    FAULT = "fault"


class StateEvent(str, Enum):
    """What may change the state."""

    ENABLE = "enable"  #: by the operator
    DISABLE = "disable"  #: by the operator, or an end of the node
    CLEAR = "clear"  #: by the operator
    PASSED = "all well"  #: the start gate has passed
    REFUSED = "refused"  #: it has not, in time
    PROVEN = "motors on, signs right"
    RAMPED = "full torque"
    FAULT = "fault"
    FOUND_ON = "a motor is on"  #: that should be off, by its replies
    DOWN = "down"  #: nothing holds the arm, and nothing moves it
    DOWN_AFTER_FAULT = "down after a fault"


TRANSITIONS: dict[tuple[State, StateEvent], State] = {
    (State.DISABLED, StateEvent.ENABLE): State.CHECKING,
    (State.DISABLED, StateEvent.FAULT): State.FAULT,
    (State.DISABLED, StateEvent.FOUND_ON): State.LETTING_DOWN,
    (State.CHECKING, StateEvent.PASSED): State.PROVING,
    (State.CHECKING, StateEvent.REFUSED): State.DISABLED,
    (State.CHECKING, StateEvent.DISABLE): State.DISABLED,
    (State.CHECKING, StateEvent.FAULT): State.FAULT,
    (State.CHECKING, StateEvent.FOUND_ON): State.LETTING_DOWN,
    (State.PROVING, StateEvent.PROVEN): State.RAMPING_IN,
    (State.PROVING, StateEvent.DISABLE): State.DISABLED,
    (State.PROVING, StateEvent.FAULT): State.FAULT,
    (State.RAMPING_IN, StateEvent.RAMPED): State.ACTIVE,
    (State.RAMPING_IN, StateEvent.DISABLE): State.LETTING_DOWN,
    (State.RAMPING_IN, StateEvent.FAULT): State.LETTING_DOWN,
    (State.ACTIVE, StateEvent.DISABLE): State.LETTING_DOWN,
    (State.ACTIVE, StateEvent.FAULT): State.LETTING_DOWN,
    (State.LETTING_DOWN, StateEvent.DOWN): State.DISABLED,
    (State.LETTING_DOWN, StateEvent.DOWN_AFTER_FAULT): State.FAULT,
    (State.FAULT, StateEvent.CLEAR): State.DISABLED,
    (State.FAULT, StateEvent.FOUND_ON): State.LETTING_DOWN,
}


# The states in which torque is applied on request.
CARRYING = (State.PROVING, State.RAMPING_IN, State.ACTIVE)


class Efforts(NamedTuple):
    """What the motors are asked to apply, in answer to the samples of one cycle."""

    effort: Sequence[float] | None  #: (n,) Nm, or None to withdraw.
    answered: float  #: s, when the joint states that it answers were taken.
    damped: bool  #: Whether the load is changing, so that the motors are to damp the joints.
    held: bool  #: Whether they are computed from a tilt that is late.


NO_EFFORTS = Efforts(None, -math.inf, False, False)  # before the first ones


class Send(Enum):
    """What a motor is sent in one cycle. Its wire format has the frames."""

    NOTHING = "nothing"
    POLL = "poll"  #: a command without torque and gains, to be read while it is off; none to a V3 board
    COMMAND = "command"  #: its effort and damping; switches no V1 or V2 board on, but a V3 board
    ENTER = "enter"  #: is switched on
    CLEAR = "clear"  #: is switched on and, at once, forgets the command that it remembers
    EXIT = "exit"  #: is switched off
    CLEAR_ERROR = "clear error"  #: forgets an error that keeps it off; polled where a board has no such frame


class Command(NamedTuple):
    """What the motors receive in one cycle."""

    effort: tuple[float, ...]  #: (n,) Nm
    damping: tuple[float, ...]  #: (n,) Nm s/rad
    send: tuple[Send, ...]  #: (n,)
    powered: bool  #: whether one of them may be on
    is_unproven: bool = False  #: whether they are being switched on, and damping may yet drive a joint

    @classmethod
    def off(cls, count: int) -> "Command":
        """Return what `count` motors receive that are off: nothing to apply."""
        return cls((0.0,) * count, (0.0,) * count, (Send.POLL,) * count, False)


# After a fault, zeros and signs are checked again: an encoder may have lost its turn count, or a motor its power.
RECHECK = "recheck"
# After a fault, the operator may carry on at once: a computer, bus or network was late; nothing needs a repair.
RESUME = "resume"


class FaultCode(str, Enum):
    """The code of a fault, as published on /diagnostics; `meaning` explains it.

    Every fault latches: the arm is let down, or stays off, until the operator clears the fault.
    """

    meaning: str
    needs_recheck: bool
    is_resumable: bool

    def __new__(cls, value: str, meaning: str, then: str = "") -> "FaultCode":
        """Create a code from its text, its meaning and what follows."""
        code = str.__new__(cls, value)
        code._value_, code.meaning = value, meaning
        code.needs_recheck, code.is_resumable = then == RECHECK, then == RESUME
        return code

    def __str__(self) -> str:
        return str(self.value)

    # The motors
    MOTOR_SILENT = "motor_silent", "a motor has not replied for 0.05 s, nor to 7 commands", RESUME
    MOTOR_ERROR = "motor_error", "a motor reports an error"
    OVER_TEMPERATURE = "over_temperature", "a motor is hotter than 80 degC"
    TORQUE_NOT_DELIVERED = "torque_not_delivered", "a motor's reply shows another torque than commanded", RECHECK
    TORQUE_DIPPED = "torque_dipped", "a joint fell while the loop stood still: its motor's time-out is too short"
    # The motion
    OVER_SPEED = "over_speed", "a joint turns faster than `max_velocity`"
    OUTSIDE_LIMITS = "outside_limits", "a joint is over 0.1 rad beyond `position_min` or `position_max`"
    POSITION_JUMP = "position_jump", "an angle changed by 0.05 rad more than `over_speed` allows"
    READINGS_CONTRADICT = (
        "readings_contradict",
        "a motor's angle has turned otherwise than its velocity says: wrong `velocity_range`, or a slipping encoder",
    )
    # The start gate
    IMPLAUSIBLE_ZERO = "implausible_zero", "a joint is over 0.5 rad (AK80-9: 0.34) from `home` at the first start"
    TORQUE_WHILE_HANGING = (
        "torque_while_hanging",
        "at the first start, an arm that hangs is asked for more than 1.5 Nm, or a third of `max_effort`",
    )
    WRONG_SIGN = "wrong_sign", "a joint moved against a small test torque at the first start"
    SIGN_UNPROVEN = "sign_unproven", "a joint did not move under a small test torque at the first start"
    JOINTS_EXCHANGED = (
        "joints_exchanged",
        "a joint moved sooner than one that it carries at the first start: exchanged CAN IDs, or an arm that is held",
    )
    # The efforts
    COMMAND_STALE = "command_stale", "no effort command answers a joint state younger than `command_timeout`", RESUME
    COMMAND_WITHDRAWN = "command_withdrawn", "the compensator withdrew its efforts; its diagnostics say why", RESUME
    COMMAND_IMPOSSIBLE = (
        "command_impossible",
        "an effort is NaN, beyond 40 Nm (large motors: twice their peak torque), misnamed or missing",
    )
    UNEXPLAINED_TORQUE = (
        "unexplained_torque",
        "the efforts exceed what gravity needs of any load up to `largest_moment`, plus `largest_addition`",
    )
    LOAD_MISSING = "load_missing", "joints at rest moved off as if the arm had lost its load"
    SECOND_COMMANDER = "second_commander", "two publishers send effort commands"
    # The operator
    CONTROL_LOST = "control_lost", "who held control of the arm has not renewed it for 1 s", RESUME
    # The bus and the computer
    FOREIGN_COMMAND = "foreign_command", "another sender commands a motor of this arm", RECHECK
    BUS_ERROR = "bus_error", "the CAN bus cannot be opened, or sending or receiving failed", RESUME
    REPLIES_LATE = "replies_late", "a motor answers commands older than 0.04 s: a queue between it and the bridge grows"
    WATCHDOG_DEAD = "watchdog_dead", "the watchdog process has died"
    INTERNAL_ERROR = "internal_error", "an unexpected exception in the control loop, or a node that stood still"


class Fault(NamedTuple):
    """A fault that occurred: its code, and a sentence that names the joint, the value and the limit."""

    code: FaultCode
    reason: str
    joint: str = ""  #: its name; '' where no joint alone is concerned

    @classmethod
    def of_joint(cls, code: FaultCode, joint: str, reason: str) -> "Fault":
        """Return the fault of one joint, whose sentence begins with its name."""
        return cls(code, f"{joint}: {reason}", joint)
