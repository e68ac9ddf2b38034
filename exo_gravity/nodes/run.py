"""How every node lives: start, spin, and a clean stop on Ctrl-C, SIGTERM or an error.

rclpy's own signal handlers close the context before anybody can react. Here a signal only asks for the end, so that a
node's `close` still has a living context, and the last CAN frames do leave.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from exo_gravity.core.errors import ExoGravityError
from exo_gravity.hardware.scheduling import favour

LOOK = 0.1  # s between two looks at whether a node is still needed
CLOSING = 5  # s that the middleware may take to close
SWITCH_INTERVAL = 2e-4  # s that a thread back from the bus may have to wait for the interpreter; Python's own is 5 ms


def keep_to_this_machine() -> None:
    """Set the middleware's defaults, before `rclpy.init`, for what the user's environment leaves open."""
    # Without this, anybody on the subnet could publish torques to a worn robot.
    reach = os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if reach == "LOCALHOST":
        os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(Path(__file__).with_name("fastdds.xml")))


def open_to_others() -> str:
    """Return which setting lets other hosts publish to our topics, or '' if only this machine can, or security must."""
    get = os.environ.get
    if get("ROS_SECURITY_ENABLE") == "true" and get("ROS_SECURITY_STRATEGY") == "Enforce":
        return ""
    if get("ROS_DISCOVERY_SERVER"):
        return f"ROS_DISCOVERY_SERVER={get('ROS_DISCOVERY_SERVER')}"
    reach = get("ROS_AUTOMATIC_DISCOVERY_RANGE")
    if get("ROS_LOCALHOST_ONLY") == "1" or reach == "OFF":  # rcl then ignores what follows
        return ""
    if get("ROS_STATIC_PEERS"):
        return f"ROS_STATIC_PEERS={get('ROS_STATIC_PEERS')}"
    return "" if reach == "LOCALHOST" else f"ROS_AUTOMATIC_DISCOVERY_RANGE={reach}"


def run(make_node: Callable[[], Node], priority: int = 0, args: list[str] | None = None) -> int:
    """Run one node until a signal or an error; return the exit code (1 failed, 2 wrong parameters).

    priority: 1..20, how much nicer than others the system is asked to be to this node, where the user may ask that.
    Not SCHED_FIFO: four such nodes can fill a core, and Linux then stops them all for 50 ms a second.

    A node may have `close()`, called on every way out, `failure`, an exception found in a thread of its own, and
    `needed`: as long as it is true the node outlives a launcher that died.
    """
    keep_to_this_machine()
    ending: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _: ending.append(received))
    if priority:
        favour(priority)
    executable = os.path.basename(sys.argv[0])
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = make_node()
    except (ExoGravityError, RuntimeError) as error:  # RuntimeError: rcl could not read its own arguments
        get_logger(executable).fatal(str(error))
        os._exit(2)  # without closing Fast DDS: it can hang when it is closed while it discovers others
    if os.environ.get("EXO_GRAVITY_SUPERVISED"):
        threading.Thread(target=_end_with_launcher, args=(node, ending), daemon=True).start()
    gc.collect()
    gc.freeze()  # what was imported stays: later collections need not look at it
    sys.setswitchinterval(SWITCH_INTERVAL)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while not ending:
            executor.spin_once(timeout_sec=0.1)
            if getattr(node, "failure", None):
                raise node.failure
        return 0
    except Exception as error:
        node.get_logger().fatal(f"stopped by {type(error).__name__}: {error}")
        return 1
    finally:
        getattr(node, "close", lambda: None)()
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(CLOSING)  # ends the process even where Fast DDS hangs with the interpreter's lock in its hands
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


def _end_with_launcher(node: Node, ending: list[int]) -> None:
    """Wait until the launcher, which holds our standard input open, is no more."""
    sys.stdin.read()
    while getattr(node, "needed", False):
        time.sleep(LOOK)
    ending.append(0)
