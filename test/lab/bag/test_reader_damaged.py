"""Recordings that are cut short, damaged or incomplete: what can be read is read, and the rest is named."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.reader import read_bag

from ...support import synthetic_bags as made


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_a_recording_cut_short_gives_what_was_written_before(recording, bag, share):
    (bag / "metadata.yaml").unlink()
    file = bag / "bag.mcap"
    file.write_bytes(file.read_bytes()[: round(share * file.stat().st_size)])
    read = read_bag(bag)
    (arm,) = read.recordings
    assert 0.8 * share < len(arm.time) / len(recording.time) <= 1.0
    made.assert_same(arm, recording, len(arm.time))
    assert "cut short" in read.notes[0]


def test_a_recording_that_lacks_only_its_index_is_complete(recording, bag):
    file = bag / "bag.mcap"
    file.write_bytes(file.read_bytes()[:-40])
    read = read_bag(bag)
    made.assert_same(read.recordings[0], recording)
    assert not read.notes


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_recording_with_compressed_chunks_cut_short_gives_the_whole_chunks(recording, content, tmp_path, share):
    bag = made.write_bag(tmp_path / "bag", content * 4, compression=CompressionMode.STORAGE)
    file = bag / "bag.mcap"
    file.write_bytes(file.read_bytes()[: round(share * file.stat().st_size)])
    read = read_bag(bag)
    assert "cut short" in read.notes[0] and len(read.recordings[0].time) > 100


def test_a_database_cut_short_gives_the_rows_before(recording, content, tmp_path):
    bag = made.write_bag(tmp_path / "bag", content, plugin=StoragePlugin.SQLITE3)
    (bag / "metadata.yaml").unlink()
    file = bag / "bag.db3"
    file.write_bytes(file.read_bytes()[: round(0.6 * file.stat().st_size)])
    read = read_bag(bag)
    assert len(read.recordings[0].time) > 100
    assert "cut short" in read.notes[0]


def test_an_empty_recording_is_reported_as_empty(tmp_path):
    topics = [("/right/joint_states", made.JOINT_STATE)]
    with pytest.raises(DataError, match="is empty: it has no messages"):
        read_bag(made.write_bag(tmp_path / "bag", [], topics=topics))


def test_the_error_for_a_recording_without_joint_states_lists_its_topics(tmp_path):
    content = [("/chatter", "std_msgs/msg/String", made.START, made.string("hello"))]
    with pytest.raises(DataError, match=r"no topic joint_states .* it has /chatter"):
        read_bag(made.write_bag(tmp_path / "bag", content))


def test_joint_states_of_another_type_are_ignored(tmp_path):
    content = [("/right/joint_states", "std_msgs/msg/String", made.START, made.string("hello"))]
    with pytest.raises(DataError, match="joint_states"):
        read_bag(made.write_bag(tmp_path / "bag", content))


@pytest.mark.parametrize("name", ["missing", "folder", "text.mcap", "text.db3", "text.txt"])
def test_a_file_that_is_not_a_recording_is_refused_by_name(tmp_path, name):
    (tmp_path / "folder").mkdir()
    for file in ("text.mcap", "text.db3", "text.txt"):
        (tmp_path / file).write_text("no recording at all, though long enough to look at\n" * 20)
    with pytest.raises(DataError, match=name):
        read_bag(tmp_path / name)


def test_commands_for_other_joints_are_a_problem_and_positions_are_still_read(recording, tmp_path):
    content = made.messages(recording, command_names=("a", "b", "c", "d"))
    read = read_bag(made.write_bag(tmp_path / "bag", content))
    made.assert_same(read.recordings[0], recording)
    (problem,) = read.problems
    assert "/right/effort_commands" in problem and "a, b, c, d" in problem and "right_joint_1" in problem


def test_joint_states_whose_names_change_are_refused(recording, content, tmp_path):
    stamp = content[-1][2] + 10**9
    other = made.joint_state(stamp, ("a", "b", "c", "d"), *np.zeros((3, 4)))
    with pytest.raises(DataError, match=r"/right/joint_states: joint names differ: a, b, c, d"):
        read_bag(made.write_bag(tmp_path / "bag", [*content, ("/right/joint_states", made.JOINT_STATE, stamp, other)]))


def test_an_unreadable_arm_is_a_problem_and_the_other_arm_is_still_read(recording, content, tmp_path):
    bad = [
        ("/left/joint_states", made.JOINT_STATE, made.START + k * 10**6, made.joint_state(0, ["a"], [0.0]))
        for k in range(9)
    ]
    read = read_bag(made.write_bag(tmp_path / "bag", [*bad, *content]))
    assert [arm.name for arm in read.recordings] == ["right"]
    assert "left" in read.problems[0] and "must be 4" in read.problems[0]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_joint_states_without_a_position_are_left_out_with_a_note(recording, content, tmp_path, bad):
    stamp = content[-1][2] + 10**7
    state = made.joint_state(stamp, recording.joint_names, np.array([0.0, bad, 0.0, 0.0]), np.zeros(4), np.zeros(4))
    content = [*content, ("/right/joint_states", made.JOINT_STATE, stamp, state)]
    read = read_bag(made.write_bag(tmp_path / "bag", content))
    made.assert_same(read.recordings[0], recording)
    assert not read.problems and "right: joint states left out, a position is NaN or infinite: 1" in read.notes[0]


def test_a_damaged_message_is_named_by_its_topic(content, tmp_path):
    broken = [(topic, kind, stamp, data[:40]) for topic, kind, stamp, data in content if kind == made.JOINT_STATE]
    with pytest.raises(DataError, match=r"/right/joint_states: .* damaged"):
        read_bag(made.write_bag(tmp_path / "bag", broken))


def test_without_commands_the_rest_is_read_with_a_note(recording, content, tmp_path):
    states = [item for item in content if item[0] != "/right/effort_commands"]
    read = read_bag(made.write_bag(tmp_path / "bag", states))
    made.assert_same(read.recordings[0], recording)
    assert np.all(np.isnan(read.recordings[0].command)) and "effort_commands" in read.notes[0]


@pytest.mark.parametrize("text", ["no JSON", "[1]", "{}", '{"action": "hold", "duration": null}'])
def test_an_invalid_step_is_one_problem_and_the_rest_is_read(content, recording, tmp_path, text):
    wrong = ("/right/wearer_step", "std_msgs/msg/String", content[-1][2], made.string(text))
    read = read_bag(made.write_bag(tmp_path / "bag", [*content, wrong]))
    assert read.problems == ("/right/wearer_step: invalid wearer_step message",)
    made.assert_same(read.recordings[0], recording)


def test_steps_that_are_all_invalid_leave_the_joint_states_readable(content, recording, tmp_path):
    steps = [("/right/wearer_step", "std_msgs/msg/String", made.START, made.string("gibberish"))]
    states = [item for item in content if not item[0].endswith("wearer_step")]
    read = read_bag(made.write_bag(tmp_path / "bag", [*steps, *states]))
    assert "/right/wearer_step" in read.problems[0]
    made.assert_same(read.recordings[0], recording)


def test_without_a_reported_state_it_is_unknown_when_the_arm_was_carried(content, bag):
    assert made.only(bag).carried is None
