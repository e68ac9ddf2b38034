# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings of every form, also cut short, damaged or others': what can be read is read, the rest is named.

rosbags is the independent writer and decoder. What was recorded is known, so is the verdict: the arm held. At the end
messages decoded in bulk, events, parameters, and time series as a table of pandas.
"""

import contextlib
import itertools
import os
import random
import shutil
import sqlite3
import tracemalloc
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.content import NodeStatus, Session
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.bag.storage import Decoder, Messages
from exo_gravity.lab.report.trial_report import analyse
from exo_gravity.lab.trial.analysis import ARRAYS, in_blocks

from ...support import synthetic_bags as made

Entries = Iterable[made.Entry]

SECOND = 10**9
ZSTD = b"\x28\xb5\x2f\xfd"  # how each frame begins
STATES, COMMANDS, STEPS = (f"/right/{name}" for name in ("joint_states", "effort_commands", "wearer_step"))
PARAMETERS, SESSION = "/recorder/parameters", "/recorder/session"
TRIAL = made.trial(made.POSES, hold=6.0, rate=50.0)
MESSAGES = list(made.messages(TRIAL))
CONTENT = sorted(
    [*MESSAGES, *(made.status(0.5 * n, "active", state="active") for n in range(32))], key=lambda entry: entry[2]
)
FORMS = [
    *itertools.product(StoragePlugin, (None, CompressionMode.FILE, CompressionMode.MESSAGE)),
    (StoragePlugin.MCAP, CompressionMode.STORAGE),
]
each_form = pytest.mark.parametrize("form", FORMS, ids=[f"{plugin.name}-{mode}" for plugin, mode in FORMS])


def read(folder: Path, content: Entries = CONTENT, *form: object):
    return read_bag(made.write_bag(folder / "bag", content, *form))


in_order = partial(made.write_bag, is_sorted=False)


def poses(change: Callable[[int, np.ndarray], Sequence[float]], names: Sequence[str] = made.NAMES) -> list[made.Entry]:
    """Return the joint states of the trial with positions changed by `change` of their number and themselves."""
    changed = [change(number, pose) for number, pose in enumerate(TRIAL.position)]
    stamps = [made.START + round(time * SECOND) for time in TRIAL.time.tolist()]
    return [
        (STATES, made.JOINT_STATE, stamp, made.joint_state(stamp, names, pose))
        for stamp, pose in zip(stamps, changed, strict=True)
    ]


def report_of(path: Path):
    report = analyse(read_bag(path))
    return report, report.bag.recordings[0], report.arms[0][1]


# Storage


@each_form
def test_every_form_of_rosbag2_gives_the_arrays_that_were_written_also_without_its_metadata(tmp_path, form):
    bag = made.write_bag(tmp_path / "bag", CONTENT, *form)
    metadata = (bag / "metadata.yaml").read_text()
    for text in (metadata, "", "{", metadata.replace(".zstd", ""), metadata.replace("version: 9", "version: 99")):
        (bag / "metadata.yaml").write_text(text)
        made.assert_same(made.only(bag), TRIAL)


@pytest.mark.parametrize("chunked", [True, False])
def test_an_mcap_file_of_another_writer_is_read(tmp_path, chunked):
    with (tmp_path / "other.mcap").open("wb") as file:
        writer = McapWriter(file, chunk_size=20_000, compression=CompressionType.LZ4, use_chunking=chunked)
        writer.start("ros2")
        schema = writer.register_schema(made.JOINT_STATE, "ros2msg", b"std_msgs/Header header")
        channels = {topic: writer.register_channel(topic, "cdr", schema) for topic in (STATES, COMMANDS)}
        for topic, _, stamp, data in CONTENT:
            if topic in channels:
                writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()
    made.assert_same(made.only(tmp_path / "other.mcap"), TRIAL)


def test_the_parts_of_a_recording_are_read_in_the_order_of_their_numbers(tmp_path):
    folder = tmp_path / "split"
    folder.mkdir()
    for number, part in enumerate(np.array_split(np.arange(len(CONTENT)), 12)):
        bag = made.write_bag(tmp_path / f"part_{number}", [CONTENT[k] for k in part])
        shutil.move(bag / f"part_{number}.mcap", folder / f"split_{number}.mcap")
    made.assert_same(made.only(folder), TRIAL)


@pytest.mark.parametrize("form", [FORMS[3], FORMS[-1], FORMS[4]], ids=["plain", "zstd", "whole file by zstd"])
def test_a_recording_cut_short_gives_the_chunks_before_and_one_that_lacks_only_its_index_is_complete(tmp_path, form):
    bag = made.write_bag(tmp_path / "bag", CONTENT * 12, *form)
    (bag / "metadata.yaml").unlink()
    (file,) = bag.iterdir()
    whole = len(made.only(bag).time)
    if form is not FORMS[4]:
        file.write_bytes(file.read_bytes()[:-40])
        assert len(made.only(bag).time) == whole == 12 * len(TRIAL.time)
    made.cut(file, 0.5)
    found = read_bag(bag)
    assert 0.1 < len(found.recordings[0].time) / whole < 0.7
    assert "cut short" in found.notes[0] and found.is_partial


def test_a_damaged_chunk_is_left_out_and_named(tmp_path):
    file = made.write_bag(tmp_path / "bag", CONTENT * 12, compression=CompressionMode.STORAGE) / "bag.mcap"
    head, first, second, *others = file.read_bytes().split(ZSTD)
    file.write_bytes(ZSTD.join((head, first, bytes(36) + second[36:], *others)))
    report, arm, _ = report_of(file.parent)
    assert "the recording is damaged: parts left out: 1" in report.notes and report.bag.is_partial
    assert len(TRIAL.time) < len(arm.time) < 12 * len(TRIAL.time)


def test_a_write_ahead_log_on_a_read_only_medium_is_read(tmp_path):
    source = made.write_bag(tmp_path / "bag", CONTENT, StoragePlugin.SQLITE3) / "bag.db3"
    medium = tmp_path / "medium"
    medium.mkdir()
    with contextlib.closing(sqlite3.connect(source)) as database:
        database.execute("PRAGMA journal_mode=WAL")
        rows = database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id").fetchall()
        database.execute("DELETE FROM messages")
        database.commit()
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
        database.commit()
        for suffix in ("", "-wal"):
            shutil.copy(f"{source}{suffix}", medium / f"bag.db3{suffix}")
    (medium / "bag.db3-shm").mkdir()  # sqlite cannot write its index of the log, whoever runs this
    made.assert_same(made.only(medium / "bag.db3"), TRIAL)


def test_of_two_files_that_hold_the_same_the_one_that_the_metadata_name_is_read(tmp_path):
    bag = made.write_bag(tmp_path / "bag", CONTENT)
    shutil.copy(bag / "bag.mcap", bag / "bag_recovered.mcap")
    (bag / "._bag.mcap").write_bytes(b"\x00\x05\x16\x07Mac OS X")
    found = read_bag(bag)
    made.assert_same(found.recordings[0], TRIAL)
    assert "bag_recovered.mcap" in found.notes[0] and "._bag" not in str(found.notes)
    (bag / "metadata.yaml").unlink()
    with pytest.raises(DataError, match=r"bag\.mcap and bag_recovered\.mcap are of different recordings"):
        read_bag(bag)
    made.assert_same(made.only(bag / "bag_recovered.mcap"), TRIAL)


TEXT = b"no recording at all, though long enough to look at\n" * 20
OTHER_FILES = {  # by its name: how a file that is no recording begins, and what is said of it
    "old.bag": (b"#ROSBAG V2.0\n", "rosbags-convert"),
    "old.mcap": (b"#ROSBAG V2.0\n", "not an MCAP file.*rosbags-convert"),
    "bag.mcap.gz": (b"\x1f\x8b", "unpacked"),
    **dict.fromkeys(("metadata.yaml", "bag.zstd", "table.csv"), (b"any", "must be a rosbag2 folder")),
    **dict.fromkeys(("text.mcap", "text.db3", "text.txt"), (TEXT, "")),
}


@pytest.mark.parametrize("name", [*OTHER_FILES, "pipe.mcap", "zeros.db3", "missing", "folder"])
def test_what_is_no_recording_is_refused_with_what_it_must_be_instead_of_read_for_ever(tmp_path, name):
    file = tmp_path / name
    begin, said = OTHER_FILES.get(name, (b"", "no such file" if name == "missing" else "must be a rosbag2 folder"))
    if name in OTHER_FILES:
        file.write_bytes(begin + bytes(100))
    elif make := {"pipe.mcap": os.mkfifo, "folder": os.mkdir, "zeros.db3": partial(os.symlink, "/dev/zero")}.get(name):
        make(file)
    for path in (file, tmp_path) if name in OTHER_FILES else (file,):
        with pytest.raises(DataError, match=f"^{path}.*{said}"):
            read_bag(path)


def with_topics_as_texts(file: Path) -> None:
    with contextlib.closing(sqlite3.connect(file)) as database:
        database.executescript(
            "CREATE TABLE others AS SELECT id, CAST(topic_id AS TEXT) AS topic_id, timestamp, data FROM messages; "
            "DROP TABLE messages; ALTER TABLE others RENAME TO messages;"
        )


def replaced(was: bytes, becomes: bytes) -> Callable[[Path], object]:
    return lambda file: file.write_bytes(file.read_bytes().replace(was, becomes))


DAMAGE = {  # the form, what is done to its file, and what is said
    "CREATE": (FORMS[0], replaced(b"CREATE TABLE topics", b"CREA\xccE TABLE topics"), "not a rosbag2 database.*-wal"),
    "BLOB": (FORMS[0], replaced(b"data BLOB NOT", b"data BLOB`NOT"), "not a rosbag2 database"),
    "cut": (FORMS[0], lambda file: made.cut(file, 0.6), "not a rosbag2 database, or damaged"),
    "cut, compressed": (FORMS[1], lambda file: made.cut(file, 0.3), r"bag/bag\.db3\.zstd: not a rosbag2 database"),
    "empty": (FORMS[0], lambda file: file.write_bytes(b""), "not a rosbag2 database"),
    "texts": (FORMS[0], with_topics_as_texts, f"the recording is damaged: parts left out: {len(CONTENT)}"),
    "head": (FORMS[4], lambda file: file.write_bytes(bytes(4) + file.read_bytes()[4:]), "compressed file is damaged"),
    "name": (FORMS[3], lambda file: file.parent.rename(file.parent.with_name(os.fsdecode(b"m\xfcller"))), "UTF-8"),
}


@pytest.mark.parametrize(("form", "damage", "said"), DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_file_is_refused_in_one_sentence(tmp_path, form, damage, said):
    bag = made.write_bag(tmp_path / "bag", CONTENT, *form)
    damage(next(file for file in bag.iterdir() if file.suffix != ".yaml"))
    with pytest.raises(DataError, match=said) as raised:
        read_bag(next(tmp_path.iterdir()))
    assert "\n" not in str(raised.value)


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return a file with one to three kinds of damage: bytes are cut off, flipped, zeroed, moved or repeated."""
    for _ in range(rng.randint(1, 3)):
        at, to = (rng.randrange(max(len(data), 1)) for _ in range(2))
        end = at + rng.choice((1, 8, 100, 5000))
        piece, rest = data[at:end], data[:at] + data[end:]
        data = rng.choice(
            (
                data[:at],
                data[:at] + bytes(byte ^ 1 << rng.randrange(8) for byte in piece[:30]) + data[at + 30 :],
                data[:at] + bytes(len(piece)) + data[end:],
                rest[:to] + piece + rest[to:],
                data[:at] + piece + data[at:],
            )
        )
    return data


