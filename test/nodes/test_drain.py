"""Lost messages are counted by their numbers, also when several publishers share a topic."""

import pytest

from exo_gravity.nodes.ros.hot_path import LossCounter


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([1, 2, 3, 4], 0),
        ([7, 8, 11], 2),
        ([500, 501, 1, 2, 3], 0),
        ([500, 1, 501, 2, 502, 4], 1),
        ([0, 0, 0], 0),
    ],
    ids=["none lost", "two lost", "a publisher that was started again", "two publishers, one lost", "no numbers"],
)
def test_gaps_in_the_numbers_of_each_publisher_are_counted(numbers, lost):
    counter = LossCounter()
    for number in numbers:
        counter.take(number)
    assert counter.lost == lost
