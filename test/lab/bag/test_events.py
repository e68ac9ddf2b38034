# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a recording shows of its arms: when each was carried, faults, changed parameters, parameters at the start."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.lab.bag.content import NodeStatus
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.report.trial_report import analyse

from ...support import synthetic_bags as made


def read(content, folder, *more, until=np.inf):
    kept = [item for item in (*content, *more) if item[2] < made.START + until * 1e9]
    return read_bag(made.write_bag(folder / "bag", kept))


def states(*names, first=0.1, period=0.5):
    """The bridge's state, every half second from 0.1 s on; None for no report."""
    return [made.status(first + number * period, name, state=name) for number, name in enumerate(names) if name]


def test_an_arm_is_carried_from_the_first_to_the_last_carrying_state(content, tmp_path):
    names = ["checking", "ramping in", "active", "active", "letting down", "fault", "checking", "active", "active"]
    (arm,) = read(content, tmp_path, *states(*names, first=0.0, period=0.1)).recordings
    arrival = 0.0002  # s, of the first joint state, at which time begins
    np.testing.assert_allclose(arm.carried, [(0.1 - arrival, 0.3 - arrival), (0.7 - arrival, 0.8 - arrival)], atol=1e-9)


@pytest.mark.parametrize(
    ("names", "notes"),
    [
        (["active"] * 20, 1),
        (["active"] * 6 + ["letting down"] * 3, 1),
        *((["active"] * 4 + [last] * 5, 0) for last in ("disabled", "fault", None)),
    ],
)
def test_a_recording_that_ends_before_the_arm_is_down_says_so(content, tmp_path, names, notes):
    found = read(content, tmp_path, *states(*names), until=4.35)
    assert len(found.notes) == notes and all(note.startswith("right: the recording ends") for note in found.notes)
    if len(names) == 20:
        (arm,) = found.recordings
        assert arm.carried == ((pytest.approx(0.0998), arm.time[-1]),)


def parameter_event(seconds, name, number):
    types, kind = made.STORE.types, "rcl_interfaces/msg/ParameterEvent"
    value = types["rcl_interfaces/msg/ParameterValue"](
        3, False, 0, number, "", np.zeros(0, np.uint8), np.zeros(0, bool), np.zeros(0, np.int64), np.zeros(0), []
    )
    changed = types["rcl_interfaces/msg/Parameter"](name, value)
    data = made.serialised(kind, made.header().stamp, "/right/compensator", [], [changed], [])
    return "/parameter_events", kind, made.START + round(seconds * 1e9), data


def test_faults_changed_parameters_and_parameters_at_the_start_are_read(content, tmp_path):
    snapshot = "/right/compensator:\n  ros__parameters: {law: exact}\n"
    keys = {"fault": "motor_silent", "fault text": "elbow: no reply for 0.05 s"}
    silent = [made.status(seconds, "motor 2 is silent", level=2, **keys) for seconds in (3.0, 3.5)]
    found = read(
        content, tmp_path, made.text_entry("/recorder/parameters", 1.0, snapshot), made.status(2.0, "fine"), *silent,
        made.status(4.0, "fine"), parameter_event(5.0, "support", 0.5),
    )  # fmt: skip
    assert [(round(event.time, 3), event.text) for event in found.events] == [
        (3.0, "right/can_bridge: motor 2 is silent"),
        (4.0, "right/can_bridge: OK, fine"),
        (5.0, "/right/compensator: support = 0.5"),
    ]
    assert found.events[-1].setting == ("/right/compensator", "support", 0.5)
    statuses = [event.status for event in found.events[:2]]
    assert statuses == [
        NodeStatus("right/can_bridge", 2, "motor 2 is silent", *keys.values()),
        NodeStatus("right/can_bridge", 0, "fine", "none", ""),
    ]
    assert found.parameters == {"/right/compensator": snapshot}


@pytest.mark.parametrize(
    "rest", [":\n  ros__parameters: {law: a: b}\n", ":\n  ros__parameters: 1\n", ""], ids=str.split
)
def test_damaged_parameters_are_left_out_and_the_recording_is_reported(content, tmp_path, rest):
    found = read(content, tmp_path, made.text_entry("/recorder/parameters", 1.0, f"/right/compensator{rest}"))
    assert not found.parameters and analyse(found).arms
    assert "/recorder/parameters: damaged messages left out: 1" in found.notes