@pytest.fixture(scope="module")
def every_topic():
    """The messages of a short trial with every topic that the reader decodes."""
    settings = "/right/compensator:\n  ros__parameters: {side: right, mode: one_g, use_imu: false}\n"
    return [
        *made.messages(made.trial(made.POSES, hold=2.5, rate=40.0)),
        *(made.status(0.5 * n, "active", state="active") for n in range(18)),
        *(made.tilt(0.1 * n, 0.1) for n in range(90)),
        made.text_entry(PARAMETERS, 0.0, settings),
        made.text_entry(SESSION, 0.0, '{"subject": "P01"}'),
        made.text_entry("/event_marker", 3.0, "cramp"),
    ]


@each_form
def test_a_recording_with_damage_at_random_is_reported_or_refused_in_one_sentence(tmp_path, every_topic, form):
    bag = made.write_bag(tmp_path / "bag", every_topic, *form)
    for seed in range(FORMS.index(form), 6 * len(FORMS), len(FORMS)):
        rng, folder = random.Random(seed), tmp_path / str(seed)
        folder.mkdir()
        for file in sorted(bag.iterdir()):
            if file.suffix != ".yaml" or rng.random() < 0.8:
                is_hit = file.suffix != ".yaml" or rng.random() < 0.1
                (folder / file.name).write_bytes(damaged(file.read_bytes(), rng) if is_hit else file.read_bytes())
        try:
            assert analyse(read_bag(folder)).verdict
        except DataError as error:
            assert "\n" not in str(error)


