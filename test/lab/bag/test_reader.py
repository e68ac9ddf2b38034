"""Recordings of every form -> the arrays that were written, against rosbags as the independent writer and decoder."""

from __future__ import annotations

import itertools
import json
import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from exo_gravity.lab.bag.joints import FIELDS, JointArrays

from ...support import synthetic_bags as made

FORMS = {
    "mcap": {},
    "sqlite3": {"plugin": StoragePlugin.SQLITE3},
    "mcap with compressed chunks": {"compression": CompressionMode.STORAGE},
    "compressed file": {"compression": CompressionMode.FILE},
    "compressed messages": {"compression": CompressionMode.MESSAGE},
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_every_form_of_rosbag2_gives_the_arrays_that_were_written(recording, content, tmp_path, form):
    made.assert_same(made.only(made.write_bag(tmp_path / "bag", content, **form)), recording)


@pytest.mark.parametrize("chunked", [True, False])
def test_an_mcap_file_of_another_writer_is_read(recording, content, tmp_path, chunked):
    with (tmp_path / "other.mcap").open("wb") as file:
        writer = McapWriter(file, chunk_size=20_000, compression=CompressionType.LZ4, use_chunking=chunked)
        writer.start("ros2")
        schema = writer.register_schema(made.JOINT_STATE, "ros2msg", b"std_msgs/Header header")
        channels = {}
        for topic, kind, stamp, data in content:
            if kind == made.JOINT_STATE:
                channel = channels.get(topic) or channels.setdefault(
                    topic, writer.register_channel(topic, "cdr", schema)
                )
                writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    made.assert_same(made.only(tmp_path / "other.mcap"), recording)


def test_time_comes_from_the_stamps_and_is_0_at_the_first_arrival(recording, bag):
    np.testing.assert_allclose(made.only(bag).time, recording.time - 200e-6, atol=1e-8)


def test_without_stamps_time_is_the_time_of_arrival(recording, tmp_path):
    states = [
        ("/joint_states", made.JOINT_STATE, made.START + round(time * 1e9), made.joint_state(0, made.NAMES, pose))
        for time, pose in zip(recording.time.tolist(), recording.position, strict=True)
    ]
    read = made.only(made.write_bag(tmp_path / "bag", states))
    np.testing.assert_allclose(read.time, recording.time, atol=1e-8)
    assert read.name == "arm"


def test_a_command_is_paired_with_the_state_after_the_one_that_it_answers(recording, bag):
    read = made.only(bag)
    np.testing.assert_allclose(read.command[1:], recording.command[:-1], rtol=1e-6)
    assert np.all(np.isnan(read.command[0]))


def test_the_last_command_expires_when_commands_stop(recording, content, tmp_path):
    last = made.START + 2 * 10**9
    some = [item for item in content if item[0] != "/right/effort_commands" or item[2] < last]
    read = made.only(made.write_bag(tmp_path / "bag", some))
    assert np.all(np.isfinite(read.command[(read.time > 0.1) & (read.time < 2.0)]))
    assert np.all(np.isnan(read.command[read.time > 2.3]))


def test_joints_are_found_by_name_whatever_their_order(recording, tmp_path):
    names = made.NAMES[::-1]
    turned = made.trial(made.POSES[:1], hold=2.0, rate=200.0)
    content = list(made.messages(turned))
    for k, (topic, kind, stamp, _) in enumerate(content):
        if topic == "/right/effort_commands":
            answered = stamp - 500_000
            row = round((answered - made.START) * 200 / 1e9)
            data = made.joint_state(answered, names, effort=turned.command[row][::-1])
            content[k] = topic, kind, stamp, data
    read = made.only(made.write_bag(tmp_path / "bag", content))
    np.testing.assert_allclose(read.command[1:], turned.command[:-1], rtol=1e-6)


def test_messages_of_changing_length_and_order_in_one_topic_are_all_decoded(tmp_path):
    rng = np.random.default_rng(5)
    content, expected = [], []
    for k in range(300):
        order = rng.permutation(4)
        values = rng.standard_normal((3, 4))
        stamp = made.START + k * 5_000_000
        data = made.joint_state(stamp, [made.NAMES[i] for i in order], *values[:, order], frame="x" * int(k % 5))
        content.append(("/right/joint_states", made.JOINT_STATE, stamp, data))
        expected.append(values)
    read = made.only(made.write_bag(tmp_path / "bag", content))
    columns = [made.NAMES.index(name) for name in read.joint_names]
    got = np.stack([read.position, read.velocity, read.effort], axis=1)
    np.testing.assert_allclose(got, np.array(expected)[:, :, columns], rtol=1e-6)


@settings(deadline=None)
@given(
    st.lists(st.text("abcü_1", min_size=1, max_size=9), max_size=6, unique=True),
    st.text("abcü/", max_size=9),
    st.sets(st.sampled_from(FIELDS)),
    st.booleans(),
)
def test_the_layout_of_any_joint_state_is_what_rosbags_decodes(names, frame, present, little_endian):
    types = made.STORE.types
    header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](sec=7, nanosec=8), frame_id=frame)
    numbers = {f: np.arange(len(names)) + 10.0 * k if f in present else np.zeros(0) for k, f in enumerate(FIELDS)}
    message = types[made.JOINT_STATE](header, names, **numbers)
    data = bytes(made.STORE.serialize_cdr(message, made.JOINT_STATE, little_endian=little_endian))
    joints = JointArrays("joint_states")
    joints.add([9], [data])
    (arrival,), (stamp,), (values,) = joints.arrays()
    decoded = made.STORE.deserialize_cdr(data, made.JOINT_STATE)
    assert list(joints.names) == list(decoded.name) and (arrival, stamp) == (9, 7_000_000_008)
    for field, found in zip(FIELDS, values, strict=True):
        expected = getattr(decoded, field) if len(getattr(decoded, field)) else np.full(len(names), np.nan)
        np.testing.assert_array_equal(found, expected)


def test_the_recorded_wearer_steps_are_the_script(recording, bag):
    steps = made.only(bag).steps
    assert [step.action for step in steps] == ["move", "hold", "move", "hold"]
    np.testing.assert_allclose([step.start for step in steps], [step.start for step in recording.steps], atol=0.006)


def test_the_parts_of_a_recording_are_read_in_the_order_of_their_numbers(recording, content, tmp_path):
    folder = tmp_path / "split"
    folder.mkdir()
    edges = np.linspace(0, len(content), 13).astype(int)
    for number, (first, last) in enumerate(itertools.pairwise(edges)):
        part = made.write_bag(tmp_path / f"part_{number}", content[first:last])
        shutil.move(part / f"part_{number}.mcap", folder / f"split_{number}.mcap")
    read = made.only(folder)
    made.assert_same(read, recording)
    np.testing.assert_allclose(read.time, recording.time - 200e-6, atol=1e-8)


def test_additional_fields_of_a_virtual_wearers_step_are_ignored(content, tmp_path):
    done = json.dumps({"step": 4, "of": 4, "action": "done", "duration": 0.0})
    stamp = content[-1][2] + 1
    last = ("/right/wearer_step", "std_msgs/msg/String", stamp, made.string(done))
    assert made.only(made.write_bag(tmp_path / "bag", [*content, last])).steps[-1].action == "done"
