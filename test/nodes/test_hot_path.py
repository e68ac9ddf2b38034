"""HotPath, the subscription that bypasses the executor, with a publisher in the same process, over real DDS."""

import threading
import time

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from exo_gravity.nodes.ros import hot_path
from exo_gravity.nodes.ros.hot_path import HotPath
from exo_gravity.nodes.ros.run import keep_to_this_machine

keep_to_this_machine()


class PublisherAndHotPath:
    """A publisher and a hot path in one node.

    received: (text, sequence number, thread) of each message. error: raised by the callback if set.
    """

    def __init__(self):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("hot_path_test", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.received = []
        self.error = None
        self.hot = HotPath(self.node, String, "hot_path_topic", self._on_message, QoSProfile(depth=8))
        self.publisher = self.node.create_publisher(String, "hot_path_topic", 8)
        self.wait_until(lambda: self.publisher.get_subscription_count() == 1)

    def _on_message(self, message, info):
        self.received.append((message.data, info["publication_sequence_number"], threading.current_thread().name))
        if self.error:
            raise self.error

    def send(self, *texts):
        for text in texts:
            self.publisher.publish(String(data=text))

    def wait_until(self, condition, action=lambda: None):
        end = time.monotonic() + 20.0
        while not condition():
            action()
            assert time.monotonic() < end, self.received
            time.sleep(0.005)

    def texts(self):
        return [text for text, _, _ in self.received]

    def close(self):
        self.hot.stop()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def make():
    pairs = []

    def make():
        pairs.append(PublisherAndHotPath())
        return pairs[-1]

    yield make
    for pair in pairs:
        pair.close()


def test_messages_arrive_in_order_on_their_own_thread_without_an_executor(make):
    pair = make()
    pair.hot.start()
    pair.send("a", "b", "c")
    pair.wait_until(lambda: len(pair.received) == 3)
    assert pair.texts() == ["a", "b", "c"]
    assert {thread for _, _, thread in pair.received} == {"hot_path_topic"}


def test_a_poll_takes_all_waiting_messages_and_their_sequence_numbers(make):
    pair = make()
    pair.send("a", "b", "c")
    pair.wait_until(lambda: len(pair.received) == 3, pair.hot.poll)
    assert [number for _, number, _ in pair.received] == [1, 2, 3]
    assert {thread for _, _, thread in pair.received} == {threading.current_thread().name}


def test_a_poll_waits_for_a_message_until_its_timeout(make):
    pair = make()
    pair.hot.poll(0.01)
    assert pair.received == []
    sender = threading.Timer(0.05, pair.send, "a")
    sender.start()
    begin = time.monotonic()
    pair.hot.poll(20.0)
    assert pair.texts() == ["a"]
    assert time.monotonic() - begin < 20.0
    sender.join()


def test_the_executor_does_not_take_the_messages(make):
    pair = make()
    pair.send("a")
    for _ in range(20):
        pair.executor.spin_once(timeout_sec=0.01)
    assert pair.received == []
    pair.wait_until(lambda: pair.received, pair.hot.poll)


def test_after_stop_the_callback_is_not_called(make):
    pair = make()
    pair.hot.start()
    pair.hot.stop()
    pair.send("a")
    for _ in range(20):
        pair.executor.spin_once(timeout_sec=0.01)
    assert pair.received == []


def test_an_exception_in_the_callback_ends_the_thread_and_is_kept(make):
    pair = make()
    pair.error = ValueError("not like that")
    pair.hot.start()
    pair.send("a", "b")
    pair.wait_until(lambda: pair.hot.failure)
    assert pair.hot.failure is pair.error
    assert pair.texts() == ["a"]


def test_with_an_unknown_rclpy_the_executor_calls_back(make, monkeypatch):
    monkeypatch.setattr(hot_path, "rclpy_implementation", object())
    pair = make()
    pair.hot.start()
    pair.hot.poll()
    pair.send("a")
    pair.wait_until(lambda: pair.received, lambda: pair.executor.spin_once(timeout_sec=0.1))
    assert pair.texts() == ["a"]
