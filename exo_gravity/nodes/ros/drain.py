"""A subscription whose serialised messages are taken many at a time instead of by one callback each.

rclpy's executor rebuilds its wait set for every message: at 2,000 messages a second that is most of a core. A recorder
can leave messages in the middleware's queue, which notes their time of arrival, and take them twenty times a second.
`Subscription.handle.take_message` is an inner interface of rclpy, which its executors and `wait_for_message` use; see
also `hot_path`.
"""

from __future__ import annotations

from collections import deque

from rclpy.node import Node
from rclpy.qos import QoSProfile

from exo_gravity.nodes.ros.hot_path import Unexecuted

MAX_PUBLISHERS = 4  # of one topic whose messages are counted


class LossCounter:
    """Counts missing messages by the numbers that each publisher of a topic gives them, from 1. lost: so far."""

    def __init__(self) -> None:
        self.lost = 0
        self._newest: deque[int] = deque(maxlen=MAX_PUBLISHERS)  # number of each publisher's last message

    def take(self, number: int) -> None:
        """Count the message `number`, 0 if it has none.

        It continues the nearest lower number, or is the first of a new publisher.
        """
        previous = max((other for other in self._newest if other < number), default=0)
        if previous:
            self.lost += number - previous - 1
            self._newest.remove(previous)
        if number:
            self._newest.append(number)


class Drain:
    """A subscription to `topic` that queues up to `qos.depth` messages until `take` is called.

    counts_lost: whether to count the messages that did not arrive.
    """

    def __init__(self, node: Node, msgtype: type, topic: str, qos: QoSProfile, counts_lost: bool = False) -> None:
        self.topic = topic
        self._losses = LossCounter() if counts_lost else None
        self._subscription = node.create_subscription(
            msgtype, topic, lambda message: None, qos, raw=True, callback_group=Unexecuted()
        )

    @property
    def lost(self) -> int:
        """The number of messages that did not arrive."""
        return self._losses.lost if self._losses else 0

    def take(self) -> list[tuple[int, bytes]]:
        """Return the messages since the last call: time of arrival in ns since 1970, and bytes."""
        taken = []
        subscription = self._subscription
        with subscription.handle:
            while (item := subscription.handle.take_message(subscription.msg_type, subscription.raw)) is not None:
                data, about = item
                taken.append((about["received_timestamp"], bytes(data)))
                if self._losses:
                    self._losses.take(about.get("publication_sequence_number") or 0)
        return taken
