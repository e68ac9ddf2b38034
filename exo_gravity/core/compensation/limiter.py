"""What keeps torques from stepping, for any number of joints: the limits of ramp and rate, and a last fade."""

import math
from collections.abc import Sequence
from enum import Enum

RAMP_TIME = 1.0  # s from zero to full torque, at the start and after a break
# s without an answer, after which the torque ramps in from zero. This is longer than any command_timeout: the arm is
# already being let down, so the restart from zero cannot drop it.
BREAK = 0.2
LONGEST_STEP = 0.01  # s that the rate limit allows for after a pause, so that the torque does not catch up in one step
FADE_TIME = 2.0  # s of the last fade; a launcher kills a node 5 s after it asked it to end


def limited(wanted: float, last: float, limit: float, step: float) -> float:
    """Return `wanted` within -limit..limit and within `step` of `last`."""
    target = limit if wanted > limit else -limit if wanted < -limit else wanted
    return last + step if target > last + step else last - step if target < last - step else target


class Output(Enum):
    """What `CommandFade` sends."""

    WAITING = "waiting"  #: nothing was sent yet
    ACTIVE = "active"  #: efforts are passed on
    FADING = "fading"  #: towards zero
    ZERO = "zero"  #: latched


class CommandFade:
    """Effort commands for a receiver that does not watch their age: late or missing input fades the torque to zero.

    An effort controller of ros2_control keeps its last command for ever, and `can_bridge` is not there to let the arm
    down. So the sender does it: while sound efforts arrive they are passed on; `timeout` s after the last one, or when
    they are withdrawn, the last torque fades linearly to zero over FADE_TIME. The fault is latched: zeros follow
    until an operator clears it, because an arm that was let down must not rise by itself. The next torque ramps in.
    """

    def __init__(self, timeout: float) -> None:
        self.state = Output.WAITING
        self.reason = ""  #: what began the fade
        self._timeout = timeout
        self._effort: tuple[float, ...] = ()
        self._time = -math.inf  # s, of the last effort; then of the begin of the fade
        self._held: tuple[float, ...] = ()  # what the joints applied before the first effort
        self._start = -math.inf  # s, of the first effort

    @property
    def is_open(self) -> bool:
        """Whether efforts are passed on."""
        return self.state in (Output.WAITING, Output.ACTIVE)

    @property
    def problem(self) -> str:
        """Why efforts are not passed on; '' if they are."""
        return "" if self.is_open else f"{self.reason}: {self.state.value}, call clear_fault"

    def take(self, now: float, effort: Sequence[float], applied: Sequence[float]) -> tuple[float, ...] | None:
        """Return the efforts to send for `effort` (n,) Nm, computed at `now` s; None if none may be sent.

        applied: (n,) Nm that the joints apply; only that before the first effort matters.
        """
        if not self.is_open:
            return None
        if self.state is Output.WAITING:
            self.state, self._held, self._start = Output.ACTIVE, tuple(applied), now
        left = max(0.0, 1.0 - (now - self._start) / RAMP_TIME)
        self._effort, self._time = tuple([tau + left * h for tau, h in zip(effort, self._held, strict=True)]), now
        return self._effort

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
        left = 1.0 - (now - self._time) / FADE_TIME
        if left <= 0.0:
            self.state = Output.ZERO
        return tuple(max(0.0, min(1.0, left)) * effort for effort in self._effort)

    def clear(self) -> bool:
        """Pass efforts on again. Return False, and do nothing, unless the torque has faded to zero."""
        if self.state is not Output.ZERO:
            return False
        self.state, self.reason = Output.WAITING, ""
        return True
