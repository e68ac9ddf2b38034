"""Effort commands for a receiver that does not watch their age: late or missing input fades the torque to zero.

An effort controller of ros2_control keeps its last command for ever, and `can_bridge` is not there to let the arm down.
So the sender does it: while sound efforts arrive they are passed on; `timeout` after the last one, or when they are
withdrawn, the last torque fades linearly to zero over `fade_time`. The fault is latched: zeros follow until an operator
clears it, because an arm that was let down must not rise by itself. The next torque ramps in from zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum

from exo_gravity.core.params import Param


class Output(Enum):
    """WAITING: nothing was sent yet. ACTIVE: efforts are passed on. FADING: towards zero. ZERO: latched."""

    WAITING = "waiting"
    ACTIVE = "active"
    FADING = "fading"
    ZERO = "zero"


# fmt: off
COMMAND_PARAMETERS = (
    Param("command_interface", "joint_state",
          "joint_state: to can_bridge; multi_array: to an effort controller of ros2_control", fixed=True,
          choices=("joint_state", "multi_array")),
    Param("multi_array.topic", "effort_controller/commands", "topic of the effort controller's commands", fixed=True),
    Param("multi_array.joint_states", "joint_states", "topic of the joint states, which may have further joints",
          fixed=True),
    Param("multi_array.timeout", 0.05, "age of the joint states at which the torque begins to fade", (0.01, 0.15), "s",
          fixed=True),
    # A launcher kills a node 5 s after it asked it to end. A fade must be over by then.
    Param("multi_array.fade_time", 2.0, "time over which it fades", (0.5, 3.0), "s", fixed=True),
)
# fmt: on


class CommandFade:
    """What to send at each moment. timeout, fade_time: s. state, reason: the present state, and what began the fade."""

    def __init__(self, timeout: float, fade_time: float) -> None:
        self.state = Output.WAITING
        self.reason = ""
        self._timeout, self._fade_time = timeout, fade_time
        self._effort: tuple[float, ...] = ()
        self._time = -math.inf  # s, of the last effort; then of the begin of the fade

    @property
    def is_open(self) -> bool:
        """Whether efforts are passed on."""
        return self.state in (Output.WAITING, Output.ACTIVE)

    @property
    def problem(self) -> str:
        """Why efforts are not passed on; '' if they are."""
        return "" if self.is_open else f"{self.reason}: {self.state.value}, call clear_fault"

    def take(self, now: float, effort: Sequence[float]) -> bool:
        """Return whether `effort` (n,) Nm, computed at `now` s, may be sent."""
        if not self.is_open:
            return False
        self.state, self._effort, self._time = Output.ACTIVE, tuple(effort), now
        return True

    def withdraw(self, now: float, reason: str) -> None:
        """Begin the fade at `now` s, if efforts were sent."""
        if self.state is Output.ACTIVE:
            self.state, self.reason, self._time = Output.FADING, reason, now

    def tick(self, now: float) -> tuple[float, ...] | None:
        """Return the faded effort (n,) Nm to send at `now` s; None while sound efforts arrive, and before the first."""
        if self.state is Output.ACTIVE and now - self._time > self._timeout:
            self.withdraw(now, f"no joint_states younger than {1000.0 * self._timeout:.0f} ms")
        if self.is_open:
            return None
        left = 1.0 - (now - self._time) / self._fade_time
        if left <= 0.0:
            self.state = Output.ZERO
        return tuple(max(0.0, min(1.0, left)) * effort for effort in self._effort)

    def clear(self) -> bool:
        """Pass efforts on again. Return False, and do nothing, unless the torque has faded to zero."""
        if self.state is not Output.ZERO:
            return False
        self.state, self.reason = Output.WAITING, ""
        return True
