# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a recording shows: messages decoded in bulk, events, parameters, and time series as a table of pandas."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype

from exo_gravity.lab.bag.content import NodeStatus
from exo_gravity.lab.bag.layout import Batch, Decoder
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.trial.session import Session

from ...support import synthetic_bags as made

TYPES = made.STORE.types

BASES = {
    "float64": st.floats(width=64),
    "int32": st.integers(-(2**31), 2**31 - 1),
    "uint32": st.integers(0, 2**32 - 1),
    "string": st.text("abcü_1/", max_size=9),
}
KINDS = (made.JOINT_STATE, "sensor_msgs/msg/Imu", "geometry_msgs/msg/Vector3Stamped", "std_msgs/msg/Float64")


def filled(draw, node, detail):
    """A value at random of a type, as rosbags describes it."""
    if node is Nodetype.NAME:
        return TYPES[detail](*(filled(draw, *field) for _, field in made.STORE.fielddefs[detail][1]))
    if node is Nodetype.BASE:
        return draw(BASES[detail[0]])
    (_, (base, _)), count = detail
    values = draw(st.lists(BASES[base], min_size=count, max_size=count or 6))
    return values if base == "string" else np.array(values)


def batch_of(messages):
    length = np.array([len(message) for message in messages])
    data = np.frombuffer(b"".join(messages), np.uint8)
    return Batch(data, np.cumsum(length) - length, length, np.arange(len(messages)))


def field(message, path):
    for name in path.split("."):
        message = getattr(message, name)
    return message


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=30)
@given(st.data())
def test_numbers_and_texts_are_those_that_rosbags_decodes(kind, data):
    written = [filled(data.draw, Nodetype.NAME, kind) for _ in range(data.draw(st.integers(1, 4)))]
    messages = [
        bytes(made.STORE.serialize_cdr(message, kind, little_endian=data.draw(st.booleans())))
        for message in written
        for _ in range(data.draw(st.integers(1, 3)))
    ]
    order = data.draw(st.permutations(messages))
    decoder, seen = Decoder(kind), []
    for index, layout, values in decoder.decode(batch_of(order)):
        seen += index.tolist()
        for at, row in zip(index.tolist(), values, strict=True):
            expected = made.STORE.deserialize_cdr(order[at], kind)
            for path in layout.numbers.names or ():
                found, true = np.asarray(row[path]), np.asarray(field(expected, path))
                assert found.astype(true.dtype).tobytes() == true.tobytes()
            for path, texts in layout.texts.items():
                true = field(expected, path)
                assert list(texts) == ([true] if isinstance(true, str) else true)
    assert sorted(seen) == list(range(len(order))) and not decoder.damaged


@settings(deadline=None)
@given(st.binary(max_size=40), st.integers(0, 100))
def test_a_damaged_message_is_left_out_and_counted(noise, at):
    whole = [made.joint_state(k, ("a",), [float(k)]) for k in range(3)]
    damaged = (whole[0][: at % len(whole[0])] + noise)[: len(whole[0]) - 1]
    decoder, found = Decoder(made.JOINT_STATE), {}
    for index, _, values in decoder.decode(batch_of([whole[0], damaged, *whole[1:]])):
        found |= {
            at: values["position"][row, 0] for row, at in enumerate(index) if "position" in (values.dtype.names or ())
        }
    assert [found[at] for at in (0, 2, 3)] == [0.0, 1.0, 2.0]
    assert decoder.damaged <= 1


# Events and parameters


@pytest.fixture(scope="module")
def content():
    return list(made.messages(made.trial(made.POSES, hold=2.0, rate=200.0)))


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


# The time series as columns and as a table


@pytest.fixture(scope="module")
def bag():
    right = made.trial(made.POSES, hold=1.0, rate=50.0)
    middle = float(right.time[len(right.time) // 2])
    right = dataclasses.replace(right, carried=((0.5, middle),), command=np.full_like(right.command, np.nan))
    left = dataclasses.replace(right, name="left", carried=None, position=right.position + 0.25, steps=())
    return dataclasses.replace(made.bag_of(right), recordings=(right, left), session=Session(subject="P07"))


def test_each_sample_of_each_joint_of_each_arm_is_a_row_with_its_step_and_whether_the_arm_was_carried(bag):
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
                steps = enumerate(recording.steps, 1)
                inside = [(n, one.action) for n, one in steps if one.start <= row["time_s"] < one.end]
                assert (row["step"], row["action"]) == (inside[0] if inside else (0, ""))
                first, last = recording.carried[0] if recording.carried else (0.0, np.inf)
                assert row["carried"] == (first <= row["time_s"] <= last)


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
