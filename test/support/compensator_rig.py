# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The compensator's node in this process, over real DDS, with a wearer if wanted, and the arm that feeds them."""

from __future__ import annotations

import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.nodes.compensator.node import CompensatorNode
from exo_gravity.nodes.ros.inner import NodeExecutor
from exo_gravity.nodes.wearer.node import WearerNode

from . import PARTS
from .waiting import pause, wait_until

keep_to_this_machine()
NAMES = [f"right_{part}" for part in PARTS]
POSE = (0.2, 0.9, 0.7, 0.6)  # rad
STILL = [0.0] * 4
PERIOD = 0.01  # s


class CompensatorRig:
    """The compensator in `namespace`, with `parameters` as in a parameter file, on its own thread once it is started.

    user: the node that plays its environment; waiting spins it. It publishes joint states of `names`, `pose`,
    `velocity` and `effort`, stamped `lag` s late, while `is_feeding`; and then calls `on_cycle` with their stamp.
    commands: (n,) Nm each, all so far. statuses: the newest ones by node. is_stopped: whether no node is spun.
    """

    def __init__(
        self, namespace: str, parameters: Mapping[str, object], names: Sequence[str], pose: Sequence[float]
    ) -> None:
        lines = (f"{name}: {value}" for name, value in {"side": "right", **parameters}.items())
        with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
            file.write("\n    ".join((f"{namespace}/compensator:\n  ros__parameters:", *lines)) + "\n")
            file.flush()
            rclpy.init(args=["--ros-args", "-r", f"__ns:={namespace}", "--params-file", file.name])
        self.user = rclpy.create_node("environment")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.user)
        self.names, self.pose = list(names), list(pose)
        self.velocity, self.effort = [0.0] * len(self.names), [0.0] * len(self.names)
        self.lag, self.is_feeding, self.is_stopped = 0.0, True, False
        self.on_cycle: Callable[[Time], object] = lambda stamp: None
        self.commands: list[tuple[float, ...]] = []
        self.statuses: dict[str, DiagnosticStatus] = defaultdict(DiagnosticStatus)
        subscribe = self.user.create_subscription
        subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        subscribe(JointState, "effort_commands", lambda message: self.commands.append(tuple(message.effort)), 100)
        controller = "effort_controller/commands"
        subscribe(Float64MultiArray, controller, lambda message: self.commands.append(tuple(message.data)), 100)
        self._joint_states = self.user.create_publisher(JointState, "joint_states", 1)
        self.user.create_timer(PERIOD, self._cycle)
        self.node: Any = None
        self.wearer: Any = None
        self._closing = False
        self._thread = threading.Thread(target=self._spin)  # so that neither node keeps the other from sending

    def start(self, with_wearer: bool = False) -> CompensatorRig:
        """Start the compensator, and a wearer beside it."""
        self.node = CompensatorNode()
        self.wearer = WearerNode() if with_wearer else None
        self._thread.start()
        return self

    def _spin(self) -> None:
        executor = NodeExecutor()
        for node in filter(None, (self.node, self.wearer)):
            executor.add_node(node)
        while not self._closing:
            pause() if self.is_stopped else executor.spin_once(timeout_sec=0.05)
        executor.shutdown()

    def _cycle(self) -> None:
        if self.is_feeding and self.node is not None:
            stamp = Time(nanoseconds=time.time_ns() - round(self.lag * 1e9)).to_msg()
            message = JointState(name=self.names, position=self.pose, velocity=self.velocity, effort=self.effort)
            message.header.stamp = stamp
            self._joint_states.publish(message)
            self.on_cycle(stamp)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.statuses.update({status.name.rpartition("/")[2]: status for status in message.status})

    @property
    def status(self) -> DiagnosticStatus:
        """The compensator's newest status."""
        return self.statuses["compensator"]

    @property
    def values(self) -> Mapping[str, str]:
        """The newest value of each of its keys, '' before the first report."""
        return self.values_of("compensator")

    def values_of(self, node: str) -> Mapping[str, str]:
        """Return the newest value of each key of a node."""
        return defaultdict(str, {item.key: item.value for item in self.statuses[node].values})

    def set(self, **values: object) -> list[str]:
        """Set parameters (`__` for a dot) and return why each was refused, '' if it was not."""
        changes = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
        return [result.reason for result in self.node.set_parameters(changes)]

    def wait_until(self, condition: Callable[[], object]) -> None:
        """Spin the environment until `condition()` holds."""
        wait_until(condition, lambda: self.executor.spin_once(timeout_sec=0.01), seen=lambda: dict(self.statuses))

    def wait_for(self, values: dict[str, str], node: str = "compensator") -> None:
        """Wait until one report of a node has all of these values."""
        self.wait_until(lambda: values.items() <= self.values_of(node).items())

    def end_wearer(self) -> None:
        """End the wearer."""
        wearer, self.wearer = self.wearer, None
        wearer.close()
        wearer.destroy_node()

    def close(self) -> None:
        """End the nodes."""
        self._closing = True
        with suppress(RuntimeError):  # it was not started
            self._thread.join()
        if self.wearer is not None:
            self.end_wearer()
        if self.node is not None:
            self.node.close()
            self.node.destroy_node()
        self.executor.shutdown()
        self.user.destroy_node()
        rclpy.try_shutdown()