# Time and order


def test_time_is_that_of_the_stamps_from_the_first_arrival_on_and_without_stamps_that_of_arrival(tmp_path):
    (arm,) = read(tmp_path / "stamps", MESSAGES).recordings
    np.testing.assert_allclose(arm.time, TRIAL.time - 200e-6, atol=1e-8)
    assert arm.carried is None  # no state was reported
    assert [step.action for step in arm.steps] == ["move", "hold", "move", "hold"]
    np.testing.assert_allclose([step.start for step in arm.steps], [step.start for step in TRIAL.steps], atol=0.02)
    states = [
        ("/joint_states", *rest, restamped(data, lambda stamp: 0)) for _, *rest, data in poses(lambda _, pose: pose)
    ]
    over = made.text_entry("/wearer_step", 0.0, '{"action": "done", "duration": 0.0}')  # of an earlier trial
    (arm,) = read(tmp_path / "arrival", [over, *states]).recordings
    np.testing.assert_allclose(arm.time, TRIAL.time, atol=1e-8)
    assert arm.name == "arm" and not arm.steps


def restamped(data: bytes, change: Callable[[int], int]) -> bytes:
    """A joint state with another stamp; change: of ns."""
    message = made.STORE.deserialize_cdr(data, made.JOINT_STATE)
    then = change(message.header.stamp.sec * SECOND + message.header.stamp.nanosec)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(then, SECOND)
    return bytes(made.STORE.serialize_cdr(message, made.JOINT_STATE))


