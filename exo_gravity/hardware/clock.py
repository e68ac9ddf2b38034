"""The clock that the hardware's logic is given. A test gives it one with virtual time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Clock:
    """The computer's monotonic clock, in s. Another clock has the same three methods."""

    monotonic = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)

    def later(self, delay: float, function: Callable[[], None]) -> None:
        """Call `function` in `delay` s, on another thread, which does not keep the process alive."""
        timer = threading.Timer(delay, function)
        timer.daemon = True
        timer.start()


COMPUTER_CLOCK = Clock()
