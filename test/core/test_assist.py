# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The outer loop's input: followed while it is sound, faded within 100 ms when it is not."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.compensation.terms.assist import ASSIST as TUNING
from exo_gravity.core.compensation.terms.assist import Assist, AssistInput

NAMES = ["rotation", "abduction", "flexion", "elbow"]
ASSIST = Assist((1.0, 2.0, 1.0, 1.0))
EFFORTS = (0.5, -1.0, 5.0, 0.0)
FOLLOWED = (0.5, -1.0, 1.0, 0.0)
CYCLE = 0.002  # s
RATES = (10, 25, 100, 500)


class OuterLoop:
    """A sender at `rate` Hz, an input that is asked every 2 ms, and all `torques` so far."""

    def __init__(self, rate: float = 100.0, jitter: float = 0.0, lag: float = 0.0) -> None:
        self.input = AssistInput(NAMES, ASSIST)
        self.now, self.rate, self.lag, self.publisher, self.last = 20.0, rate, lag, 1, 1
        self.names, self.efforts = NAMES, EFFORTS
        self.sending = True
        self.torques: list[tuple[float, ...]] = []
        self.states: list[str] = []
        self._due, self._jitter, self._random = self.now, jitter, random.Random(1)

    def send(self, names=None, efforts=None, stamp=None, publisher=None):
        stamp = self.now - self.lag if stamp is None else stamp
        last, self.last = self.last, publisher or self.publisher
        self.input.receive(self.now, names or self.names, efforts or self.efforts, stamp, self.last != last)

    def run(self, seconds: float) -> tuple[float, ...]:
        for _ in range(round(seconds / CYCLE)):
            self.now += CYCLE
            if self.sending and self.now >= self._due:
                self._due += (1.0 + self._jitter * self._random.uniform(-1.0, 1.0)) / self.rate
                self.send()
            self.torques.append(self.input.torque(self.now))
            self.states.append(self.input.state)
        return self.torques[-1]


def assisting(rate: float = 100.0, **changes: float) -> OuterLoop:
    loop = OuterLoop(rate, **changes)
    loop.run(2.0)
    assert loop.input.state == "assisting"
    loop.torques.clear()
    return loop


@pytest.mark.parametrize("rate", RATES)
def test_at_any_rate_sound_efforts_are_ramped_in_clamped_and_followed_without_a_gap(rate):
    loop = OuterLoop(rate, jitter=0.3)
    loop.names, loop.efforts = NAMES[::-1], EFFORTS[::-1]  # whose order does not matter
    loop.run(TUNING.ramp)
    assert np.abs(loop.torques[round(0.5 * TUNING.ramp / CYCLE)]).max() < 0.6
    assert loop.run(0.3) == pytest.approx(FOLLOWED)
    loop.torques.clear()
    loop.run(3.0)
    assert loop.torques == [pytest.approx(FOLLOWED)] * len(loop.torques)


@pytest.mark.parametrize("rate", RATES)
def test_a_lost_message_costs_no_torque_for_long_and_when_they_stop_it_is_zero_100_ms_after_the_next_was_due(rate):
    loop = assisting(rate)
    for stops in (False, True):
        loop.sending = False
        loop.run(1.0 / rate)  # the last message was up to a period ago
        loop.sending = not stops
        loop.run(0.1 + 2 * CYCLE if stops else 1.0)
        assert loop.torques[-1] == (NO_TORQUE if stops else pytest.approx(FOLLOWED))
        assert stops or rate < 40 or loop.torques == [pytest.approx(FOLLOWED)] * len(loop.torques)  # effort is valid
    assert loop.input.state == "waiting" and loop.input.reason == "assist_efforts stopped"


WRONG = {
    "nan": ({"efforts": (0.0, math.nan, 0.0, 0.0)}, "must be numbers within 40 Nm"),
    "infinite": ({"efforts": (math.inf, 0.0, 0.0, 0.0)}, "must be numbers within 40 Nm"),
    "huge": ({"efforts": (0.0, 0.0, 41.0, 0.0)}, "must be numbers within 40 Nm"),
    "misnamed": ({"names": [*NAMES[:3], "wrist"]}, "must name rotation, abduction, flexion, elbow"),
    "a name twice": ({"names": [*NAMES[:3], "flexion"]}, "must name"),
    "a joint missing": ({"names": NAMES[:3], "efforts": (0.0,) * 3}, "must name"),
    "too few efforts": ({"efforts": (0.0,) * 3}, "must name"),
    "another publisher": ({"publisher": 2}, "more than one publisher"),
    "a stamp of yesterday": ({"stamp": -86400.0}, "late by their stamp"),
    "a stamp of tomorrow": ({"stamp": 86400.0}, "late by their stamp"),
    "a stamp that is not a number": ({"stamp": math.nan}, "late by their stamp"),
}


