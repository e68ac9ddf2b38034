"""What the system is asked for: nice values, timers that end on time, real-time threads, memory that stays in memory.

The last two are options, off by default. A thread under SCHED_FIFO is run at once, whatever else is ready; but while
others wait on its processor Linux keeps it from running now and then, on some kernels for up to 50 ms (measured, 6.18),
which lets the arm down.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading

PR_SET_TIMERSLACK = 29  # prctl(2), in <sys/prctl.h>
# Of mlockall(2), in <sys/mman.h>: what is mapped now, and later, once it is used.
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4


def favour(priority: int) -> None:
    """Ask for a nice value of -`priority` (1..20), and for sleeps that end on time: Linux lets them last 50 us longer.

    For this thread and those that it starts later. Where it is not permitted they run like any other.
    """
    ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1)  # ns
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -priority)


def ask_real_time(priority: int, lock_memory: bool) -> list[str]:
    """Do what is asked for and return what was not permitted.

    priority: of all threads of this process but the caller's, the middleware's included, which hands the messages
    over, under SCHED_FIFO; 0 leaves them as they are.
    """
    refused = []
    if priority:
        try:
            for thread in map(int, os.listdir("/proc/self/task")):
                if thread != threading.get_native_id():
                    os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        except PermissionError:
            refused.append(f"thread_priority {priority} is not permitted here: it needs an rtprio limit")
    if lock_memory and ctypes.CDLL(None).mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT):
        refused.append("lock_memory is not permitted here: it needs a higher memlock limit")
    return refused
