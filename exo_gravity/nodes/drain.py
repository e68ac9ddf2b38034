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
    """A subscription to `topic` that queues up to `qos.depth` messages until `take` is called."""

    def __init__(self, node: Node, msgtype: type, topic: str, qos: QoSProfile) -> None:
        self.topic = topic
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
        return taken
