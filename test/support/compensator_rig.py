# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The compensator's node in this process, over real DDS, with a wearer if wanted, and the arm that feeds them."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.nodes.compensator.node import CompensatorNode
from exo_gravity.nodes.ros.inner import NodeExecutor
from exo_gravity.nodes.wearer.node import WearerNode

from . import PARTS
from .node_thread import NodeRig
from .waiting import pause

keep_to_this_machine()
NAMES = [f"right_{part}" for part in PARTS]
POSE = (0.2, 0.9, 0.7, 0.6)  # rad
STILL = [0.0] * 4
PERIOD = 0.01  # s


class CompensatorRig(NodeRig):
    """The compensator in `namespace`, with `parameters` as in a parameter file, on its own thread once it is started.

    user: the node that plays its environment; waiting spins it. It publishes joint states of `names`, `pose`,
    `velocity` and `effort`, stamped `lag` s late, while `is_feeding`; and then calls `on_cycle` with their stamp.
    commands: (n,) Nm each, all so far. is_stopped: whether no node is spun.
    """

    def __init__(
        self, namespace: str, parameters: Mapping[str, object], names: Sequence[str], pose: Sequence[float]
    ) -> None:
        lines = (f"{name}: {value}" for name, value in {"side": "right", **parameters}.items())
        with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
            file.write("\n    ".join((f"{namespace}/compensator:\n  ros__parameters:", *lines)) + "\n")
            file.flush()
            super().__init__("-r", f"__ns:={namespace}", "--params-file", file.name)
        self.names, self.pose = list(names), list(pose)
        self.velocity, self.effort = [0.0] * len(self.names), [0.0] * len(self.names)
        self.lag, self.is_feeding, self.is_stopped = 0.0, True, False
        self.on_cycle: Callable[[Time], object] = lambda stamp: None
        self.commands: list[tuple[float, ...]] = []
        subscribe = self.user.create_subscription
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
        self.node = self.add(CompensatorNode(), is_spun=False)
        self.wearer = self.add(WearerNode(), is_spun=False) if with_wearer else None
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

    @property
    def status(self) -> DiagnosticStatus:
        return self.statuses["compensator"]

    @property
    def values(self) -> Mapping[str, str]:
        return self.values_of("compensator")

    def set(self, **values: object) -> list[str]:
        """Set parameters (`__` for a dot) and return why each was refused, '' if it was not."""
        changes = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
        return [result.reason for result in self.node.set_parameters(changes)]

    def wait_for(self, values: dict[str, str], node: str = "compensator") -> None:
        self.wait_until(lambda: values.items() <= self.values_of(node).items())

    def close(self) -> None:
        self._closing = True
        with suppress(RuntimeError):  # it was not started
            self._thread.join()
        for node in filter(None, (self.wearer, self.node)):
            node.close()
        super().close()
