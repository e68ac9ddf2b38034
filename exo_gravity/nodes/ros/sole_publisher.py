"""Detects a second publisher on a topic, as a rule from the messages themselves.

Each publisher numbers its messages from 1, so from a single publisher the numbers rise. A second one shows at once,
without discovery, which still lists a killed publisher for 20 s. Where the middleware does not number messages, the
publishers that discovery lists are counted instead.
"""

from __future__ import annotations

import math
from typing import Any

from rclpy.node import Node

from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock

DISTRUST = 0.2  # s for which a topic is not trusted after a second publisher was seen
COUNT_PERIOD = 0.5  # s between two counts of the publishers


class SolePublisher:
    """Checks the `info` of each message of one topic, which rclpy passes to callbacks of two arguments."""

    def __init__(self, node: Node, topic: str, clock: Clock = COMPUTER_CLOCK) -> None:
        self._node, self._clock = node, clock
        self._topic = node.resolve_topic_name(topic)
        self._number = 0
        self.missed = 0  #: messages that were published and not received, where the middleware numbers them
        self._count = 1
        self._counted = -math.inf  # monotonic s

    def is_another(self, info: dict[str, Any]) -> bool:
        """Return whether this message comes from a different publisher than the previous one."""
        number = info.get("publication_sequence_number")
        if number is None:
            return self._count_publishers() > 1
        previous, self._number = self._number, number
        if number <= previous:
            return True
        self.missed += number - previous - 1 if previous else 0
        return False

    def _count_publishers(self) -> int:
        """Return the number of publishers that discovery lists, at most COUNT_PERIOD old."""
        now = self._clock.monotonic()
        if self._counted == -math.inf:
            self._node.get_logger().warning(
                f"{self._topic}: the middleware does not number messages: a second publisher is detected up to "
                f"{COUNT_PERIOD:g} s late"
            )
        if now - self._counted > COUNT_PERIOD:
            self._counted, self._count = now, self._node.count_publishers(self._topic)
        return self._count
