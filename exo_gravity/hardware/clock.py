"""The clock that the hardware's logic is given: the computer's, or one whose time is virtual."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Monotonic time, and ways to wait for it."""

    def monotonic(self) -> float:
        """Return the time in s."""
        ...

    def sleep(self, duration: float, /) -> None:
        """Wait for `duration` s."""
        ...

    def later(self, delay: float, function: Callable[[], None]) -> None:
        """Call `function` in `delay` s, on another thread."""
        ...


class ComputerClock:
    """The computer's monotonic clock."""

    monotonic = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)

    def later(self, delay: float, function: Callable[[], None]) -> None:
        """Call `function` in `delay` s, on another thread, which does not keep the process alive."""
        timer = threading.Timer(delay, function)
        timer.daemon = True
        timer.start()


COMPUTER_CLOCK = ComputerClock()
