# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The time series of a recording as columns and as a table of pandas, against the arrays that they are made of."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest

from exo_gravity.lab.trial.session import Session

from ...support import synthetic_bags as made


@pytest.fixture(scope="module")
def bag():
    right = made.trial(made.POSES, hold=1.0, rate=50.0)
    middle = float(right.time[len(right.time) // 2])
    right = dataclasses.replace(right, carried=((0.5, middle),), command=np.full_like(right.command, np.nan))
    left = dataclasses.replace(right, name="left", carried=None, position=right.position + 0.25, steps=())
    return dataclasses.replace(made.bag_of(right), recordings=(right, left), session=Session(subject="P07"))


def test_each_sample_of_each_joint_of_each_arm_is_a_row(bag):
    columns = bag.columns()
    right, left = bag.recordings
    assert {len(column) for column in columns.values()} == {8 * len(right.time)}
    rows = list(zip(*columns.values(), strict=True))
    assert set(columns["subject"]) == {"P07"}
    seen = {row[1:4]: dict(zip(columns, row, strict=True)) for row in rows}
    assert len(seen) == len(rows)
    for recording in (right, left):
        for sample in range(0, len(recording.time), 7):
            for joint, name in enumerate(recording.joint_names):
                row = seen[recording.name, name, recording.time[sample]]
                assert row["position_rad"] == recording.position[sample, joint]
                assert row["velocity_rad_per_s"] == recording.velocity[sample, joint]
                assert row["torque_nm"] == recording.effort[sample, joint]
                assert np.isnan(row["command_nm"])


def test_a_row_names_the_step_of_the_script_and_whether_the_arm_was_carried(bag):
    columns, right = bag.columns(), bag.recordings[0]
    for time, arm, step, action, carried in zip(
        *(columns[name] for name in ("time_s", "arm", "step", "action", "carried")), strict=True
    ):
        steps = right.steps if arm == "right" else ()
        inside = [(n, one.action) for n, one in enumerate(steps, 1) if one.start <= time < one.end]
        assert (step, action) == (inside[0] if inside else (0, ""))
        assert carried == (arm == "left" or right.carried[0][0] <= time <= right.carried[0][1])


def test_the_frame_has_the_same_columns(bag):
    frame, columns = bag.to_frame(), bag.columns()
    assert list(frame) == list(columns)
    for name, column in columns.items():
        np.testing.assert_array_equal(frame[name].to_numpy(), column)
    wide = frame[frame.arm == "left"].pivot(index="time_s", columns="joint", values="position_rad")
    np.testing.assert_array_equal(wide[list(bag.recordings[1].joint_names)], bag.recordings[1].position)


def test_without_pandas_one_sentence_says_what_to_install(bag, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ModuleNotFoundError, match=r"^to_frame needs pandas.*pip install 'pandas'"):
        bag.to_frame()
