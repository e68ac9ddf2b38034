"""What the motors of an arm receive in one cycle, and the states of the machine that decides it."""

from __future__ import annotations

import operator
from enum import Enum
from typing import NamedTuple

NOTHING = (0.0, 0.0, 0.0, 0.0)


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
    """What the motors receive.

    effort: (4,) Nm. damping: (4,) Nm s/rad. powered: whether they are to be on. enter: (4,) which motors must be
    switched on again, because they are found off.
    """

    effort: tuple[float, ...]
    damping: tuple[float, ...]
    powered: bool
    enter: tuple[bool, ...] = (False, False, False, False)

    def within(self, peak_damping: tuple[float, ...]) -> Drive:
        """Return the drive with no more damping than `peak_damping` (4,) Nm s/rad."""
        if not any(map(operator.gt, self.damping, peak_damping)):
            return self
        return self._replace(damping=tuple(map(min, self.damping, peak_damping)))


# The states in which torque is applied on request.
CARRYING = (State.PROVING, State.RAMPING_IN, State.ACTIVE)

OFF = Drive(NOTHING, NOTHING, False)
