# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Asks on a terminal whether an arm hangs as it is drawn, when the start of its can_bridge waits for the answer.

The launcher runs it on its own terminal; arguments: the full names of the nodes can_bridge to ask for. It is an
operator like any other: the question comes from /diagnostics, the answer is a call of `~/confirm_pose`. An answer to a
question that no longer stands is none to the next.
"""

import contextlib
import select
import sys
import termios
from functools import partial

import rclpy
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from exo_gravity.hardware.network import restrict_to_localhost
from exo_gravity.nodes.others import Statuses
from exo_gravity.nodes.ros.messages import NO_POSE, POSE_TO_CONFIRM

SILENT = 1.5  # s without diagnostics after which a question no longer stands
ANSWER_TIMEOUT = 3.0  # s, longer than can_bridge itself waits
ENCLAVE = ("--ros-args", "--enclave", "/operator")  # what a person may do under SROS2


def main() -> None:
    """Ask until Ctrl-C or the end of the terminal."""
    restrict_to_localhost()
    rclpy.init(args=[sys.argv[0], *ENCLAVE], signal_handler_options=SignalHandlerOptions.NO)
    node, say = rclpy.create_node("operator"), partial(print, flush=True)
    statuses, answered = Statuses(node), set[str]()  # the latter are the bridges whose present question was answered
    services = {bridge: node.create_client(Trigger, f"{bridge}/confirm_pose") for bridge in sys.argv[1:]}

    def pose(bridge: str) -> str:
        return str(statuses.within(SILENT, bridge[1:]).get(POSE_TO_CONFIRM, NO_POSE))

    with contextlib.suppress(KeyboardInterrupt, EOFError):
        while True:
            rclpy.spin_once(node, timeout_sec=0.1)
            asking = {bridge for bridge in services if pose(bridge) != NO_POSE}
            new, answered = asking - answered, asking
            for bridge in new:
                termios.tcflush(sys.stdin, termios.TCIFLUSH)
                say(f"{bridge}: does the arm hang as it is drawn, joints at {pose(bridge)} degrees? [y/N] ", end="")
                while pose(bridge) != NO_POSE and not select.select([sys.stdin], [], [], 0.0)[0]:
                    rclpy.spin_once(node, timeout_sec=0.1)
                if pose(bridge) == NO_POSE or input().strip().lower() not in ("y", "yes"):
                    say(f"{bridge}: not confirmed; let the arm hang, or calibrate its zeros, and enable it again")
                    continue
                sent = services[bridge].call_async(Trigger.Request())
                rclpy.spin_until_future_complete(node, sent, timeout_sec=ANSWER_TIMEOUT)
                say(f"{bridge}: {sent.result().message if sent.done() else 'the bridge did not answer'}")
    rclpy.try_shutdown()