def with_clock(shift: int) -> Entries:
    """The content with the clock, and with it arrivals and stamps, set by `shift` ns at 5 s."""
    for topic, kind, stamp, data in CONTENT:
        is_set = stamp - made.START >= 5 * SECOND
        if is_set and kind == made.JOINT_STATE:
            data = restamped(data, lambda then: then + shift)
        yield topic, kind, stamp + shift * is_set, data


@pytest.mark.parametrize("shift", [-5 * SECOND, -3600 * SECOND, 2 * SECOND, 3600 * SECOND, 8_640_000 * SECOND], ids=str)
def test_an_arm_that_held_has_held_whatever_the_clock_did(tmp_path, shift):
    report, arm, analysis = report_of(in_order(tmp_path / "bag", with_clock(shift)))
    assert not report.failures
    np.testing.assert_array_equal(arm.position, TRIAL.position.astype(np.float32))
    assert all(np.max(hold.stray) < np.radians(0.1) for hold in analysis.holds)
    assert sum(hold.duration for hold in analysis.holds) > 8.0  # of 12, in three parts
    assert len([note for note in report.notes if "clock" in note]) == (shift != 2 * SECOND)
    assert len(in_blocks(arm).still) < 10 * len(arm.time)
    assert np.isfinite(arm.command[:, 0]).mean() > 0.95


@pytest.mark.parametrize(
    ("time", "share"),
    [*itertools.product((0, 2**63 - 1), (0.01, 1.0)), (made.START + 3600 * SECOND, 0.01)],
    ids=["zero", "all zero", "beyond", "all beyond", "an hour ahead"],
)
def test_impossible_times_of_arrival_do_not_move_the_arm(tmp_path, time, share):
    chosen = np.random.default_rng(7).random(len(CONTENT)) < share
    content = [
        (topic, kind, time if lost else stamp, data)
        for (topic, kind, stamp, data), lost in zip(CONTENT, chosen, strict=True)
    ]
    report, arm, analysis = report_of(in_order(tmp_path / "bag", content, StoragePlugin.SQLITE3))
    np.testing.assert_array_equal(arm.position, TRIAL.position.astype(np.float32))
    assert not report.failures and len(analysis.holds) == 2
    assert arm.time[-1] < TRIAL.time[-1] + 1.0


