"""What the motors of an arm receive in one cycle, and the states of the machine that decides it."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

NOTHING: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)


class State(str, Enum):
    """The state of the arm between off and carried."""

    DISABLED = "disabled"
    CHECKING = "checking"
    PROVING = "proving signs"
    RAMPING_IN = "ramping in"
    ACTIVE = "active"
    LETTING_DOWN = "letting down"
    FAULT = "fault"


class Drive(NamedTuple):
    """What the motors receive: effort (4,) Nm, one damping in Nm s/rad, and whether they are switched on."""

    effort: tuple[float, ...]
    damping: float
    powered: bool


# The states in which torque is applied on request.
CARRYING = (State.PROVING, State.RAMPING_IN, State.ACTIVE)

OFF = Drive(NOTHING, 0.0, False)
