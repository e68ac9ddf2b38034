# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The states of an arm between off and carried: every transition, and what each state sends.

Two states are safe. While nothing is proven (checking, proving), any fault switches the motors off, as soon as their
push is taken back (3 Nm in 60 ms): the arm hangs, and a motor that damps with the wrong sign would drive it. Once the
arm is carried, it is lowered under damping.
A fault is latched in `FAULT`, which only the operator leaves, and only to `DISABLED`: that never enables the arm.
"""

from enum import Enum

from exo_gravity.core.safety.drive import State


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
