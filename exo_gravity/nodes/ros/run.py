# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The life of every node: start, spin, and a clean stop on Ctrl-C, SIGTERM or an error.

rclpy's own signal handlers close the context before a node can react. Here a signal only sets a flag, so that a node's
`close` still has a valid context, and its last CAN frames are sent.
"""

import contextlib
import gc
import inspect
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import rclpy
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.vocabulary import NONE, UNKNOWN, ClockState
from exo_gravity.hardware.clock import raise_priority
from exo_gravity.hardware.network import check_environment, localhost_notice, restrict_to_localhost
from exo_gravity.nodes.ros.inner import NodeExecutor
from exo_gravity.nodes.ros.messages import ERROR, OK, Diagnostics

NEEDED_CHECK_PERIOD = 0.1  # s
CLOSE_TIMEOUT = 5  # s for the middleware to close
SWITCH_INTERVAL = 2e-4  # s that a thread may wait for the interpreter's lock; Python's default is 5 ms
NO_CLOCK_TIMEOUT = 2.0  # s of a clock that stands still, without a publisher of /clock
NO_CLOCK = "use_sim_time is true, but nobody publishes /clock: this node's clock and timers stand still"
HELP = """
Parameters: docs/parameters.md. Start it from a parameter file with `launcher --params FILE`, or alone:
  {name} --ros-args -r __ns:=/right --params-file FILE
"""


def run(make_node: Callable[[], Node], priority: int = 0) -> int:
    """Run one node until a signal or an error; return the exit code (1 failed, 2 wrong parameters).

    priority: 1..20, requests nice value -priority, where permitted. Not SCHED_FIFO: four such nodes can fill a core,
    and Linux then stops them all for 50 ms in every second.

    A node may have
    close(): called however the node ends;
    failure: an exception raised in one of its threads, or None;
    needed: while it is true, the node keeps running after its launcher has died.
    """
    executable = os.path.basename(sys.argv[0])
    if {"-h", "--help"}.intersection(sys.argv[1:]):
        sys.stdout.write((inspect.getdoc(inspect.getmodule(make_node)) or "") + HELP.format(name=executable))
        return 0
    restrict_to_localhost()
    ending: list[int] = []
    handle_signals(ending)
    if priority:
        raise_priority(priority)
    with contextlib.suppress(OSError):
        Path("/proc/self/comm").write_text(executable)  # for ps, top and pgrep
    try:
        check_environment()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = make_node()
    except (ExoGravityError, RuntimeError) as error:  # RuntimeError: rcl could not read its own arguments
        get_logger(executable).fatal(str(error))
        os._exit(2)  # without closing Fast DDS, which can hang when it is closed during discovery
    is_supervised = bool(os.environ.get("EXO_GRAVITY_SUPERVISED"))
    if not is_supervised and (sentence := localhost_notice()):  # else the launcher says it, once for all
        node.get_logger().info(sentence)
    if is_supervised:
        threading.Thread(target=_end_with_launcher, args=(node, ending), daemon=True).start()
    gc.collect()
    gc.freeze()  # imported modules stay: later collections can skip them
    sys.setswitchinterval(SWITCH_INTERVAL)
    executor = NodeExecutor()
    executor.add_node(node)
    clock = ClockWatch(node)
    try:
        while not ending:
            executor.spin_once(timeout_sec=0.1)
            clock.look()
            if failure := getattr(node, "failure", None):
                raise failure
        return 0
    except Exception as error:
        node.get_logger().fatal(f"stopped by {type(error).__name__}: {error}")
        return 1
    finally:
        getattr(node, "close", lambda: None)()
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(CLOSE_TIMEOUT)  # ends the process even if Fast DDS hangs while it holds the interpreter's lock
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


class ClockWatch:
    """Says that a node waits for a clock that nobody publishes: none of its timers runs then, and no report is sent."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._seen: int | None = None  # ns, on the node's clock, when it last moved
        self._since = time.monotonic()
        self._diagnostics: Diagnostics | None = None  # once there was something to say

    def look(self) -> None:
        """Report on /diagnostics, and in the log, if the clock stands still. Call it several times a second."""
        clock, now = self._node.get_clock(), time.monotonic()
        seen = clock.now().nanoseconds if clock.ros_time_is_active else None
        if seen is None or seen != self._seen:
            self._seen, self._since = seen, now
            if self._diagnostics:
                is_published = seen is not None
                message = "/clock is published" if is_published else "use_sim_time is false"
                self._diagnostics.report(OK, message, _clock(ClockState.PUBLISHED if is_published else NONE))
                self._diagnostics = None
        elif now - self._since > NO_CLOCK_TIMEOUT and not self._node.count_publishers("/clock"):
            self._diagnostics = self._diagnostics or Diagnostics(self._node)
            self._diagnostics.report(ERROR, NO_CLOCK, _clock(ClockState.MISSING))


def _clock(state: str) -> dict[str, object]:
    """Return what programs read of the clock; what else the node does it says itself, once it has one."""
    return {"state": UNKNOWN, "clock": state}


def handle_signals(ending: list[int]) -> None:
    """Let each signal that ends the node be appended to `ending`.

    A SIGHUP that is ignored, as nohup does, stays ignored.
    """
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda received, _: ending.append(received))


def _end_with_launcher(node: Node, ending: list[int]) -> None:
    """Wait until the launcher, which holds our standard input open, has died; then end the node."""
    sys.stdin.read()
    while getattr(node, "needed", False):
        time.sleep(NEEDED_CHECK_PERIOD)
    ending.append(0)
