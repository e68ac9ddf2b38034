"""What the system may be asked for besides nice values: a real-time thread, and memory that stays in memory.

Off by default. A thread under SCHED_FIFO is run at once, whatever else is ready; but while others wait on its processor
Linux keeps it from running now and then, on some kernels for up to 50 ms (measured, 6.18), which lets the arm down.
"""

from __future__ import annotations

import ctypes
import os

from rclpy.node import Node

# Of mlockall(2), in <sys/mman.h>: what is mapped now, and later, once it is used.
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4


def ask_real_time(node: Node, asked: tuple[int, bool], thread: int | None) -> None:
    """Do what `asked` says, (thread_priority of `thread`, lock_memory), and warn of what is not permitted."""
    priority, lock_memory = asked
    if priority and thread:
        try:
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        except PermissionError:
            node.get_logger().warning(f"thread_priority {priority} is not permitted here: it needs an rtprio limit")
    if lock_memory and ctypes.CDLL(None).mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT):
        node.get_logger().warning("lock_memory is not permitted here: it needs a higher memlock limit")
