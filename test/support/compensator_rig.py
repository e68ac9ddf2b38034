# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A running compensator in the test's process, and a node that plays its environment, over real DDS."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from exo_gravity.nodes.compensator.node import CompensatorNode

from .waiting import wait_until

PERIOD = 0.01  # s


class CompensatorRig:
    """The compensator in `namespace`, with `parameters` in ROS's form, on its own thread once it is started.

    user: the node that plays its environment; waiting spins it. It publishes joint states of `names`, `pose`,
    `velocity` and `effort`, stamped `lag` s late, while `is_feeding`; and then calls `on_cycle` with their stamp.
    commands: (n,) Nm each, all so far. status: the compensator's newest one.
    """

    def __init__(
        self, namespace: str, parameters: Mapping[str, object], names: Sequence[str], pose: Sequence[float]
    ) -> None:
        given = (("-p", f"{name}:={value}") for name, value in parameters.items())
        rclpy.init(args=["--ros-args", "-r", f"__ns:={namespace}", *(word for pair in given for word in pair)])
        self.user = rclpy.create_node("environment")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.user)
        self.names, self.pose = list(names), list(pose)
        self.velocity, self.effort = [0.0] * len(self.names), [0.0] * len(self.names)
        self.lag, self.is_feeding = 0.0, True
        self.on_cycle: Callable[[Time], object] = lambda stamp: None
        self.commands: list[tuple[float, ...]] = []
        self.status = DiagnosticStatus()
        self._name = f"{namespace}/compensator".removeprefix("/")
        subscribe = self.user.create_subscription
        subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        subscribe(JointState, "effort_commands", lambda message: self.commands.append(tuple(message.effort)), 100)
        controller = "effort_controller/commands"
        subscribe(Float64MultiArray, controller, lambda message: self.commands.append(tuple(message.data)), 100)
        self._joint_states = self.user.create_publisher(JointState, "joint_states", 1)
        self.user.create_timer(PERIOD, self._cycle)
        self.node: CompensatorNode | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._spin)  # so that neither node keeps the other from sending

    def start(self) -> CompensatorRig:
        self.node = CompensatorNode()
        self._thread.start()
        return self

    def _spin(self) -> None:
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        while not self._closing:
            executor.spin_once(timeout_sec=0.05)
        executor.shutdown()

    def _cycle(self) -> None:
        if self.is_feeding and self.node is not None:
            stamp = Time(nanoseconds=time.time_ns() - round(self.lag * 1e9)).to_msg()
            message = JointState(name=self.names, position=self.pose, velocity=self.velocity, effort=self.effort)
            message.header.stamp = stamp
            self._joint_states.publish(message)
            self.on_cycle(stamp)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.status = next((status for status in message.status if status.name == self._name), self.status)

    @property
    def values(self) -> Mapping[str, str]:
        """The newest value of each key, '' before the first report."""
        return defaultdict(str, {item.key: item.value for item in self.status.values})

    def set(self, **values: object) -> list[str]:
        """Set parameters (`__` for a dot) and return why each was refused, '' if it was not."""
        assert self.node is not None
        changes = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
        return [result.reason for result in self.node.set_parameters(changes)]

    def wait_until(self, condition: Callable[[], object]) -> None:
        wait_until(condition, lambda: self.executor.spin_once(timeout_sec=0.01), seen=lambda: self.status)

    def wait_for(self, values: dict[str, str]) -> None:
        """Wait until one report has all of these values."""
        self.wait_until(lambda: values.items() <= self.values.items())

    def close(self) -> None:
        self._closing = True
        if self.node is not None:
            self._thread.join()
            self.node.close()
            self.node.destroy_node()
        self.executor.shutdown()
        self.user.destroy_node()
        rclpy.try_shutdown()
