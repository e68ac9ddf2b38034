# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""can_bridge and the compensator of its arm in one process: where the last reply has arrived, its answer is computed.

Each node keeps its own context (name, parameters, enclave) and its own executor, on a separate thread. All topics are
still published, but the control path does not use them: the control thread calls the compensator with each joint state
(effort_exchange.py). If the call raises an exception, the efforts grow old as those of a dead compensator do, and the
process ends, which lets the arm down. If the call never returns, the watchdog kills both nodes.

Arguments: those of can_bridge, `--`, those of the compensator.
"""

import sys

import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions

from exo_gravity.nodes.can_bridge import node
from exo_gravity.nodes.compensator.node import CompensatorNode
from exo_gravity.nodes.ros.inner import NodeExecutor
from exo_gravity.nodes.ros.subscriptions import STOP_CHECK_PERIOD, PeriodicThread


class CompensatedBridge(node.CanBridge):
    """can_bridge together with a compensator. arguments: the compensator's command line."""

    def __init__(self, arguments: list[str]) -> None:
        context = Context()
        rclpy.init(args=arguments, context=context, signal_handler_options=SignalHandlerOptions.NO)
        self._compensator = CompensatorNode(context)
        self._its_executor = executor = NodeExecutor(context)
        executor.add_node(self._compensator)
        self._spinning = PeriodicThread("compensator", lambda: executor.spin_once(STOP_CHECK_PERIOD), 0.0)
        self._spinning.start()
        super().__init__(self._compensator.answer)

    @property
    def failure(self) -> BaseException | None:
        """The exception that ended the control thread, the compensator or its executor, if any."""
        return super().failure or self._compensator.failure or self._spinning.failure

    def close(self) -> None:
        """Let the arm down as can_bridge does, then end the compensator."""
        super().close()
        self._spinning.stop()
        self._compensator.close()

    def destroy_node(self) -> None:
        """Destroy both nodes."""
        self._its_executor.shutdown()
        self._compensator.destroy_node()
        self._compensator.context.try_shutdown()
        super().destroy_node()


def main() -> None:
    """Entry point of both nodes in one process."""
    split = sys.argv.index("--")
    arguments = [sys.argv[0], *sys.argv[split + 1 :]]
    del sys.argv[split:]
    node.main(lambda: CompensatedBridge(arguments))
