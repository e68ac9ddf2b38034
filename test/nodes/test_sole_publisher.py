"""Second publishers: noticed from the numbers of messages, or counted where the middleware does not number them."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.node import Node
from std_msgs.msg import String

from exo_gravity.nodes.ros import sole_publisher
from exo_gravity.nodes.ros.sole_publisher import SolePublisher

UNNUMBERED = {"publication_sequence_number": None}


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def numbers(sole: SolePublisher, *values: int) -> list[bool]:
    return [sole.is_another({"publication_sequence_number": value}) for value in values]


def test_rising_numbers_come_from_one_publisher_even_if_messages_are_lost(node: Node):
    assert not any(numbers(SolePublisher(node, "commands"), 7, 8, 9, 40, 41))


def test_a_number_that_does_not_rise_comes_from_another_publisher(node: Node):
    assert numbers(SolePublisher(node, "commands"), 7, 8, 1, 9, 2) == [False, False, True, False, True]


def test_without_numbers_the_publishers_are_counted_and_the_log_states_it_once(node: Node, monkeypatch):
    monkeypatch.setattr(sole_publisher, "COUNT_PERIOD", 0.05)
    warnings: list[str] = []
    monkeypatch.setattr(type(node.get_logger()), "warning", lambda _, text: warnings.append(text))
    sole = SolePublisher(node, "commands")
    first = node.create_publisher(String, "commands", 1)
    wait_until(lambda: node.count_publishers("commands") == 1)
    assert not sole.is_another(UNNUMBERED)
    second = node.create_publisher(String, "/right/commands", 1)
    wait_until(lambda: sole.is_another(UNNUMBERED))
    node.destroy_publisher(first)
    wait_until(lambda: not sole.is_another(UNNUMBERED))
    node.destroy_publisher(second)
    assert len(warnings) == 1 and "/right/commands: the middleware does not number messages" in warnings[0]


def test_the_count_is_taken_at_most_twice_a_second(node: Node, monkeypatch):
    counted: list[str] = []
    monkeypatch.setattr(node, "count_publishers", lambda topic: counted.append(topic) or 1)
    sole = SolePublisher(node, "commands")
    for _ in range(100):
        sole.is_another(UNNUMBERED)
    assert counted == ["/right/commands"]
