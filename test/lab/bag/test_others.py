# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings of others: a clock that was set, copies beside them, damage, degrees, other joints on the same topic.

Each kind comes from a public report. What was recorded is known, so is the verdict: the arm held in all of them.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
from dataclasses import replace

import numpy as np
import pytest
import zstandard
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.clock import timeline, without_outliers
from exo_gravity.lab.bag.pairing import PAIRING
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.report.trial_report import analyse
from exo_gravity.lab.trial.recording import in_blocks

from ...support import synthetic_bags as made

SECOND = 10**9
DAY = 86_400 * SECOND
RATE = 50.0  # Hz
STATES, COMMANDS = "/right/joint_states", "/right/effort_commands"
TRIAL = made.trial(made.POSES, hold=6.0, rate=RATE)
CONTENT = [
    *made.messages(TRIAL),
    *(made.status(0.5 * n, "active", state="active") for n in range(32)),
]
CONTENT.sort(key=lambda entry: entry[2])


def bag_in_order(folder, content, **form):
    """Write a bag whose messages lie in the order given, whatever their times."""
    writer = made.Writer(folder, version=9, storage_plugin=form.pop("plugin", StoragePlugin.MCAP))
    if compression := form.pop("compression", None):
        writer.set_compression(compression, made.CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind, stamp, data in content:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=made.STORE)
            writer.write(connections[topic], stamp, data)
    return folder


def with_clock(shift, at=5.0):
    """The content with the clock, and with it arrivals and stamps, set by `shift` ns at `at` s."""
    for topic, kind, stamp, data in CONTENT:
        if stamp - made.START < at * SECOND:
            yield topic, kind, stamp, data
            continue
        if kind == made.JOINT_STATE:
            message = made.STORE.deserialize_cdr(data, kind)
            then = message.header.stamp.sec * SECOND + message.header.stamp.nanosec + shift
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(then, SECOND)
            data = bytes(made.STORE.serialize_cdr(message, kind))
        yield topic, kind, stamp + shift, data


def unstamped(data):
    """A joint state whose publisher does not set the stamp."""
    message = made.STORE.deserialize_cdr(data, made.JOINT_STATE)
    message.header.stamp.sec = message.header.stamp.nanosec = 0
    return bytes(made.STORE.serialize_cdr(message, made.JOINT_STATE))


def timed(bag):
    """The recording of the only arm of a bag, and its times (n,) in ns since 1970."""
    (recording,) = bag.recordings
    return recording, bag.start + np.rint(recording.time * 1e9).astype(np.int64)


def report_of(path):
    report = analyse(read_bag(path))
    return report, report.bag.recordings[0], report.arms[0][1]


@pytest.mark.parametrize("shift", [-5 * SECOND, -3600 * SECOND, 2 * SECOND, 3600 * SECOND, 100 * DAY], ids=str)
def test_an_arm_that_held_has_held_whatever_the_clock_did(tmp_path, shift):
    report, arm, analysis = report_of(bag_in_order(tmp_path / "bag", with_clock(shift)))
    assert not report.failures
    np.testing.assert_array_equal(arm.position, TRIAL.position.astype(np.float32))
    assert all(np.max(hold.stray) < np.radians(0.1) for hold in analysis.holds)
    assert sum(hold.duration for hold in analysis.holds) > 8.0  # of 12, in three parts
    steps = [note for note in report.notes if "clock" in note]
    assert len(steps) == (shift != 2 * SECOND)
    assert len(in_blocks(arm).still) < 10 * len(arm.time)
    commanded = np.isfinite(arm.command[:, 0])
    assert commanded.mean() > 0.95


@pytest.mark.parametrize("time", [0, 2**63 - 1], ids=["zero", "beyond"])
@pytest.mark.parametrize("share", [0.01, 1.0])
def test_impossible_times_of_arrival_do_not_move_the_arm(tmp_path, time, share):
    chosen = np.random.default_rng(7).random(len(CONTENT)) < share
    content = [
        (topic, kind, time if lost else stamp, data)
        for (topic, kind, stamp, data), lost in zip(CONTENT, chosen, strict=True)
    ]
    folder = bag_in_order(tmp_path / "bag", content, plugin=StoragePlugin.SQLITE3)
    report, arm, analysis = report_of(folder)
    np.testing.assert_array_equal(arm.position, TRIAL.position.astype(np.float32))
    assert not report.failures and len(analysis.holds) == 2
    assert arm.time[-1] < TRIAL.time[-1] + 1.0


