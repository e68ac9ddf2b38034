# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings of every form, complete, cut short, damaged or incomplete: what can be read is read, the rest is named.

rosbags is the independent writer and decoder.
"""

from __future__ import annotations

import itertools
import json
import re
import shutil
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.pairing import PAIRING
from exo_gravity.lab.bag.reader import read_bag

from ...support import synthetic_bags as made

FORMS = {
    "mcap": {},
    "sqlite3": {"plugin": StoragePlugin.SQLITE3},
    "mcap with compressed chunks": {"compression": CompressionMode.STORAGE},
    "compressed file": {"compression": CompressionMode.FILE},
    "compressed messages": {"compression": CompressionMode.MESSAGE},
}
STATES, COMMANDS, STEPS = (f"/right/{name}" for name in ("joint_states", "effort_commands", "wearer_step"))


@pytest.fixture
def written(tmp_path):
    """A function that writes a bag and returns what is read of it."""
    return lambda *content, **form: read_bag(made.write_bag(tmp_path / "written", content, **form))


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_every_form_of_rosbag2_gives_the_arrays_that_were_written(recording, content, written, form):
    made.assert_same(written(*content, **form).recordings[0], recording)


@pytest.mark.parametrize("chunked", [True, False])
def test_an_mcap_file_of_another_writer_is_read(recording, content, tmp_path, chunked):
    with (tmp_path / "other.mcap").open("wb") as file:
        writer = McapWriter(file, chunk_size=20_000, compression=CompressionType.LZ4, use_chunking=chunked)
        writer.start("ros2")
        schema = writer.register_schema(made.JOINT_STATE, "ros2msg", b"std_msgs/Header header")
        channels = {topic: writer.register_channel(topic, "cdr", schema) for topic in (STATES, COMMANDS)}
        for topic, _, stamp, data in content:
            if topic in channels:
                writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()
    made.assert_same(made.only(tmp_path / "other.mcap"), recording)


def test_the_parts_of_a_recording_are_read_in_the_order_of_their_numbers(recording, content, tmp_path):
    folder = tmp_path / "split"
    folder.mkdir()
    edges = np.linspace(0, len(content), 13).astype(int)
    for number, (first, last) in enumerate(itertools.pairwise(edges)):
        part = made.write_bag(tmp_path / f"part_{number}", content[first:last])
        shutil.move(part / f"part_{number}.mcap", folder / f"split_{number}.mcap")
    made.assert_same(made.only(folder), recording)


def test_time_is_that_of_the_stamps_from_the_first_arrival_on_and_without_stamps_that_of_arrival(
    recording, bag, written
):
    read = made.only(bag)
    np.testing.assert_allclose(read.time, recording.time - 200e-6, atol=1e-8)
    assert read.carried is None  # no state was reported
    states = [
        ("/joint_states", made.JOINT_STATE, made.START + round(time * 1e9), made.joint_state(0, made.NAMES, pose))
        for time, pose in zip(recording.time.tolist(), recording.position, strict=True)
    ]
    (read,) = written(*states).recordings
    np.testing.assert_allclose(read.time, recording.time, atol=1e-8)
    assert read.name == "arm"


def test_a_command_is_paired_with_the_state_after_the_one_that_it_answers_and_expires(recording, content, written):
    last = made.START + 2 * 10**9
    read = written(*(item for item in content if item[0] != COMMANDS or item[2] < last)).recordings[0]
    answered = np.isfinite(read.command[:, 0])
    np.testing.assert_allclose(read.command[1:][answered[1:]][:300], recording.command[:300], rtol=1e-6)
    assert not answered[0] and answered[1 : np.searchsorted(read.time, 2.0)].all()
    assert not answered[read.time > 2.3].any()


def test_joints_are_found_by_name_whatever_their_order_and_their_number_of_bytes(recording, content, written):
    turned = [
        (topic, kind, stamp, made.joint_state(stamp - 500_000, made.NAMES[::-1], effort=command[::-1]))
        for (topic, kind, stamp, _), command in zip(
            (item for item in content if item[0] == COMMANDS), recording.command, strict=True
        )
    ]
    rng = np.random.default_rng(5)
    states = []
    for k, values in enumerate(np.stack((recording.position, recording.velocity, recording.effort), axis=1)):
        order = rng.permutation(4)
        stamp = made.START + k * 5_000_000
        data = made.joint_state(stamp, [made.NAMES[i] for i in order], *values[:, order], frame="x" * (k % 5))
        states.append((STATES, made.JOINT_STATE, stamp + 200_000, data))
    read = written(*turned, *states).recordings[0].in_order(made.NAMES)
    made.assert_same(read, recording)
    np.testing.assert_allclose(read.command[1:], recording.command[:-1], rtol=1e-6)


def test_the_recorded_wearer_steps_are_the_script(recording, content, written):
    done = made.text_entry(STEPS, 9.0, json.dumps({"step": 4, "of": 4, "action": "done", "duration": 0.0}))
    *steps, last = written(*content, done).recordings[0].steps
    assert [step.action for step in steps] == ["move", "hold", "move", "hold"] and last.action == "done"
    np.testing.assert_allclose([step.start for step in steps], [step.start for step in recording.steps], atol=0.006)


@pytest.mark.parametrize(
    ("form", "share", "least"),
    [
        *(("mcap", share, 0.8) for share in (0.2, 0.5, 0.9)),
        *(("mcap with compressed chunks", share, 0.1) for share in (0.5, 0.9)),
        ("sqlite3", 0.6, 0.2),
    ],
)
def test_a_recording_cut_short_gives_what_was_written_before(recording, content, tmp_path, form, share, least):
    chunks = form == "mcap with compressed chunks"  # of 1 MiB
    bag = made.write_bag(tmp_path / "bag", content * 4 if chunks else content, **FORMS[form])
    if not chunks:
        (bag / "metadata.yaml").unlink()
    made.cut(next(file for file in bag.iterdir() if file.suffix != ".yaml"), share)
    read = read_bag(bag)
    (arm,) = read.recordings
    assert least * share < len(arm.time) / len(recording.time) <= (4.0 if chunks else 1.0)
    if form == "mcap":
        made.assert_same(arm, recording, len(arm.time))
    assert "cut short" in read.notes[0]


def test_a_recording_that_lacks_only_its_index_is_complete(recording, bag):
    file = bag / "bag.mcap"
    file.write_bytes(file.read_bytes()[:-40])
    read = read_bag(bag)
    made.assert_same(read.recordings[0], recording)
    assert not read.notes


@pytest.mark.parametrize("name", ["missing", "folder", "text.mcap", "text.db3", "text.txt"])
def test_a_file_that_is_not_a_recording_is_refused_by_name(tmp_path, name):
    (tmp_path / "folder").mkdir()
    for file in ("text.mcap", "text.db3", "text.txt"):
        (tmp_path / file).write_text("no recording at all, though long enough to look at\n" * 20)
    with pytest.raises(DataError, match=name):
        read_bag(tmp_path / name)


def broken(content):
    return [(topic, kind, stamp, data[:40]) for topic, kind, stamp, data in content if kind == made.JOINT_STATE]


UNREADABLE = {
    "empty": (lambda _: [], "is empty"),
    "other topics": (lambda _: [made.text_entry("/chatter", 0.0, "hello")], "joint_states .* /chatter"),
    "another type": (lambda _: [made.text_entry(STATES, 0.0, "hello")], f"no topic .* it has {STATES}"),
    "damaged messages": (broken, f"{STATES}: .*damaged"),
}


@pytest.mark.parametrize(("change", "words"), UNREADABLE.values(), ids=UNREADABLE)
def test_a_recording_without_readable_joint_states_is_refused_with_what_it_has(content, written, change, words):
    with pytest.raises(DataError, match=words):
        written(*change(content), topics=[(STATES, made.JOINT_STATE)] if not change(content) else ())


def not_finite(position):
    data = made.joint_state(made.START + 5 * 10**9, made.NAMES, (0.0, position, 0.0, 0.0), np.zeros(4), np.zeros(4))
    return STATES, made.JOINT_STATE, made.START + 9 * 10**9, data


PROBLEMS = {
    **{text: ([made.text_entry(STEPS, 9.0, text)], STEPS) for text in ("no JSON", "[1]", "{}")},
    "null": ([made.text_entry(STEPS, 9.0, '{"action": "hold", "duration": null}')], STEPS),
}
NOTES = {name: ([not_finite(value)], "right: .* 1$") for name, value in (("nan", np.nan), ("inf", np.inf))}


@pytest.mark.parametrize(("more", "words"), {**PROBLEMS, **NOTES}.values(), ids={**PROBLEMS, **NOTES})
def test_what_cannot_be_read_is_named_and_the_rest_is_read(content, recording, written, more, words):
    read = written(*content, *more)
    made.assert_same(read.recordings[0], recording)
    (named,) = read.notes if "right" in words and STEPS not in words else read.problems
    assert re.search(words, named)


def test_without_fitting_commands_or_any_valid_step_the_joint_states_are_read(recording, content, tmp_path):
    for number, (changed, words) in enumerate(
        (
            (made.messages(recording, command_names="abcd"), (COMMANDS, "a, b, c, d", "right_joint_1")),
            ([item for item in content if item[0] != COMMANDS], ("effort_commands",)),
            ([*(item for item in content if item[0] != STEPS), made.text_entry(STEPS, 0.0, "gibberish")], (STEPS,)),
        )
    ):
        read = read_bag(made.write_bag(tmp_path / str(number), changed))
        made.assert_same(read.recordings[0], recording)
        (named,) = (*read.problems, *read.notes)
        assert all(word in named for word in words)
        assert np.isnan(read.recordings[0].command).all() == (number < 2)


def test_one_of_several_samples_is_kept_of_each_arm_each_with_the_command_that_was_in_force(
    content, tmp_path, monkeypatch
):
    monkeypatch.setattr("exo_gravity.lab.bag.storage.ROWS", 50)  # many batches: each goes on counting
    gripper = [
        (STATES, made.JOINT_STATE, at + 1000, made.joint_state(at, ["gripper"], [0.1]))
        for topic, _, at, _ in content
        if topic == STATES
    ]
    bag = made.write_bag(tmp_path / "bag", [*content, *gripper])
    (whole,), (thinned,) = (read_bag(bag, every).recordings for every in (1, 7))
    for field in ("time", "position", "velocity", "effort", "command"):
        np.testing.assert_array_equal(getattr(thinned, field), getattr(whole, field)[::7])


def test_memory_follows_the_samples_that_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr("exo_gravity.lab.bag.storage.ROWS", 500)
    monkeypatch.setattr("exo_gravity.lab.bag.pairing.PAIRING", replace(PAIRING, pending=500))
    bags = []
    for minutes in (1, 2):
        exact = made.still(made.POSES[0], 60.0 * minutes, rate=100.0)
        recording = made.measured(exact, rate=100.0)
        bags.append(made.write_bag(tmp_path / str(minutes), made.messages(recording)))

    def bytes_a_sample(every):
        peaks = []
        for bag in bags:
            tracemalloc.start()
            read_bag(bag, every)
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        return (peaks[1] - peaks[0]) / 6000

    read_bag(bags[0])  # what is imported and kept for all recordings
    assert 100.0 < bytes_a_sample(1) < 400.0  # of the two messages of a sample, which have 470 bytes
    assert bytes_a_sample(50) < 20.0
