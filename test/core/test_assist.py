# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The outer loop's input: followed while it is sound, faded within 100 ms when it is not."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

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
def test_when_messages_stop_the_torque_is_zero_100_ms_after_the_next_one_was_due(rate):
    loop = assisting(rate)
    loop.sending = False
    loop.run(1.0 / rate)  # the last message was up to a period ago
    loop.run(0.1 + 2 * CYCLE)
    assert loop.torques[-1] == (0.0,) * 4
    assert loop.input.state == "waiting" and loop.input.reason == "assist_efforts stopped"


@pytest.mark.parametrize("rate", RATES)
def test_one_lost_message_costs_at_most_half_of_the_torque_and_it_returns(rate):
    loop = assisting(rate)
    loop.sending = False
    loop.run(1.0 / rate)
    loop.sending = True
    loop.run(1.0)
    assert loop.torques[-1] == pytest.approx(FOLLOWED)
    if rate > 40:  # below, the gap is longer than an effort is valid
        assert loop.torques == [pytest.approx(FOLLOWED)] * len(loop.torques)


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


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_message_fades_the_torque_at_once_and_sound_ones_bring_it_back(name):
    changes, reason = WRONG[name]
    loop = assisting()
    loop.now += CYCLE / 2
    loop.send(**changes)
    loop.run(0.1)
    assert loop.torques[-1] == (0.0,) * 4
    assert loop.input.state == "refused" and reason in loop.input.reason
    loop.run(TUNING.recovery - 0.1)
    assert loop.torques[-1] == (0.0,) * 4
    assert loop.run(2.0) == pytest.approx(FOLLOWED)


@pytest.mark.parametrize("name", ["nan", "another publisher", "misnamed"])
def test_while_wrong_messages_go_on_there_is_no_torque(name):
    loop = assisting()
    for _ in range(40):
        loop.now += CYCLE / 2
        loop.send(**WRONG[name][0])
        loop.run(0.05)
    assert not np.any(loop.torques[round(0.1 / CYCLE) :])
    assert WRONG[name][1] in loop.input.reason


@pytest.mark.parametrize("is_late", [False, True])
def test_a_frozen_sender_that_repeats_its_last_stamp_is_refused_and_so_is_a_late_one(is_late):
    loop = assisting()
    stamp, loop.sending, loop.lag = loop.now - 0.005, False, 0.06
    for _ in range(20):
        loop.send(stamp=None if is_late else stamp)
        loop.run(0.004)
    assert loop.run(0.03) == (0.0,) * 4
    assert loop.input.state == "refused"
    assert not is_late or "late by their stamp" in loop.input.reason


@pytest.mark.parametrize("goes_on", [True, False], ids=["the arm is carried on", "the arm is let down meanwhile"])
@pytest.mark.parametrize("pause", [0.06, 0.3, 120.0])
def test_the_torque_of_an_outer_loop_that_died_never_returns(goes_on, pause):
    loop = OuterLoop()
    loop.input.assist, loop.efforts = Assist((10.0,) * 4), (5.0, 0.0, 0.0, 0.0)
    assert loop.run(2.0) == pytest.approx(loop.efforts)
    loop.sending = False
    if goes_on:
        loop.run(min(pause, 1.0))
    else:
        loop.now += pause
    loop.torques.clear()
    loop.input.assist = Assist((1.0,) * 4)
    loop.efforts, loop.sending, loop.publisher = (0.0,) * 4, True, 2
    loop.run(3.0)
    torque = np.array(loop.torques)[:, 0]
    if pause > 0.2:
        assert not np.any(torque)
    assert np.all(np.diff(torque) <= 0.0) and torque[-1] == 0.0


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


def test_slower_than_10_hz_the_torque_fades_between_messages():
    loop = OuterLoop(4.0)
    loop.run(3.0)
    assert "waiting" in loop.states[-130:]
    assert np.abs(loop.torques).max() < 1.0


def test_another_node_may_take_over_once_the_first_has_stopped():
    loop = assisting()
    loop.sending = False
    loop.run(0.5)
    loop.sending, loop.publisher = True, 2
    assert loop.run(1.5) == pytest.approx(FOLLOWED)
    assert "refused" not in loop.states


def test_with_a_largest_effort_of_zero_efforts_are_ignored():
    loop = OuterLoop()
    loop.input.assist = Assist()
    assert loop.run(2.0) == (0.0,) * 4
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
