# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The studies: short versions of `ordinary` and of the IMU's report, and the search, whose seeds replay their cases."""

import json
import math

import pytest

from bench.imu_report import read_trials, report
from bench.ordinary.__main__ import is_quiet
from bench.ordinary.rows import EQUIPMENT, Row
from bench.search.case import KINDS, Bound, Case, Event, bound_of, draw
from bench.search.stage import ACTS

from ..support.thorough import quick

pytestmark = pytest.mark.thorough

ROWS = (
    (Row("paper", EQUIPMENT[1], False, 100.0, "loop, work of 0.5 and 2 ms"), 0.5),
    (Row("paper", EQUIPMENT[2], True, 100.0, "arrival, 16 ms timer of an FTDI adapter"), 0.5),
    (Row("seven joints", EQUIPMENT[2], False, 100.0, ""), 1.2),  # Nm, of an arm that is twice as heavy
)


@pytest.mark.parametrize(("row", "most"), quick(ROWS[:1], ROWS), ids=lambda value: getattr(value, "name", ""))
def test_ordinary_equipment_carries_an_arm_without_an_alarm(row, most):
    result = row.play(1.0, carried=2.0)
    assert is_quiet(result) and result.starts and not result.refused_samples, result
    assert 0.0 < result.largest_error < most


def test_the_imus_report_has_a_row_for_each_trial_and_a_column_for_each_method():
    lines = report(list(read_trials())[:1]).splitlines()
    assert len(lines) == 4 and lines[0].startswith("| trial | here | published |")
    assert lines[2].startswith("| 03 undisturbed slow rotation C | 0.")


def test_a_seed_always_draws_the_same_case_and_every_kind_is_drawn_and_can_happen():
    cases = [draw(seed, "paper") for seed in range(500)]
    assert cases[:20] == [draw(seed, "paper") for seed in range(20)]
    assert {event.name for case in cases for event in case.events} == set(KINDS) <= set(ACTS)
    assert json.loads(json.dumps(cases[0].events)) == [list(event) for event in cases[0].events]


DROPPED, PUSH = Event(1.0, "payload_dropped", {}), Event(2.0, "push", {"torque": [0.0] * 4, "duration": 0.3})
ZERO_G, LEAN = Event(1.0, "mode", {}), Event(1.0, "lean", {"lean": 0.5, "duration": 0.5})
SILENT, RESISTS = Event(1.0, "bus_silent", {"duration": 0.5}), Event(0.2, "resist", {"duration": 1.0})
SLIP, REARM = Event(1.0, "encoder_slip", {"joint": 0, "error": 0.3}), Event(9.0, "rearm", {"duration": 0.3})
WRONG_TILT = Event(1.0, "imu_creeps", {"pitch": 1.0, "roll": 0.0, "duration": 0.2})
ASKED = Bound(0.6, 0.3, slow=0.35)
BOUNDS = {  # rad/s where only the speed is another one
    "a disabled arm": ([Event(0.0, "disable", {})], Bound(0.6, 0.3)),
    "a lost load": ([DROPPED], 2.9),
    "what the operator asks for lifts an arm slowly": ([ZERO_G], ASKED),
    "also after a push": ([PUSH._replace(time=0.5), ZERO_G], ASKED),
    "a push after that is a lost load": ([ZERO_G, PUSH], 2.9),
    "One-G carries no wearer": ([Event(1.0, "body_mass", {"mass": 100.0}), PUSH], ASKED),
    "a load that is told": ([Event(1.0, "payload_taken", {"mass": 0.2, "told": 1.0}), PUSH], 0.6),
    "a load that is told twice as heavy": ([Event(1.0, "payload_taken", {"mass": 0.2, "told": 2.0}), PUSH], 2.9),
    "an arm that is enabled with a wrong zero": ([SLIP, REARM], Bound(slow=0.35)),
    "one on a trunk that turns": ([LEAN, REARM], Bound(turning=True)),
    "whose torques are late": ([LEAN, Event(1.1, "efforts_late", {"duration": 0.2})], 2.9),
    "a load that is lost while the bus is silent": ([SILENT, DROPPED._replace(time=1.4)], math.inf),
    "or after that": ([SILENT, DROPPED._replace(time=1.6)], 2.9),
    "a wearer who resists until the bus is silent": ([SILENT, RESISTS], math.inf),
    "and beyond": ([SILENT, RESISTS._replace(values={"duration": 2.0})], 1.5),
    "a wrong tilt": ([WRONG_TILT], 1.0),
    "a wrong tilt of an arm that is moved": ([WRONG_TILT, Event(8.0, "reach", {})], 2.9),
}


@pytest.mark.parametrize(("events", "bound"), BOUNDS.values(), ids=BOUNDS)
def test_each_cause_has_its_bound(events, bound):
    case = Case("paper", 0, 250.0, False, 0.0, 0.2, (0.0, 0.5, 0.1, 0.3), "carried", tuple(events))
    found = bound_of(case, clamped=False)
    assert found == bound if isinstance(bound, Bound) else found.speed == bound
