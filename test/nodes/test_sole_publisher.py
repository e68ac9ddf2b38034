"""Second publishers: noticed from the numbers of messages, or counted where the middleware does not number them."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from rclpy.node import Node
from std_msgs.msg import String

from exo_gravity.nodes.ros.hot_path import COUNT_PERIOD, SolePublisher

from ..hardware.virtual_time import VirtualClock


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.fixture
def numbered(node: Node) -> Callable[..., list[bool]]:
    """A function that returns the answers to messages with the given numbers."""
    sole = SolePublisher(node, "commands")
    return lambda *values: [sole.is_another({"publication_sequence_number": value}) for value in values]


def test_rising_numbers_come_from_one_publisher_even_if_messages_are_lost(numbered):
    assert not any(numbered(7, 8, 9, 40, 41))


def test_a_number_that_does_not_rise_comes_from_another_publisher(numbered):
    assert numbered(7, 8, 1, 9, 2) == [False, False, True, False, True]


def test_without_numbers_the_publishers_are_counted_twice_a_second(node):
    clock = VirtualClock()
    sole = SolePublisher(node, "commands", clock)

    def is_another() -> bool:
        return sole.is_another({"publication_sequence_number": None})

    node.create_publisher(String, "commands", 1)
    wait_until(lambda: node.count_publishers("/right/commands") == 1)
    assert not is_another()
    second = node.create_publisher(String, "commands", 1)
    wait_until(lambda: node.count_publishers("/right/commands") == 2)
    assert not is_another()  # the last count still holds
    clock.sleep(1.1 * COUNT_PERIOD)
    assert is_another()
    node.destroy_publisher(second)
    wait_until(lambda: node.count_publishers("/right/commands") == 1)
    clock.sleep(1.1 * COUNT_PERIOD)
    assert not is_another()
