# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rate of counted events."""

from exo_gravity.core.numbers import Rate


def test_a_rate_is_averaged_over_a_second_or_more_and_restarts_with_its_counter():
    rate = Rate()
    assert [rate.update(now, count) for now, count in ((10.0, 0), (10.5, 250), (11.0, 500), (11.1, 540))] == [
        0.0,
        0.0,
        500.0,
        500.0,
    ]
    assert rate.update(12.0, 3) == 0.0
    assert rate.update(14.0, 203) == 100.0
