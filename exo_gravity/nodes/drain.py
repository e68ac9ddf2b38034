"""A subscription whose serialised messages are taken many at a time instead of by one callback each.

rclpy's executor rebuilds its wait set for every message: at 2,000 messages a second that is most of a core. A recorder
can leave messages in the middleware's queue, which notes their time of arrival, and take them twenty times a second.
`Subscription.handle.take_message` is an inner interface of rclpy, which its executors and `wait_for_message` use; see
also `hot_path`.
"""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import QoSProfile

from exo_gravity.nodes.hot_path import Unexecuted


class Drain:
    """A subscription to `topic` that queues up to `qos.depth` messages until `take` is called.

    lost: messages that did not arrive, by the numbers that their only publisher gives them, if `counts_lost`.
    """

    def __init__(self, node: Node, msgtype: type, topic: str, qos: QoSProfile, counts_lost: bool = False) -> None:
        self.topic = topic
        self.lost = 0
        self._counts_lost = counts_lost
        self._number = 0  # of the last message
        self._subscription = node.create_subscription(
            msgtype, topic, lambda message: None, qos, raw=True, callback_group=Unexecuted()
        )

    def take(self) -> list[tuple[int, bytes]]:
        """Return the messages since the last call: time of arrival in ns since 1970, and bytes."""
        taken = []
        subscription = self._subscription
        with subscription.handle:
            while (item := subscription.handle.take_message(subscription.msg_type, subscription.raw)) is not None:
                data, about = item
                taken.append((about["received_timestamp"], bytes(data)))
                self._count(about.get("publication_sequence_number") or 0)
        return taken

    def _count(self, number: int) -> None:
        if self._counts_lost and 0 < self._number < number:  # a new publisher begins again at 1
            self.lost += number - self._number - 1
        self._number = number