def test_a_file_in_another_order_than_that_of_arrival_is_sorted(tmp_path):
    parts = np.array_split(np.arange(len(CONTENT)), 8)
    shuffled = [CONTENT[k] for part in np.random.default_rng(1).permutation(8) for k in parts[part]]
    for name, content in {"shuffled": shuffled, "by topic": sorted(CONTENT, key=lambda entry: entry[0])}.items():
        report, arm, _ = report_of(in_order(tmp_path / name, content))
        made.assert_same(arm, TRIAL)
        assert not report.failures and not [note for note in report.notes if "clock" in note]


@pytest.mark.parametrize("shift", [0, -5])
def test_where_one_of_several_samples_is_kept_each_has_the_command_that_was_in_force(tmp_path, shift):
    path = in_order(tmp_path / "bag", with_clock(shift * SECOND))
    whole, thinned = (read_bag(path, every).recordings[0] for every in (1, 7))
    for field in ("position", "velocity", "effort"):
        np.testing.assert_array_equal(getattr(thinned, field), getattr(whole, field)[::7])
    known = np.isfinite(thinned.command)
    np.testing.assert_array_equal(thinned.command[known], whole.command[::7][known])
    joints = thinned.command.shape[1]  # a step of the clock is only known to a sample that is kept: that one has none
    assert np.isfinite(whole.command[::7]).sum() - known.sum() == (joints if shift else 0)


def test_memory_follows_the_samples_that_are_kept(tmp_path):
    peaks = []
    for minutes in (1, 2):
        exact = made.still(made.POSES[0], 60.0 * minutes, rate=100.0)
        bag = made.write_bag(tmp_path / str(minutes), made.messages(made.measured(exact, rate=100.0)))
        for every in (1, 50):
            read_bag(bag, every)  # what is imported and kept for all recordings
            tracemalloc.start()
            read_bag(bag, every)
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
    whole, thinned = (after - before for before, after in zip(peaks[:2], peaks[2:], strict=True))
    assert whole < 6000 * 200  # bytes of the two messages of a sample, which have 470
    assert thinned < 6000 * 80  # the commands alone


# What is on the topics


def test_a_command_is_paired_with_the_state_after_the_one_that_it_answers_and_expires(tmp_path):
    last = made.START + 2 * SECOND
    content = [item for item in CONTENT if item[0] != COMMANDS or item[2] < last]
    (arm,) = read(tmp_path, content).recordings
    answered = np.isfinite(arm.command[:, 0])
    np.testing.assert_allclose(arm.command[1:][answered[1:]][:80], TRIAL.command[:80], rtol=1e-6)
    assert not answered[0] and answered[1 : np.searchsorted(arm.time, 2.0)].all()
    assert not answered[arm.time > 2.3].any()


def test_joints_are_found_by_name_whatever_their_order_and_their_number_of_bytes(tmp_path):
    turned, rng = [], np.random.default_rng(5)
    for k, time in enumerate(TRIAL.time.tolist()):
        order, stamp = rng.permutation(4), made.START + round(time * SECOND)
        names = [made.NAMES[i] for i in order]
        values = (getattr(TRIAL, field)[k][order] for field in ("position", "velocity", "effort"))
        data = made.joint_state(stamp, names, *values, frame="x" * (k % 5))
        turned.append((STATES, made.JOINT_STATE, stamp + 200_000, data))
        data = made.joint_state(stamp, made.NAMES[::-1], effort=TRIAL.command[k][::-1])
        turned.append((COMMANDS, made.JOINT_STATE, stamp + 500_000, data))
    arm = read(tmp_path, turned).recordings[0].in_order(made.NAMES)
    made.assert_same(arm, TRIAL)
    np.testing.assert_allclose(arm.command[1:], TRIAL.command[:-1], rtol=1e-6)


