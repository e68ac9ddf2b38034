"""The subscription that its user looks after, in one process with a publisher, over real DDS."""

import threading
import time

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from exo_gravity.nodes import hot_path
from exo_gravity.nodes.hot_path import HotPath
from exo_gravity.nodes.run import keep_to_this_machine

keep_to_this_machine()


class Pair:
    """A publisher and a hot path in one node; what came, and on which thread."""

    def __init__(self):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("hot_path_test", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.came = []
        self.error = None
        self.hot = HotPath(self.node, String, "hot_path_topic", self._on_message, QoSProfile(depth=8))
        self.publisher = self.node.create_publisher(String, "hot_path_topic", 8)
        self.until(lambda: self.publisher.get_subscription_count() == 1)

    def _on_message(self, message, info):
        self.came.append((message.data, info["publication_sequence_number"], threading.current_thread().name))
        if self.error:
            raise self.error

    def send(self, *texts):
        for text in texts:
            self.publisher.publish(String(data=text))

    def until(self, condition, action=lambda: None):
        end = time.monotonic() + 20.0
        while not condition():
            action()
            assert time.monotonic() < end, self.came
            time.sleep(0.005)

    def texts(self):
        return [text for text, _, _ in self.came]

    def close(self):
        self.hot.stop()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def make():
    pairs = []

    def make():
        pairs.append(Pair())
        return pairs[-1]

    yield make
    for pair in pairs:
        pair.close()


def test_messages_come_in_order_on_a_thread_of_their_own_without_an_executor(make):
    pair = make()
    pair.hot.start()
    pair.send("a", "b", "c")
    pair.until(lambda: len(pair.came) == 3)
    assert pair.texts() == ["a", "b", "c"]
    assert {thread for _, _, thread in pair.came} == {"hot_path_topic"}


def test_a_poll_takes_everything_that_waits_and_the_publishers_numbers_with_it(make):
    pair = make()
    pair.send("a", "b", "c")
    pair.until(lambda: len(pair.came) == 3, pair.hot.poll)
    assert [number for _, number, _ in pair.came] == [1, 2, 3]
    assert {thread for _, _, thread in pair.came} == {threading.current_thread().name}


def test_a_poll_waits_for_a_message_but_no_longer_than_it_is_told(make):
    pair = make()
    pair.hot.poll(0.01)
    assert pair.came == []
    sender = threading.Timer(0.05, pair.send, "a")
    sender.start()
    begin = time.monotonic()
    pair.hot.poll(20.0)
    assert pair.texts() == ["a"]
    assert time.monotonic() - begin < 20.0
    sender.join()


def test_the_executor_leaves_the_messages_alone(make):
    pair = make()
    pair.send("a")
    for _ in range(20):
        pair.executor.spin_once(timeout_sec=0.01)
    assert pair.came == []
    pair.until(lambda: pair.came, pair.hot.poll)


def test_after_stop_nothing_is_called_any_more(make):
    pair = make()
    pair.hot.start()
    pair.hot.stop()
    pair.send("a")
    for _ in range(20):
        pair.executor.spin_once(timeout_sec=0.01)
    assert pair.came == []


def test_what_the_callback_raises_ends_the_thread_and_is_kept(make):
    pair = make()
    pair.error = ValueError("not like that")
    pair.hot.start()
    pair.send("a", "b")
    pair.until(lambda: pair.hot.failure)
    assert pair.hot.failure is pair.error
    assert pair.texts() == ["a"]


def test_with_another_rclpy_the_executor_calls_back(make, monkeypatch):
    monkeypatch.setattr(hot_path, "rclpy_implementation", object())
    pair = make()
    pair.hot.start()
    pair.hot.poll()
    pair.send("a")
    pair.until(lambda: pair.came, lambda: pair.executor.spin_once(timeout_sec=0.1))
    assert pair.texts() == ["a"]
