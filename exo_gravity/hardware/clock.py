# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What is asked of the computer: the time, and to be run in time. sim/virtual_time.py has a clock of virtual time."""

import contextlib
import ctypes
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

PR_SET_TIMERSLACK = 29  # prctl(2), in <sys/prctl.h>
# Flags of mlockall(2), in <sys/mman.h>: pages mapped now, pages mapped later, and only once they are used.
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4


class Clock(Protocol):
    """A monotonic clock, in s."""

    def monotonic(self) -> float:
        """Return the time in s."""
        ...

    def sleep(self, duration: float) -> None:
        """Return after `duration` s."""
        ...

    def suspended(self) -> float:
        """Return the time in s for which the computer has been suspended so far, which `monotonic` does not count."""
        ...

    def later(self, delay: float, function: Callable[[], None]) -> None:
        """Call `function` in `delay` s."""
        ...


class ComputerClock:
    """The computer's clock. `later` uses another thread, which does not keep the process alive."""

    monotonic = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)

    def suspended(self) -> float:
        """Return the time in s for which the computer has been suspended so far."""
        now = time.clock_gettime(time.CLOCK_MONOTONIC)
        return time.clock_gettime(time.CLOCK_BOOTTIME) - now

    def later(self, delay: float, function: Callable[[], None]) -> None:
        """Call `function` in `delay` s, on another thread."""
        timer = threading.Timer(delay, function)
        timer.daemon = True
        timer.start()


COMPUTER_CLOCK = ComputerClock()


def raise_priority(priority: int) -> None:
    """Request nice value -`priority` (1..20) and precise sleeps: by default Linux ends them up to 50 us late.

    This applies to the calling thread and those that it starts later. Where Linux groups processes by session
    (sched(7), autogroup), a nice value acts within the group alone: so the session gets it too. What is not permitted
    is ignored.
    """
    ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1)  # ns
    with contextlib.suppress(OSError):  # not permitted, or no autogroups
        os.setpriority(os.PRIO_PROCESS, 0, -priority)
        Path("/proc/self/autogroup").write_text(f"{-priority}")


def set_realtime_priority(priority: int, log: Callable[[str], object]) -> None:
    """Request real-time scheduling and locked memory; log a sentence for each request that is not permitted.

    An option, off by default. A SCHED_FIFO thread runs at once, whatever else is ready; but while other threads wait
    for its processor, Linux sometimes throttles it, on some kernels for up to 50 ms (measured, 6.18), which lets the
    arm down.

    priority: SCHED_FIFO priority for all threads of this process except the caller's. It includes the middleware's
    threads, which deliver the messages. 0 requests nothing.
    """
    if not priority:
        return
    try:
        for thread in map(int, os.listdir("/proc/self/task")):
            if thread != threading.get_native_id():
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        log(f"thread_priority {priority} is not permitted: raise the rtprio limit in limits.conf")
    if ctypes.CDLL(None).mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT):
        log("locked memory is not permitted: raise the memlock limit in limits.conf")