@pytest.mark.parametrize("count", [1, 20])
@pytest.mark.parametrize(("changes", "reason"), WRONG.values(), ids=WRONG)
def test_wrong_messages_fade_the_torque_at_once_and_sound_ones_bring_it_back(changes, reason, count):
    loop = assisting()
    for _ in range(count):
        loop.now += CYCLE / 2
        loop.send(**changes)
        loop.run(0.1)
        assert loop.torques[-1] == NO_TORQUE
        assert loop.input.state == "refused" and reason in loop.input.reason
    loop.run(TUNING.recovery - 0.1)
    assert not np.any(loop.torques[round(0.1 / CYCLE) :])
    assert loop.run(2.0) == pytest.approx(FOLLOWED)


@pytest.mark.parametrize("is_late", [False, True])
def test_a_frozen_sender_that_repeats_its_last_stamp_is_refused_and_so_is_a_late_one(is_late):
    loop = assisting()
    stamp, loop.sending, loop.lag = loop.now - 0.005, False, 0.06
    for _ in range(20):
        loop.send(stamp=None if is_late else stamp)
        loop.run(0.004)
    assert loop.run(0.03) == NO_TORQUE
    assert loop.input.state == "refused"
    assert not is_late or "late by their stamp" in loop.input.reason


@pytest.mark.parametrize("pause", [0.3, 120.0])
@pytest.mark.parametrize("goes_on", [True, False], ids=["the arm is carried on", "the arm is let down meanwhile"])
def test_the_torque_of_an_outer_loop_that_died_never_returns_and_another_node_may_take_over(goes_on, pause):
    loop = assisting()
    loop.sending = False
    loop.run(0.3 if goes_on else CYCLE)
    loop.now += pause
    loop.torques.clear()
    loop.efforts, loop.sending, loop.publisher = NO_TORQUE, True, 2
    loop.run(3.0)
    assert not np.any(loop.torques) and "refused" not in loop.states
    loop.efforts = EFFORTS
    assert loop.run(1.5) == pytest.approx(FOLLOWED)


def test_a_lower_bound_holds_for_the_efforts_that_are_followed_already():
    loop = OuterLoop()
    loop.input.assist, loop.efforts = Assist((10.0,) * 4), (5.0, -5.0, 0.0, 0.0)
    loop.run(2.0)
    loop.input.assist = Assist((1.0,) * 4)
    loop.sending = False
    loop.run(0.04)  # the newest message is still valid
    assert loop.torques[-1] == (1.0, -1.0, 0.0, 0.0)
    loop.sending = True
    assert loop.run(1.0) == (1.0, -1.0, 0.0, 0.0)


def test_with_a_largest_effort_of_zero_efforts_are_ignored():
    loop = OuterLoop()
    loop.input.assist = Assist()
    assert loop.run(2.0) == NO_TORQUE
    assert loop.input.state == "off"


number = st.one_of(st.floats(-50.0, 50.0), st.sampled_from([math.nan, math.inf]))
message = st.fixed_dictionaries(
    {},
    optional={
        "efforts": st.lists(number, min_size=3, max_size=5).map(tuple),
        "names": st.permutations(NAMES),
        "publisher": st.sampled_from([1, 1, 1, 2]),
        "lag": st.floats(-0.1, 0.3),
    },
)


@settings(max_examples=80, deadline=None)
@given(st.lists(st.tuples(message, st.sampled_from([0.002, 0.01, 0.05, 0.1, 0.3])), max_size=40))
def test_no_sequence_of_messages_exceeds_the_bound(sequence):
    loop = OuterLoop()
    loop.sending = False
    for changes, pause in sequence:
        lag = changes.pop("lag", 0.0)
        loop.send(**changes, stamp=loop.now - lag)
        loop.run(pause)
    torques = np.array(loop.torques).reshape(-1, 4)
    assert np.all(np.abs(torques) <= ASSIST.max_effort)
