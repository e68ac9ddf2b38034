"""Subscriptions outside the executor: on a thread with a wait set for one alone, or polled by its owner.

rclpy's executor rebuilds its wait set, services included, for every message. That is most of a message's cost
(measured, there and back at 500 Hz: 35 + 21 % of a core, against 14 + 11 % here; at 2,000 messages a second it is most
of a core). A flood is shed before Python sees it: the middleware keeps `qos.depth` messages, and a thread rests for
`pause` between two looks. `WaitSet` and `take_message` are inner interfaces of rclpy, which `wait_for_message` uses.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # reliable
STOP_CHECK_PERIOD = 0.1  # s
PAUSE = 0.0004  # s, less than the shortest period of a control loop
MAX_PUBLISHERS = 4  # of one topic whose messages are counted

Callback = Callable[[Any, dict[str, Any]], None]


class Unexecuted(CallbackGroup):
    """Keeps its subscriptions out of the executor's wait set."""

    def can_execute(self, entity: Any) -> bool:
        """Return that no entity may be executed."""
        return False

    beginning_execution = ending_execution = can_execute


class HotPath:
    """Calls `callback(message, info)` for each message of `topic`: on a thread after `start`, or in each `poll`.

    pause: s for which the thread rests after each look; of what arrives meanwhile, it gets the last `qos.depth`.
    """

    def __init__(
        self, node: Node, msgtype: type, topic: str, callback: Callback, qos: QoSProfile = NEWEST, pause: float = PAUSE
    ) -> None:
        self.failure: Exception | None = None  # raised by the callback; ends the thread
        self._callback = callback
        self._depth, self._pause = qos.depth, pause
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=topic, daemon=True)
        self._subscription = node.create_subscription(msgtype, topic, callback, qos, callback_group=Unexecuted())
        self._wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def poll(self, timeout: float = 0.0) -> None:
        """Call back for each queued message, on the caller's thread; wait up to `timeout` s for the first one.

        It ends after as many as the queue holds, however many arrive meanwhile.
        """
        handle, msgtype = self._subscription.handle, self._subscription.msg_type
        if timeout > 0.0:
            with handle:
                self._wait_set.clear_entities()
                self._wait_set.add_subscription(handle)
                self._wait_set.wait(int(timeout * 1e9))
        for _ in range(self._depth):
            item = handle.take_message(msgtype, False)
            if item is None:
                return
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
                time.sleep(self._pause)
        except Exception as error:
            self.failure = error


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
    """A subscription to `topic` that queues up to `qos.depth` serialised messages until `take` is called.

    The middleware notes their time of arrival. counts_lost: whether to count the messages that did not arrive.
    """

    def __init__(self, node: Node, msgtype: type, topic: str, qos: QoSProfile, counts_lost: bool = False) -> None:
        self.topic = topic
        self.losses = LossCounter()  #: of messages that did not arrive
        self._counts_lost = counts_lost
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
                if self._counts_lost:
                    self.losses.take(about.get("publication_sequence_number") or 0)
        return taken
