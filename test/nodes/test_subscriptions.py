# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Subscriptions outside the executor, with publishers in the same process, over real DDS."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.nodes.ros.subscriptions import NEWEST_ONLY, PolledSubscription, Publishers

from ..support.waiting import pause, wait_until

keep_to_this_machine()

NUMBERS = itertools.count(1)
QUEUE = QoSProfile(depth=8)


class Pair:
    """A publisher and a polled subscription on a topic of their own.

    received: (text, sequence number, thread) of each message. error: raised by the callback if set.
    """

    def __init__(self, node: Node, qos: QoSProfile = QUEUE, **options: float) -> None:
        self.topic = f"topic_{next(NUMBERS)}"
        self.received: list[tuple[str, int, str]] = []
        self.arrivals: list[int] = []  # ns since 1970
        self.error: Exception | None = None
        self.on_message: Callable[[], object] = lambda: None
        self.subscription = PolledSubscription(node, String, self.topic, self._on_message, qos, **options)
        self.publisher = node.create_publisher(String, self.topic, 8)
        self.wait_until(lambda: self.publisher.get_subscription_count() == 1)

    def _on_message(self, message: String, info: dict[str, Any]) -> None:
        self.arrivals.append(info["received_timestamp"])
        text = message if isinstance(message, bytes) else message.data
        self.received.append((text, info["publication_sequence_number"], threading.current_thread().name))
        self.on_message()
        if self.error:
            raise self.error

    def send(self, *texts: str) -> None:
        for text in texts:
            self.publisher.publish(String(data=text))

    def wait_until(self, condition: Callable[[], Any], meanwhile: Callable[[], object] = pause) -> None:
        wait_until(condition, meanwhile, seen=lambda: self.received)

    def texts(self) -> list[str]:
        return [text for text, _, _ in self.received]


@pytest.fixture
def pair(executor) -> Iterator[Pair]:
    """A publisher and a polled subscription."""
    pair = Pair(executor.get_nodes()[0])
    yield pair
    pair.subscription.stop()


def spin(executor: SingleThreadedExecutor) -> None:
    for _ in range(20):
        executor.spin_once(timeout_sec=0.01)


@pytest.mark.parametrize("has_thread", [True, False])
def test_messages_are_passed_on_in_order_with_their_numbers_by_a_thread_or_a_poll(pair, has_thread):
    pair.send("a", "b", "c")
    if has_thread:
        pair.subscription.start()
    pair.wait_until(lambda: len(pair.received) == 3, pause if has_thread else pair.subscription.poll)
    thread = pair.topic if has_thread else threading.current_thread().name
    assert pair.received == [("a", 1, thread), ("b", 2, thread), ("c", 3, thread)]


def test_a_poll_waits_for_a_message_until_its_timeout(pair):
    pair.subscription.poll(0.01)
    assert pair.received == []
    sender = threading.Timer(0.05, pair.send, "a")
    sender.start()
    pair.subscription.poll(20.0)
    assert pair.texts() == ["a"]
    sender.join()


def test_a_poll_ends_although_messages_arrive_faster_than_it_takes_them(pair):
    pair.on_message = lambda: [pair.send("more"), time.sleep(0.01)]
    pair.send("a")
    pair.wait_until(lambda: pair.received, pair.subscription.poll)
    assert pair.texts()[0] == "a" and len(pair.texts()) <= QUEUE.depth


def test_of_a_flood_the_thread_takes_the_newest_message_once_in_each_pause(executor):
    pair = Pair(executor.get_nodes()[0], NEWEST_ONLY, pause=1.5)  # longer than this process may not be run
    pair.subscription.start()
    pair.send("a")
    pair.wait_until(lambda: pair.received)
    pair.send(*(str(number) for number in range(200)))
    pair.wait_until(lambda: len(pair.received) == 2)
    assert pair.texts() == ["a", "199"]
    pair.subscription.stop()


def test_the_executor_does_not_take_the_messages(pair, executor):
    pair.send("a")
    spin(executor)
    assert pair.received == []
    pair.wait_until(lambda: pair.received, pair.subscription.poll)


def test_after_stop_the_callback_is_not_called(pair, executor):
    pair.subscription.start()
    pair.subscription.stop()
    pair.send("a")
    spin(executor)
    assert pair.received == []


def test_an_exception_in_the_callback_ends_the_thread_and_is_kept(pair):
    pair.error = ValueError("not like that")
    pair.subscription.start()
    pair.send("a", "b")
    pair.wait_until(lambda: pair.subscription.failure)
    assert pair.subscription.failure is pair.error
    assert pair.texts() == ["a"]


def test_raw_messages_are_passed_on_in_bytes_with_their_time_of_arrival(executor):
    pair = Pair(executor.get_nodes()[0], raw=True)
    pair.send("a", "b")
    pair.wait_until(lambda: len(pair.received) == 2, pair.subscription.poll)
    assert [deserialize_message(data, String).data for data in pair.texts()] == ["a", "b"]
    assert 0 < pair.arrivals[0] <= pair.arrivals[1]


@pytest.mark.parametrize(
    ("numbers", "others", "missed"),
    [
        ([1, 2, 3, 4], [], 0),
        ([7, 8, 11], [], 2),
        ([500, 501, 1, 2, 3], [2], 0),
        ([500, 1, 501, 2, 502, 4], [1, 3, 5], 1),
        ([7, 8, 1, 9, 2], [2, 4], 0),
    ],
    ids=["none lost", "two lost", "a publisher that was started again", "two publishers, one lost", "two publishers"],
)
def test_publishers_are_distinguished_and_their_losses_counted_by_the_numbers_of_their_messages(
    numbers, others, missed
):
    publishers = Publishers()
    changes = [publishers.note({"publication_sequence_number": number}) for number in numbers]
    assert [n for n, has_changed in enumerate(changes) if has_changed] == others
    assert publishers.missed == missed


def test_a_middleware_that_does_not_number_messages_is_refused_with_one_that_does():
    with pytest.raises(RuntimeError, match="rmw_fastrtps_cpp"):
        Publishers().note({"publication_sequence_number": None})
