# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The search: a seed replays its case, the truth judges it, and a run goes on where the last one ended."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from bench.search.__main__ import kept
from bench.search.case import KINDS, Bound, Case, Event, bound_of, draw
from bench.search.play import play_case
from bench.search.stage import ACTS
from exo_gravity.core.safety.drive import State

POSE = (0.0, 0.5, 0.1, 0.3)


def case_of(*events: Event, begin: str = "carried") -> Case:
    return Case("paper", 0, 250.0, False, 0.0, 0.2, POSE, begin, events)


def test_a_seed_always_draws_the_same_case_and_every_kind_is_drawn_and_can_happen():
    cases = [draw(seed, "paper") for seed in range(500)]
    assert cases[:20] == [draw(seed, "paper") for seed in range(20)]
    assert {event.name for case in cases for event in case.events} == set(KINDS) <= set(ACTS)
    assert json.loads(json.dumps(cases[0].events)) == [list(event) for event in cases[0].events]


def test_an_unseen_cause_has_a_bound_of_its_own():
    dropped = Event(1.0, "payload_dropped", {})
    assert bound_of(case_of(Event(0.0, "disable", {})), clamped=False) == Bound(0.6, 0.3)
    assert bound_of(case_of(dropped), clamped=True).speed == 2.9
    assert bound_of(replace(case_of(dropped), rate=100.0), clamped=True).speed == 7.0


def test_what_the_operator_asks_for_may_lift_an_arm_slowly_and_a_push_after_it_as_a_lost_load():
    zero_g, push = Event(1.0, "mode", {}), Event(2.0, "push", {"torque": [0.0] * 4, "duration": 0.3})
    earlier = push._replace(time=0.5)
    asked = bound_of(case_of(zero_g), clamped=False)
    assert asked == bound_of(case_of(earlier, zero_g), clamped=False) == Bound(0.6, 0.3, slow=0.35)
    assert bound_of(case_of(zero_g, push), clamped=False).speed == 2.9
    heavier = Event(1.0, "body_mass", {"mass": 100.0})
    assert bound_of(case_of(heavier, push), clamped=False) == asked  # One-G carries no wearer
    assert bound_of(replace(case_of(heavier, push), worn=True), clamped=False).speed == 2.9
    assert bound_of(replace(case_of(zero_g, push), worn=True), clamped=False) == asked  # to One-G
    for told, speed in ((1.0, 0.6), (2.0, 2.9)):
        taken = Event(1.0, "payload_taken", {"mass": 0.2, "told": told})
        assert bound_of(case_of(taken, push), clamped=False).speed == speed


def test_an_arm_that_is_enabled_with_a_wrong_zero_may_rise_slowly_and_one_on_a_trunk_that_turns_in_its_frame():
    slip, rearm = Event(1.0, "encoder_slip", {"joint": 0, "error": 0.3}), Event(9.0, "rearm", {"duration": 0.3})
    assert bound_of(case_of(slip), clamped=False) == bound_of(case_of(rearm, slip._replace(time=10.0)), clamped=False)
    assert bound_of(case_of(slip, rearm), clamped=False) == Bound(slow=0.35)
    lean = Event(1.0, "lean", {"lean": 0.5, "duration": 1.0})
    assert bound_of(case_of(lean, rearm), clamped=False) == Bound(turning=True)


def test_nothing_bounds_what_a_lost_load_leaves_while_no_command_reaches_the_motor():
    silent, dropped = Event(1.0, "bus_silent", {"duration": 0.5}), Event(1.4, "payload_dropped", {})
    assert bound_of(case_of(silent, dropped), clamped=False).speed == math.inf
    assert bound_of(case_of(silent, dropped._replace(time=1.6)), clamped=False).speed == 2.9
    resists = Event(0.2, "resist", {"duration": 1.0})  # until the motor's push is all that moves the joint
    assert bound_of(case_of(silent, resists), clamped=False).speed == math.inf
    assert bound_of(case_of(silent, resists._replace(values={"duration": 2.0})), clamped=False).speed == 1.5


def test_an_arm_may_lag_behind_a_trunk_that_turns_while_its_torques_are_late_or_clamped():
    lean, late = Event(1.0, "lean", {"lean": 0.5, "duration": 0.5}), Event(1.1, "efforts_late", {"duration": 0.2})
    assert bound_of(case_of(lean), clamped=False) == Bound(turning=True)
    assert bound_of(case_of(lean, late), clamped=False) == bound_of(case_of(lean), clamped=True)
    assert bound_of(case_of(lean, late), clamped=False).speed == 2.9


def test_a_wrong_tilt_drives_an_arm_that_is_moved_after_it_as_one_that_turned_slowly():
    wrong = Event(1.0, "imu_creeps", {"pitch": 1.0, "roll": 0.0, "duration": 0.2})
    reach = Event(8.0, "reach", {})
    assert bound_of(case_of(wrong), clamped=False).speed == 1.0
    assert bound_of(case_of(reach._replace(time=0.5), wrong), clamped=False).speed == 1.0
    assert bound_of(case_of(wrong, reach), clamped=False).speed == 2.9


def test_an_arm_that_is_disabled_comes_down_within_its_bound():
    played, records = play_case(case_of(Event(0.1, "disable", {})))
    states = [state for _, state, _ in played.states]
    assert states[-3:] == [State.ACTIVE, State.LETTING_DOWN, State.DISABLED]
    assert not played.error and played.share < 1.0
    assert records["position"][:, 1].max() == pytest.approx(POSE[1], abs=0.05)
    assert not records["on"][-1].any()


def test_a_run_goes_on_with_the_cases_that_are_not_kept_also_after_a_line_was_cut_off(tmp_path):
    path = tmp_path / "search.jsonl"
    assert kept(path) == {}
    path.write_text('{"seed": 3, "share": 0.5}\n{"seed": 4, "sh')
    assert kept(path) == {3: {"seed": 3, "share": 0.5}}
