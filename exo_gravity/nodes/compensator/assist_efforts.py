"""The topic `assist_efforts`: from the user's outer loop to the compensator's `AssistInput`."""

from __future__ import annotations

import threading
import time
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import JointState

from exo_gravity.core.compensation.terms.assist import AssistInput
from exo_gravity.nodes.ros.hot_path import NEWEST, HotPath
from exo_gravity.nodes.ros.messages import to_nanoseconds
from exo_gravity.nodes.ros.sole_publisher import SolePublisher


class AssistEfforts:
    """Passes each message to `assist` on its own thread, holding `lock`."""

    def __init__(self, node: Node, assist: AssistInput, lock: threading.Lock) -> None:
        self._clock = node.get_clock()
        self._assist = assist
        self._lock = lock
        self._sole = SolePublisher(node, "assist_efforts")
        self._sender = 0  # changes whenever a message comes from another publisher than the one before
        self._messages = HotPath(node, JointState, "assist_efforts", self._on_efforts, NEWEST)

    @property
    def failure(self) -> Exception | None:
        """The exception that ended the thread."""
        return self._messages.failure

    def start(self) -> None:
        """Start the thread."""
        self._messages.start()

    def stop(self) -> None:
        """End the thread, before the node is destroyed."""
        self._messages.stop()

    def _on_efforts(self, message: JointState, info: dict[str, Any]) -> None:
        now = time.monotonic()
        age = (self._clock.now().nanoseconds - to_nanoseconds(message.header.stamp)) * 1e-9
        self._sender += self._sole.is_another(info)
        with self._lock:
            self._assist.receive(now, message.name, message.effort, now - age, self._sender)
