# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What is sent to an effort controller, which keeps its last command forever."""

import pytest

from exo_gravity.core.compensation.guidance import CommandFade
from exo_gravity.core.safety.guidance import GUIDANCE

EFFORT = (2.0, -4.0)
NOTHING = (0.0, 0.0)


def active(now: float = 10.0) -> CommandFade:
    fade = CommandFade(0.05)
    assert fade.take(now, EFFORT, EFFORT, NOTHING) == EFFORT
    return fade


def test_nothing_is_sent_before_the_first_effort_nor_while_efforts_arrive():
    fade = CommandFade(0.05)
    fade.withdraw(1.0, "no trunk tilt yet")
    assert fade.tick(1.0) is None and fade.state == "waiting" and not fade.problem
    fade.take(10.0, EFFORT, NOTHING, NOTHING)
    assert fade.tick(10.04) is None


def test_late_input_fades_the_last_effort_linearly_to_zeros_that_go_on():
    fade = active()
    assert fade.tick(10.06) == EFFORT
    assert fade.tick(11.06) == pytest.approx((1.0, -2.0))
    assert fade.tick(12.07) == fade.tick(100.0) == (0.0, 0.0)
    assert fade.problem == "no joint_states younger than 50 ms: zero, call clear_fault"


def test_withdrawn_efforts_fade_at_once_and_the_first_reason_stays():
    fade = active()
    fade.withdraw(10.01, "trunk tilt older than 80 ms")
    fade.withdraw(10.5, "another")
    assert fade.tick(11.01) == pytest.approx((1.0, -2.0))
    assert fade.reason == "trunk tilt older than 80 ms"


def test_an_arm_that_was_let_down_rises_only_after_an_operator_cleared_the_fault():
    fade = active()
    fade.tick(10.06)
    assert not fade.take(10.1, EFFORT, NOTHING, NOTHING) and not fade.clear()
    assert fade.tick(10.1) < EFFORT
    fade.tick(13.0)
    assert not fade.take(13.0, EFFORT, NOTHING, NOTHING) and fade.state == "zero"
    assert fade.clear() and fade.take(13.1, EFFORT, NOTHING, NOTHING)


@pytest.mark.parametrize("period", [0.01, 0.3])
def test_no_message_of_a_fade_steps_by_more_than_the_fade_itself(period):
    fade, now = active(), 10.06
    last = fade.tick(now)
    while fade.state != "zero":
        now += period
        effort = fade.tick(now)
        columns = zip(effort, last, EFFORT, strict=True)
        assert all(abs(a - b) <= abs(full) * period / 2.0 + 1e-12 for a, b, full in columns)
        last = effort


def test_the_first_efforts_begin_from_what_a_controller_holds_since_its_last_sender_died():
    fade, held, last = CommandFade(0.05), (3.59, -1.0), (3.59, -1.0)
    for cycle in range(151):  # 1.5 s at 100 Hz
        effort = fade.take(10.0 + 0.01 * cycle, EFFORT, held, NOTHING)
        assert max(abs(a - b) for a, b in zip(effort, last, strict=True)) <= 0.01 * GUIDANCE.rate + 1e-9
        last = effort
    assert last == EFFORT


def test_a_fade_in_the_first_second_begins_from_what_was_sent():
    fade = CommandFade(0.05)
    assert fade.take(10.0, NOTHING, (3.59, 0.0), NOTHING) == (3.59, 0.0)
    fade.withdraw(10.01, "no trunk tilt")
    assert fade.tick(10.01) == (3.59, 0.0) and fade.tick(12.1) == NOTHING