@pytest.mark.parametrize("commanded", [4, 7])
def test_of_a_driver_with_seven_joints_those_that_are_commanded_are_reported(tmp_path, commanded):
    names, wrist = (*made.NAMES, "wrist_a", "wrist_b", "wrist_c"), np.tile((0.3, 0.2, 0.1), (len(TRIAL.time), 1))
    wide = {field: np.hstack((getattr(TRIAL, field), wrist)) for field in ARRAYS}
    of_driver = [*made.messages(replace(TRIAL, joint_names=names, **wide))]
    commands = [item for item in (MESSAGES if commanded == 4 else of_driver) if item[0] == COMMANDS]
    content = [item for item in of_driver if item[0] != COMMANDS] + commands
    report, arm, analysis = report_of(made.write_bag(tmp_path / "bag", content))
    assert arm.joint_names == names[:commanded] and len(analysis.holds) == 2 and not report.failures
    assert arm.position.shape == arm.command.shape == (len(TRIAL.time), commanded)
    assert np.isfinite(arm.command[2:]).all()


REFUSED: dict[str, tuple[Entries, str]] = {
    "empty": ((), "has no message"),
    "other topics": ([made.text_entry("/chatter", 0.0, "hello")], "joint_states .* /chatter"),
    "another type": ([made.text_entry(STATES, 0.0, "hello")], f"no message .*: {STATES}"),
    "damaged messages": (
        [(*rest, data[:40]) for *rest, data in CONTENT if rest[1] == made.JOINT_STATE],
        f"{STATES}: .*damaged",
    ),
    "a joint twice": (
        poses(lambda _, pose: pose, (made.NAMES[0], *made.NAMES[:3])),
        "names right_joint_1, right_joint_1",
    ),
    "no position": (
        poses(lambda _, pose: (*pose[:3], np.nan)),
        "right: right_joint_4 has no position that is a number",
    ),
    "degrees": (
        poses(lambda _, pose: 57.3 * pose),
        r"right_joint_\d = .* rad: must be within ±2 pi; is it in degrees\?",
    ),
    "one time": (
        [(topic, kind, made.START, data) for topic, kind, _, data in CONTENT],
        "right: all 800 samples have the same time",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_recording_without_readable_joint_states_is_refused_with_what_it_has(tmp_path, name):
    content, words = REFUSED[name]
    topics = [(STATES, made.JOINT_STATE)] if name == "empty" else ()
    with pytest.raises(DataError, match=words):
        read_bag(made.write_bag(tmp_path / "bag", content, topics=topics))


@dataclass(frozen=True)
class Named:
    """What a recording says of content that is in part of no use: all of `words` in one sentence."""

    words: tuple[str, ...]
    more: Entries = ()
    content: Entries = tuple(MESSAGES)
    is_problem: bool = False
    is_commanded: bool = True


def with_text(topic: str, text: str, words: str, **more: object) -> Named:
    return Named((topic, words), [made.text_entry(topic, 5.0, text)], **more)


def a_torque(scale: float) -> Entries:
    """The content with torques `scale` times as large, and one of them beyond all."""
    scales = np.full((len(TRIAL.time), 1), scale)
    scales[300] = 1e30
    return tuple(made.messages(replace(TRIAL, effort=TRIAL.effort * scales, command=TRIAL.command * scales)))


def without(topic: str) -> Entries:
    return tuple(item for item in MESSAGES if item[0] != topic)


def not_finite(position: float) -> Named:
    data = made.joint_state(made.START + 5 * SECOND, made.NAMES, (0.0, position, 0.0, 0.0), np.zeros(4), np.zeros(4))
    return Named(("right: ", " 1"), [(STATES, made.JOINT_STATE, made.START + 17 * SECOND, data)])


GRIPPER = [
    (STATES, made.JOINT_STATE, at + 1000, made.joint_state(at, ["gripper"], [0.1]))
    for topic, _, at, _ in CONTENT[::7]
    if topic == STATES
]
LEFT_OUT = "damaged messages left out: 1"
NAMED = {
    **{
        text: with_text(STEPS, text, "", is_problem=True)
        for text in ("no JSON", "[1]", "{}", '{"action": "hold", "duration": null}', "[" * 100_000)
    },
    "nested too deep": with_text(SESSION, "[" * 100_000, "invalid", is_problem=True),
    "gibberish alone": replace(with_text(STEPS, "gibberish", "", is_problem=True), content=without(STEPS)),
    "nan": not_finite(np.nan),
    "inf": not_finite(np.inf),
    "commands of others": Named(
        (COMMANDS, "a, b, c, d", "right_joint_1"),
        content=tuple(made.messages(TRIAL, command_names="abcd")),
        is_problem=True,
        is_commanded=False,
    ),
    "no commands": Named(("effort_commands",), content=without(COMMANDS), is_commanded=False),
    "a gripper": Named((f"other joints left out: {len(GRIPPER)}",), GRIPPER),
    "an arm that nothing commands": Named(
        ("/left/joint_states: not reported",),
        [("/left/joint_states", *entry[1:]) for entry in CONTENT if entry[0] == STATES],
    ),
    "law": with_text(PARAMETERS, "/right/compensator:\n  ros__parameters: {law: a: b}\n", LEFT_OUT),
    "no mapping": with_text(PARAMETERS, "/right/compensator:\n  ros__parameters: 1\n", LEFT_OUT),
    "no parameters": with_text(PARAMETERS, "/right/compensator", LEFT_OUT),
    "parameters nested too deep": with_text(PARAMETERS, "/right/compensator: " + "[\n" * 50_000, LEFT_OUT),
    **{
        values: with_text(PARAMETERS, f"/right/{node}: {{ros__parameters: {values}}}", LEFT_OUT)
        for node, values in (
            ("compensator", "{support: lots}"),
            ("can_bridge", "{can.interface: socketcan, can.channel: {a: 1}}"),
            ("compensator", "{law: 7}"),
            ("compensator", "{robot.mass: [1.0, 2.0]}"),
            ("compensator", "{law: urdf, urdf.file: 7, joint_names: [a]}"),
        )
    },
}


@pytest.mark.parametrize("name", NAMED, ids=lambda name: name[:40])
def test_what_cannot_be_read_is_named_and_the_rest_is_read(tmp_path, name):
    case = NAMED[name]
    report, arm, _ = report_of(made.write_bag(tmp_path / "bag", [*case.content, *case.more]))
    made.assert_same(arm, TRIAL)
    assert len(report.arms) == 1 and np.isfinite(arm.command).any() == case.is_commanded
    found, others = report.bag.problems, report.bag.notes
    if not case.is_problem:
        found, others = others, found
    assert not others and len(found) == 1
    assert all(word in found[0] for word in case.words) and not report.bag.parameters


def test_torques_that_no_motor_has_and_a_single_impossible_angle_are_left_out_and_named(tmp_path):
    for scale, lost in ((1000.0, 1.0), (1.0, 0.0)):
        found = read(tmp_path / str(scale), a_torque(scale))
        assert np.isnan(found.recordings[0].effort).mean() == pytest.approx(lost, abs=0.002)
        notes = [note for note in found.notes if "torques left out: " in note]
        assert len(notes) == 2 and all(("are they in mNm?" in note) == (lost == 1.0) for note in notes)
    found = read(tmp_path, poses(lambda k, pose: pose * (99.0 if k == 300 else 1.0)))
    assert len(found.recordings[0].time) == len(TRIAL.time) - 1
    assert "right: joint states left out, a position is beyond ±2 pi: 1" in found.notes


# Messages decoded in bulk


def filled(rng, node, detail):
    """Return a value at random of a type, as rosbags describes it."""
    if node is Nodetype.NAME:
        fields = made.STORE.fielddefs[detail][1]
        return made.STORE.types[detail](*(filled(rng, *field) for _, field in fields))
    kind, count = (detail[0], 1) if node is Nodetype.BASE else (detail[0][1][0], detail[1] or int(rng.integers(5)))
    texts = ["abcü"[: int(rng.integers(5))] for _ in range(count)]
    values = texts if kind == "string" else rng.integers(99, size=count).astype(kind)
    return values[0] if node is Nodetype.BASE else values


@pytest.mark.parametrize("kind", [made.JOINT_STATE, "sensor_msgs/msg/Imu", made.TILT_TYPE])
def test_numbers_and_texts_are_those_that_rosbags_decodes_and_a_damaged_message_is_left_out_and_counted(kind):
    rng, decoder, found = np.random.default_rng(1), Decoder(kind), {}
    messages = [
        bytes(made.STORE.serialize_cdr(filled(rng, Nodetype.NAME, kind), kind, little_endian=bool(n % 3)))
        for n in range(60)
    ]
    messages = [messages[n] for n in rng.integers(60, size=200)]
    messages[7] = messages[7][:30]
    for index, layout, values in decoder.decode(Messages("", kind, *[np.arange(200)] * 2, messages)):
        found |= {at: (layout.texts, row) for at, row in zip(index.tolist(), values, strict=True)}
    assert sorted(found) == [n for n in range(200) if n != 7] and decoder.damaged == 1
    for at, (texts, row) in found.items():
        expected = made.STORE.deserialize_cdr(messages[at], kind)
        for path, value in ({name: row[name] for name in row.dtype.names or ()} | texts).items():
            np.testing.assert_array_equal(np.ravel(value), np.ravel(reduce(getattr, path.split("."), expected)))


# Events and parameters


def states(*names, first=0.1, period=0.5):
    """The bridge's state, every half second from 0.1 s on; None for no report."""
    return [made.status(first + number * period, name, state=name) for number, name in enumerate(names) if name]


def test_an_arm_is_carried_from_the_first_to_the_last_carrying_state(tmp_path):
    names = ["checking", "ramping in", "active", "active", "letting down", "fault", "checking", "active", "active"]
    (arm,) = read(tmp_path, [*MESSAGES, *states(*names, first=0.0, period=0.1)]).recordings
    arrival = 0.0002  # s, of the first joint state, at which time begins
    np.testing.assert_allclose(arm.carried, [(0.1 - arrival, 0.3 - arrival), (0.7 - arrival, 0.8 - arrival)], atol=1e-9)


@pytest.mark.parametrize(
    ("names", "notes"),
    [
        (["active"] * 20, 1),
        (["active"] * 6 + ["letting down"] * 3, 1),
        (["active"] * 4 + [None] * 5, 0),
        *((["active"] * 8 + [last], 0) for last in ("disabled", "fault")),
    ],
)
def test_a_recording_that_ends_before_the_arm_is_down_says_so(tmp_path, names, notes):
    until = made.START + 4.35 * SECOND
    found = read(tmp_path, [item for item in (*MESSAGES, *states(*names)) if item[2] < until])
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


def test_faults_changed_parameters_and_parameters_at_the_start_are_read(tmp_path):
    snapshot = "/right/compensator:\n  ros__parameters: {law: exact}\n"
    keys = {"fault": "motor_silent", "fault text": "elbow: no reply for 0.05 s"}
    silent = [made.status(seconds, "motor 2 is silent", level=2, **keys) for seconds in (3.0, 3.5)]
    found = read(
        tmp_path, [*MESSAGES, made.text_entry("/recorder/parameters", 1.0, snapshot), made.status(2.0, "fine"), *silent,
        made.status(4.0, "fine"), parameter_event(5.0, "support", 0.5)],
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
    right = replace(right, carried=((0.5, middle),), command=np.full_like(right.command, np.nan))
    left = replace(right, name="left", carried=None, position=right.position + 0.25, steps=())
    return replace(made.bag_of(right), recordings=(right, left), session=Session(subject="P07"))


def test_each_sample_of_each_joint_of_each_arm_is_a_row_with_its_step_and_whether_the_arm_was_carried(bag):
    frame = bag.to_frame()
    assert len(frame) == 8 * len(bag.recordings[0].time) and set(frame.subject) == {"P07"}
    for recording in bag.recordings:
        steps = [*enumerate(recording.steps, 1)]
        inside = [[(n, step.action) for n, step in steps if step.start <= now < step.end] for now in recording.time]
        first, last = recording.carried[0] if recording.carried else (0.0, np.inf)
        for joint, name in enumerate(recording.joint_names):
            rows = frame[(frame.arm == recording.name) & (frame.joint == name)]
            for column, expected in {
                "time_s": recording.time,
                "position_rad": recording.position[:, joint],
                "velocity_rad_per_s": recording.velocity[:, joint],
                "torque_nm": recording.effort[:, joint],
                "command_nm": recording.command[:, joint],
                "carried": (first <= recording.time) & (recording.time <= last),
            }.items():
                np.testing.assert_array_equal(rows[column], expected)
            assert [*zip(rows.step, rows.action, strict=True)] == [found[0] if found else (0, "") for found in inside]
