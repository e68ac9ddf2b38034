"""The clock that the hardware's logic is given. A test gives it one with virtual time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Clock:
    """The computer's monotonic clock, in s. Another clock has the same four methods."""

    monotonic = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)

    def suspended(self) -> float:
        """Return the time in s for which the computer has been suspended so far, which `monotonic` does not count."""
        now = time.clock_gettime(time.CLOCK_MONOTONIC)
        return time.clock_gettime(time.CLOCK_BOOTTIME) - now

    def later(self, delay: float, function: Callable[[], None]) -> None:
        """Call `function` in `delay` s, on another thread, which does not keep the process alive."""
        timer = threading.Timer(delay, function)
        timer.daemon = True
        timer.start()


COMPUTER_CLOCK = Clock()
