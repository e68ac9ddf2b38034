"""Second publishers: noticed from the numbers of messages, or counted where the middleware does not number them."""

from __future__ import annotations

from exo_gravity.nodes.ros.sole_publisher import SolePublisher

from ..hardware.virtual_time import VirtualClock


class StubNode:
    """A node that lists the publishers of a topic, and keeps its warnings."""

    def __init__(self):
        self.publishers, self.counted, self.warnings = 1, 0, []

    def resolve_topic_name(self, topic):
        return f"/right/{topic}"

    def count_publishers(self, topic):
        assert topic == "/right/commands"
        self.counted += 1
        return self.publishers

    def get_logger(self):
        return self

    def warning(self, text):
        self.warnings.append(text)


def numbers(*values: int) -> list[bool]:
    sole = SolePublisher(StubNode(), "commands")
    return [sole.is_another({"publication_sequence_number": value}) for value in values]


def test_rising_numbers_come_from_one_publisher_even_if_messages_are_lost():
    assert not any(numbers(7, 8, 9, 40, 41))


def test_a_number_that_does_not_rise_comes_from_another_publisher():
    assert numbers(7, 8, 1, 9, 2) == [False, False, True, False, True]


def test_without_numbers_the_publishers_are_counted_twice_a_second_and_the_log_states_it_once():
    node, clock, answers = StubNode(), VirtualClock(), []
    sole = SolePublisher(node, "commands", clock)
    for k in range(300):
        node.publishers = 2 if 100 <= k < 200 else 1
        answers.append(sole.is_another({"publication_sequence_number": None}))
        clock.sleep(0.01)
    assert node.counted == 6 and not any(answers[:100]) and all(answers[151:200]) and not any(answers[251:])
    assert len(node.warnings) == 1 and "/right/commands: the middleware does not number messages" in node.warnings[0]
