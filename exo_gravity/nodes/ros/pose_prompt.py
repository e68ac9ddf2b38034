# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Asks on a terminal whether an arm hangs as it is drawn, when the start of its can_bridge waits for the answer.

The launcher runs it on its own terminal; arguments: the full names of the nodes can_bridge to ask for. It is an
operator like any other: the question comes from /diagnostics, the answer is a call of `~/confirm_pose`.
"""

import contextlib
import sys
from collections.abc import Callable, Sequence
from functools import partial

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.nodes.ros.messages import NO_POSE, POSE_TO_CONFIRM, Statuses

SILENT = 1.5  # s without diagnostics after which a question no longer stands
ANSWER_TIMEOUT = 3.0  # s, longer than can_bridge itself waits
ENCLAVE = ("--ros-args", "--enclave", "/operator")  # what a person may do under SROS2


class PosePrompt(Node):
    """The operator at a terminal.

    bridges: full names of the nodes can_bridge to ask for.
    ask: shows a question and returns the line that was typed. say: shows a sentence.
    """

    def __init__(self, bridges: Sequence[str], ask: Callable[[str], str], say: Callable[[str], None]) -> None:
        super().__init__("operator")
        self._ask, self._say = ask, say
        self._statuses = Statuses(self)
        self._services = {bridge: self.create_client(Trigger, f"{bridge}/confirm_pose") for bridge in bridges}
        self._answered: set[str] = set()  # the bridges whose present question was answered

    def look(self) -> None:
        """Ask each question that is new, and pass on the answer."""
        for bridge, service in self._services.items():
            pose = self._statuses.within(SILENT, bridge.lstrip("/")).get(POSE_TO_CONFIRM, NO_POSE)
            if pose == NO_POSE:
                self._answered.discard(bridge)
            elif bridge not in self._answered:
                self._answered.add(bridge)
                question = f"{bridge}: does the arm hang as it is drawn, joints at {pose} degrees? [y/N] "
                if self._ask(question).strip().lower() not in ("y", "yes"):
                    self._say(f"{bridge}: not confirmed; let the arm hang, or calibrate its zeros, and enable it again")
                    continue
                sent = service.call_async(Trigger.Request())
                rclpy.spin_until_future_complete(self, sent, timeout_sec=ANSWER_TIMEOUT)
                response = sent.result() if sent.done() else None
                self._say(f"{bridge}: {response.message if response else 'the bridge did not answer'}")


def main() -> None:
    """Ask until Ctrl-C or the end of the terminal."""
    keep_to_this_machine()
    rclpy.init(args=[sys.argv[0], *ENCLAVE], signal_handler_options=SignalHandlerOptions.NO)
    with contextlib.suppress(KeyboardInterrupt, EOFError):
        prompt = PosePrompt(sys.argv[1:], input, partial(print, flush=True))
        while True:
            rclpy.spin_once(prompt, timeout_sec=0.1)
            prompt.look()
    rclpy.try_shutdown()