def shuffled():
    """The content in eight parts, in an order of their own."""
    parts = np.array_split(np.arange(len(CONTENT)), 8)
    return [CONTENT[k] for part in np.random.default_rng(1).permutation(8) for k in parts[part]]


def by_topic(backwards=False):
    """The content topic by topic: efforts, then joint states, or the other way round."""
    return sorted(CONTENT, key=lambda entry: entry[0], reverse=backwards)


def test_a_file_in_another_order_than_that_of_arrival_is_sorted(tmp_path):
    for number, order in enumerate((shuffled(), by_topic())):
        report, arm, _ = report_of(bag_in_order(tmp_path / str(number), order))
        made.assert_same(arm, TRIAL)
        assert not report.failures and not [note for note in report.notes if "clock" in note]


def late_and_lost():
    """The content with a third of the commands lost, and with the others up to 0.1 s late."""
    rng = np.random.default_rng(3)
    kept = []
    for topic, kind, stamp, data in CONTENT:
        late = int(rng.integers(SECOND // 10)) if topic == COMMANDS else 0
        if topic != COMMANDS or rng.random() > 1 / 3:
            kept.append((topic, kind, stamp + late, data))
    return sorted(kept, key=lambda entry: entry[2])


ORDERS = {
    "as recorded": CONTENT,
    "late and lost": late_and_lost(),
    "without stamps": [
        (*rest, unstamped(data)) if rest[1] == made.JOINT_STATE else (*rest, data) for *rest, data in CONTENT
    ],
    "shuffled": shuffled(),
    "efforts first": by_topic(),
    "joint states first": by_topic(backwards=True),
}
CLOCKS = {f"clock set by {shift} s": [*with_clock(shift * SECOND)] for shift in (-5, 3600)}


@pytest.mark.parametrize("name", [*ORDERS, *CLOCKS])
def test_where_one_of_several_samples_is_kept_each_has_the_command_that_was_in_force(tmp_path, monkeypatch, name):
    monkeypatch.setattr("exo_gravity.lab.bag.storage.ROWS", 50)
    monkeypatch.setattr("exo_gravity.lab.bag.pairing.PAIRING", replace(PAIRING, pending=100))
    path = bag_in_order(tmp_path / "bag", {**ORDERS, **CLOCKS}[name])
    (whole, times), (thinned, kept) = (timed(read_bag(path, every)) for every in (1, 7))
    same = np.searchsorted(times, kept) if name in ORDERS else np.arange(0, len(times), 7)
    np.testing.assert_array_equal(thinned.position, whole.position[same])
    known, expected = np.isfinite(thinned.command), whole.command[same]
    np.testing.assert_array_equal(thinned.command[known], expected[known])
    joints = thinned.command.shape[1]  # a step of the clock is only known to a sample that is kept: that one has none
    assert np.isfinite(expected).sum() - known.sum() == (joints if name in CLOCKS else 0)
    assert known.mean() > 0.9


def test_the_timeline_keeps_the_order_of_the_file_and_the_length_of_each_part():
    times = np.concatenate((np.arange(0, 50), np.arange(20, 80), [10**6], np.arange(81, 90))) * SECOND // 10
    times += 1_700_000_000 * SECOND
    line = timeline(3 * np.arange(len(times)), times)
    found = line.times(3 * np.arange(len(times)), without_outliers(times))
    assert np.all(np.diff(found) >= 0) and line.steps == (-29 * SECOND // 10,)
    assert found[-1] == times[-1]  # the longest part keeps its times
    assert line.times(np.array([0, 3 * len(times)]), np.array([0, 2**62])).tolist() == [found[0], line.end[-1] + DAY]


# Files


@pytest.mark.parametrize(
    ("was", "becomes"), [(b"CREATE TABLE topics", b"CREA\xccE TABLE topics"), (b"data BLOB NOT", b"data BLOB`NOT")]
)
def test_a_database_whose_tables_are_damaged_is_refused_in_one_sentence(tmp_path, was, becomes):
    file = made.write_bag(tmp_path / "bag", CONTENT, StoragePlugin.SQLITE3) / "bag.db3"
    file.write_bytes(file.read_bytes().replace(was, becomes))
    with pytest.raises(DataError, match="not a rosbag2 database") as raised:
        read_bag(file)
    assert "\n" not in str(raised.value)


def test_of_two_files_that_hold_the_same_the_one_that_the_metadata_name_is_read(tmp_path):
    bag = made.write_bag(tmp_path / "bag", CONTENT)
    shutil.copy(bag / "bag.mcap", bag / "bag_recovered.mcap")
    (bag / "._bag.mcap").write_bytes(b"\x00\x05\x16\x07Mac OS X")
    report, arm, _ = report_of(bag)
    made.assert_same(arm, TRIAL)
    assert "bag_recovered.mcap" in report.notes[0] and "._bag" not in str(report.notes)
    (bag / "metadata.yaml").unlink()
    with pytest.raises(DataError, match=r"bag\.mcap and bag_recovered\.mcap hold the same time"):
        read_bag(bag)
    made.assert_same(made.only(bag / "bag_recovered.mcap"), TRIAL)


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_compressed_recording_is_read_without_its_metadata(tmp_path, mode, plugin):
    bag = made.write_bag(tmp_path / "bag", CONTENT, plugin, mode)
    metadata = (bag / "metadata.yaml").read_text()
    for text in ("", "{", metadata.replace(".zstd", ""), metadata.replace("version: 9", "version: 99")):
        (bag / "metadata.yaml").write_text(text)
        made.assert_same(made.only(bag), TRIAL)


@pytest.mark.parametrize("damage", [lambda data: data[: len(data) // 2], lambda data: bytes(4) + data[4:]])
def test_a_compressed_file_that_is_cut_or_damaged_is_refused_in_one_sentence(tmp_path, damage):
    bag = made.write_bag(tmp_path / "bag", CONTENT, compression=CompressionMode.FILE)
    (file,) = bag.glob("*.zstd")
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(DataError, match=r"\.zstd: the compressed file is cut or damaged"):
        read_bag(bag)


def test_a_damaged_chunk_is_left_out_and_named(tmp_path):
    bag = made.write_bag(tmp_path / "bag", CONTENT * 12, compression=CompressionMode.STORAGE)
    file = bag / "bag.mcap"
    data = bytearray(file.read_bytes())
    chunk = data.index(b"\x28\xb5\x2f\xfd", data.index(b"\x28\xb5\x2f\xfd") + 4)  # the second one
    data[chunk + 4 : chunk + 40] = bytes(36)
    file.write_bytes(data)
    report, arm, _ = report_of(bag)
    assert "the recording is damaged: parts left out: 1" in report.notes
    assert len(TRIAL.time) < len(arm.time) < 12 * len(TRIAL.time) and report.bag.is_partial


def test_a_write_ahead_log_on_a_read_only_medium_is_read(tmp_path):
    source = made.write_bag(tmp_path / "bag", CONTENT, StoragePlugin.SQLITE3) / "bag.db3"
    medium = tmp_path / "medium"
    medium.mkdir()
    database = sqlite3.connect(source)
    database.execute("PRAGMA journal_mode=WAL")
    rows = database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id").fetchall()
    database.execute("DELETE FROM messages")
    database.commit()
    database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    database.commit()
    for suffix in ("", "-wal"):
        shutil.copy(f"{source}{suffix}", medium / f"bag.db3{suffix}")
    database.close()
    (medium / "bag.db3-shm").mkdir()  # sqlite cannot write its index of the log, whoever runs this
    read = read_bag(medium / "bag.db3")
    made.assert_same(read.recordings[0], TRIAL)


OTHER_FILES = {  # by its name: how a file that is no recording begins, and what is said of it
    "old.bag": (b"#ROSBAG V2.0\n", "is a ROS 1 recording: convert it"),
    "old.mcap": (b"#ROSBAG V2.0\n", "is a ROS 1 recording: convert it"),
    "bag.mcap.gz": (b"\x1f\x8b", "is packed: unpack it first"),
    "metadata.yaml": (b"rosbag2_bagfile_information:", "must be the folder of the recording"),
    "bag.zstd": (b"\x28\xb5\x2f\xfd", "must be a rosbag2 folder"),
    "table.csv": (b"time,a", "must be a rosbag2 folder"),
}


@pytest.mark.parametrize("name", OTHER_FILES)
def test_another_file_is_refused_with_what_it_is_alone_and_in_a_folder(tmp_path, name):
    begin, said = OTHER_FILES[name]
    file = tmp_path / name
    file.write_bytes(begin + bytes(100))
    for path in (file, tmp_path):
        with pytest.raises(DataError, match=f"^{path}.*: {said}"):
            read_bag(path)


def test_a_pipe_and_a_device_are_refused_instead_of_read_for_ever(tmp_path):
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "zeros.db3").symlink_to("/dev/zero")
    for name in ("pipe.mcap", "zeros.db3"):
        with pytest.raises(DataError, match="must be a rosbag2 folder"):
            read_bag(tmp_path / name)


def test_names_in_capitals_and_files_that_a_person_compressed_are_read(tmp_path):
    bag = made.write_bag(tmp_path / "bag", CONTENT)
    capitals, compressed = tmp_path / "BAG.MCAP", bag / "bag.mcap.zst"
    (bag / "bag.mcap").rename(capitals)
    compressed.write_bytes(zstandard.compress(capitals.read_bytes()))
    for path in (capitals, compressed, bag):
        read = read_bag(path)
        made.assert_same(read.recordings[0], TRIAL)
        assert not any("metadata" in note for note in read.notes)


def test_a_name_that_is_not_utf_8_is_refused_before_a_report_is_half_written(tmp_path):
    folder = made.write_bag(tmp_path / "bag", CONTENT).rename(tmp_path / os.fsdecode(b"m\xfcller"))
    with pytest.raises(DataError, match=r"udcfcller': its name must be UTF-8: rename it"):
        read_bag(folder)


def test_a_database_whose_rows_name_their_topics_by_texts_is_damaged(tmp_path):
    file = made.write_bag(tmp_path / "bag", CONTENT, StoragePlugin.SQLITE3) / "bag.db3"
    with contextlib.closing(sqlite3.connect(file)) as database:
        database.executescript(
            "CREATE TABLE others AS SELECT id, CAST(topic_id AS TEXT) AS topic_id, timestamp, data FROM messages; "
            "DROP TABLE messages; ALTER TABLE others RENAME TO messages;"
        )
    with pytest.raises(DataError, match=f"the recording is damaged: parts left out: {len(CONTENT)}"):
        read_bag(file)


# What is on the topics


def test_a_joint_that_is_named_twice_and_one_without_a_position_are_named(tmp_path):
    def states(names, last):
        for time, pose in zip(TRIAL.time, TRIAL.position, strict=True):
            stamp = made.START + round(float(time) * SECOND)
            yield STATES, made.JOINT_STATE, stamp, made.joint_state(stamp, names, [*pose[:3], last])

    with pytest.raises(DataError, match="names 'right_joint_1' twice"):
        read_bag(made.write_bag(tmp_path / "twice", states((made.NAMES[0], *made.NAMES[:3]), 0.0)))
    with pytest.raises(DataError, match="right: right_joint_4 has no position that is a number"):
        read_bag(made.write_bag(tmp_path / "nan", states(made.NAMES, np.nan)))


def test_joint_states_that_all_have_the_same_time_are_no_arm_that_was_never_held(tmp_path):
    content = [(topic, kind, made.START, data) for topic, kind, _, data in CONTENT]
    with pytest.raises(DataError, match="right: all 800 samples have the same time"):
        read_bag(bag_in_order(tmp_path / "bag", content))


def test_torques_that_no_motor_has_are_left_out_and_named(tmp_path):
    for name, scale, lost in (("all", np.full(len(TRIAL.time), 1000.0), 1.0), ("one", np.ones(len(TRIAL.time)), 0.0)):
        scale[300] = 1e30
        trial = replace(TRIAL, effort=TRIAL.effort * scale[:, None], command=TRIAL.command * scale[:, None])
        read = read_bag(made.write_bag(tmp_path / name, made.messages(trial)))
        (arm,) = read.recordings
        assert np.isnan(arm.effort).mean() == pytest.approx(lost, abs=0.002)
        notes = [note for note in read.notes if "torques left out: " in note]
        assert len(notes) == 2 and all(("are they in mNm?" in note) == (name == "all") for note in notes)


OF_ANOTHER_FORM = {
    "text": "{support: lots}", "mapping": "{can.interface: socketcan, can.channel: {a: 1}}", "number": "{law: 7}",
    "other joints": "{robot.mass: [1.0, 2.0]}", "file": "{law: urdf, urdf.file: 7, joint_names: [a]}",
}  # fmt: skip


@pytest.mark.parametrize("values", OF_ANOTHER_FORM.values(), ids=OF_ANOTHER_FORM)
def test_recorded_parameters_of_another_form_are_left_out_and_the_recording_is_reported(tmp_path, values):
    node = "/right/can_bridge" if "can." in values else "/right/compensator"
    given = made.text_entry("/recorder/parameters", 0.0, f"{node}: {{ros__parameters: {values}}}")
    report, arm, _ = report_of(made.write_bag(tmp_path / "bag", [*CONTENT, given]))
    made.assert_same(arm, TRIAL)
    assert "/recorder/parameters: damaged messages left out: 1" in report.notes and not report.bag.parameters


@pytest.mark.parametrize("topic", ["/recorder/session", "/right/wearer_step"])
def test_texts_that_nest_too_deep_are_a_problem_and_no_traceback(tmp_path, topic):
    read = read_bag(made.write_bag(tmp_path / "bag", [*CONTENT, made.text_entry(topic, 3.0, "[" * 100_000)]))
    assert len(read.problems) == 1 and read.problems[0].startswith(f"{topic}: invalid")


def test_degrees_are_refused_and_a_single_impossible_angle_is_left_out(tmp_path):
    def states(scale):
        for k, (time, pose) in enumerate(zip(TRIAL.time, TRIAL.position, strict=True)):
            stamp = made.START + round(float(time) * SECOND)
            yield STATES, made.JOINT_STATE, stamp, made.joint_state(stamp, made.NAMES, pose * scale(k))

    with pytest.raises(DataError, match=r"right_joint_\d = .* rad: must be within ±2 pi; is it in degrees\?"):
        read_bag(made.write_bag(tmp_path / "degrees", states(lambda k: 57.3)))
    read = read_bag(made.write_bag(tmp_path / "once", states(lambda k: 99.0 if k == 300 else 1.0)))
    assert len(read.recordings[0].time) == len(TRIAL.time) - 1
    assert "right: joint states left out, a position is beyond ±2 pi: 1" in read.notes


def test_a_gripper_on_the_same_topic_and_an_arm_that_nothing_commands_are_named_and_left_out(tmp_path):
    gripper = [(STATES, made.JOINT_STATE, at + 1000, made.joint_state(at, ["gripper"], [0.1]))
               for topic, _, at, _ in CONTENT[::7] if topic == STATES]  # fmt: skip
    other = [("/left/joint_states", *entry[1:]) for entry in CONTENT if entry[0] == STATES]
    report, arm, _ = report_of(made.write_bag(tmp_path / "bag", [*gripper, *CONTENT, *other]))
    made.assert_same(arm, TRIAL)
    assert len(report.arms) == 1 and not report.failures
    assert any(f"other joints left out: {len(gripper)}" in note for note in report.notes)
    assert any(note.startswith("/left/joint_states: not reported") for note in report.notes)


@pytest.mark.parametrize("commanded", [4, 7])
def test_of_a_driver_with_seven_joints_those_that_are_commanded_are_reported(tmp_path, commanded):
    names = (*made.NAMES, "wrist_a", "wrist_b", "wrist_c")

    def more(content):
        for topic, kind, stamp, data in content:
            if kind == made.JOINT_STATE and (topic == STATES or commanded > len(made.NAMES)):
                message = made.STORE.deserialize_cdr(data, kind)
                arrays = ((*array, 0.3, 0.2, 0.1) if len(array) else () for array in (
                    message.position, message.velocity, message.effort))  # fmt: skip
                at = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
                data = made.joint_state(at, names, *arrays)
            yield topic, kind, stamp, data

    report, arm, analysis = report_of(made.write_bag(tmp_path / "bag", more(CONTENT)))
    assert arm.joint_names == names[:commanded] and len(analysis.holds) == 2 and not report.failures
    assert arm.position.shape == arm.command.shape == (len(TRIAL.time), commanded)
    assert np.isfinite(arm.command[2:]).all()
