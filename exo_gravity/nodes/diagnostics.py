"""What a node says of itself: regularly on /diagnostics, and in the log once for each change."""

from __future__ import annotations

import math
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

PERIOD = 0.45  # s; a little less than twice a node's own timer, whose beat is not exact


class Diagnostics:
    """Publishes a DiagnosticStatus: news at once, the rest twice a second. Logs level and text when they change."""

    def __init__(self, node: Node):
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._said: tuple[bytes, str] | None = None
        self._sent = -math.inf

    def report(self, level: bytes, message: str, values: dict[str, object] | None = None) -> None:
        """Publish `level` (OK, WARN or ERROR) with `message` and `values` if it is time; log it if it is news."""
        now, news = time.monotonic(), (level, message) != self._said
        if not news and now - self._sent < PERIOD:
            return
        self._sent = now
        status = DiagnosticStatus(
            level=level,
            name=self._name,
            message=message,
            hardware_id=self._node.get_namespace().lstrip("/"),
            values=[KeyValue(key=key, value=str(value)) for key, value in (values or {}).items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
        if news:
            self._said = (level, message)
            logger = self._node.get_logger()
            # One call site per severity: rclpy refuses a call site whose severity changes.
            if level == OK:
                logger.info(message)
            elif level == WARN:
                logger.warning(message)
            else:
                logger.error(message)
