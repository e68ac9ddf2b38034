# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A running compensator in the test's process, and a node that plays its environment, over real DDS."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

from exo_gravity.nodes.compensator.node import CompensatorNode

from .waiting import wait_until


class CompensatorRig:
    """The compensator in `namespace`, with `parameters` in ROS's form, on its own thread once it is started.

    user: the node that plays its environment; waiting spins it. status: the compensator's newest one.
    """

    def __init__(self, namespace: str, parameters: Mapping[str, object]) -> None:
        given = (("-p", f"{name}:={value}") for name, value in parameters.items())
        rclpy.init(args=["--ros-args", "-r", f"__ns:={namespace}", *(word for pair in given for word in pair)])
        self.user = rclpy.create_node("environment")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.user)
        self.status = DiagnosticStatus()
        self._name = f"{namespace}/compensator".removeprefix("/")
        self.user.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.node: CompensatorNode | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._spin)  # so that neither node keeps the other from sending

    def start(self) -> None:
        self.node = CompensatorNode()
        self._thread.start()

    def _spin(self) -> None:
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        while not self._closing:
            executor.spin_once(timeout_sec=0.05)
        executor.shutdown()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.status = next((status for status in message.status if status.name == self._name), self.status)

    @property
    def values(self) -> dict[str, str]:
        return {item.key: item.value for item in self.status.values}

    def set(self, **values: object) -> list[str]:
        """Set parameters (`__` for a dot) and return why each was refused, '' if it was not."""
        assert self.node is not None
        changes = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
        return [result.reason for result in self.node.set_parameters(changes)]

    def wait_until(self, condition: Callable[[], object]) -> None:
        wait_until(condition, lambda: self.executor.spin_once(timeout_sec=0.01), seen=lambda: self.status)

    def close(self) -> None:
        self._closing = True
        if self.node is not None:
            self._thread.join()
            self.node.close()
            self.node.destroy_node()
        self.executor.shutdown()
        self.user.destroy_node()
        rclpy.try_shutdown()
