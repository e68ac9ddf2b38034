"""A subscription outside the executor: on a thread with a wait set for it alone, or polled by its owner.

rclpy's executor rebuilds its wait set, services included, for every message. That is most of a message's cost
(measured, there and back at 500 Hz: 35 + 21 % of a core, against 14 + 11 % here). `WaitSet` and `take_message` are
inner interfaces of rclpy, which `wait_for_message` uses. Where they have changed, the executor serves the subscription
as usual, and only speed is lost.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile

STOP_CHECK_PERIOD = 0.1  # s

Callback = Callable[[Any, dict[str, Any]], None]


class Unexecuted(CallbackGroup):
    """Keeps its subscriptions out of the executor's wait set."""

    def can_execute(self, entity: Any) -> bool:
        """Return that no entity may be executed."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Return that no entity may be executed."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Do nothing: no entity is executed."""


class HotPath:
    """Calls `callback(message, info)` for each message of `topic`: on a thread after `start`, or in each `poll`."""

    def __init__(
        self, node: Node, msgtype: type, topic: str, callback: Callable[[Any, dict[str, Any]], None], qos: QoSProfile
    ) -> None:
        self.failure: Exception | None = None  # raised by the callback; ends the thread
        self._callback = callback
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=topic, daemon=True)
        subscription = node.create_subscription(msgtype, topic, callback, qos, callback_group=Unexecuted())
        try:
            self._wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)
            self._take = subscription.handle.take_message
        except (AttributeError, TypeError) as error:
            node.get_logger().warning(f"{topic}: served by the executor, more slowly: rclpy has changed ({error})")
            node.destroy_subscription(subscription)
            node.create_subscription(msgtype, topic, callback, qos)
            self._wait_set, self._take = None, lambda *_: None
        self._subscription = subscription

    def start(self) -> None:
        """Start the thread."""
        if self._wait_set is not None:
            self._thread.start()

    def poll(self, timeout: float = 0.0) -> None:
        """Call back for each queued message, on the caller's thread; wait up to `timeout` s for the first one."""
        subscription = self._subscription
        if timeout > 0.0 and self._wait_set is not None:
            self._wait(timeout)
        while (item := self._take(subscription.msg_type, False)) is not None:
            self._callback(*item)

    def stop(self) -> None:
        """End the thread, before the node is destroyed."""
        self._stopping = True
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        try:
            while not self._stopping:
                self.poll(STOP_CHECK_PERIOD)
        except Exception as error:
            self.failure = error

    def _wait(self, timeout: float) -> None:
        wait_set, handle = self._wait_set, self._subscription.handle
        with handle:
            wait_set.clear_entities()
            wait_set.add_subscription(handle)
            wait_set.wait(int(timeout * 1e9))
