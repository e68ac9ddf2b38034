# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings of `BagWriter` and complete copies of cut ones, read by independent readers; also of a killed process."""

import signal
import subprocess
import sys
import threading
from contextlib import closing

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader, ReaderError, StoragePlugin, Writer

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.bag.writer import BagWriter, is_complete, offered_qos, repair
from exo_gravity.tools.report import main

from ...support import ROOT
from ...support import synthetic_bags as made

JOINT_STATE, STRING, NAMES, START = made.JOINT_STATE, made.STRING, list(made.NAMES), made.START
STATES, STEPS = "/right/joint_states", "/right/wearer_step"
RELIABLE, LATCHED = offered_qos(True, False, 1), offered_qos(True, True, 1)


def state(k):
    return STATES, START + k, made.joint_state(START + k, NAMES, *[(k / 1000, 0.1, 0.2, 0.3)] * 3)


@pytest.fixture
def opened(tmp_path):
    """A writer of joint states and steps into `tmp_path / "bag"`, which is closed at the end."""
    with closing(BagWriter(tmp_path / "bag")) as writer:
        writer.add_topic(STATES, JOINT_STATE, RELIABLE)
        writer.add_topic(STEPS, STRING, LATCHED)
        yield writer


def test_rosbags_reads_topics_types_messages_and_the_offered_quality_of_service(opened):
    opened.write([state(k) for k in range(100)])
    opened.close()
    with AnyReader([opened.path]) as reader:
        messages = [(stamp, reader.deserialize(data, c.msgtype).position[0]) for c, stamp, data in reader.messages()]
        types = {topic: info.msgtype for topic, info in reader.topics.items()}
        offered = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
    assert types == {STATES: JOINT_STATE, STEPS: STRING} and opened.error is None
    assert messages == [(START + k, k / 1000) for k in range(100)]
    assert {offered[topic].reliability for topic in types} == {QosReliability.RELIABLE}
    durability = [offered[topic].durability for topic in (STATES, STEPS)]
    assert durability == [QosDurability.VOLATILE, QosDurability.TRANSIENT_LOCAL]


def test_an_existing_folder_is_not_overwritten_and_an_unknown_type_is_refused_by_name(opened):
    with pytest.raises(DataError, match="exists already"):
        BagWriter(opened.path)
    with pytest.raises(DataError, match="my_msgs/msg/Mine"):
        opened.add_topic("/mine", "my_msgs/msg/Mine", RELIABLE)


def test_queued_messages_are_written_before_the_end_except_those_that_cannot_be_which_are_counted(opened):
    for k in range(1500):
        opened.write([state(k)])
    opened.write([state(1500), ("/nowhere", START, b""), (STATES, -1, b""), state(1501)])
    opened.close()
    assert (opened.count, opened.lost, opened.error) == (1502, 2, None)
    assert len(made.only(opened.path).time) == 1502


def test_messages_that_a_slow_disk_cannot_take_are_counted_and_the_recording_goes_on(tmp_path, monkeypatch):
    ready = threading.Event()
    monkeypatch.setattr("exo_gravity.lab.bag.writer.MAX_WAITING", 10)
    write = Writer.write
    monkeypatch.setattr(Writer, "write", lambda self, *message: ready.wait() and write(self, *message))
    with closing(BagWriter(tmp_path / "bag")) as writer:
        writer.add_topic(STATES, JOINT_STATE, RELIABLE)
        for k in range(20):
            writer.write([state(k)])
        ready.set()
    assert 9 <= writer.lost <= 11  # the queue holds ten, one of them the topic, and the thread one
    assert writer.error is None and writer.count == 20 - writer.lost == len(made.only(writer.path).time)


# Writes until it is killed, so slowly that no buffer fills up and is flushed; prints the stamp of each message.
RECORDER = """
import sys, time
from exo_gravity.lab.bag.writer import BagWriter, offered_qos
from test.support.synthetic_bags import JOINT_STATE, NAMES, joint_state
writer = BagWriter(sys.argv[1])
writer.add_topic("/right/joint_states", JOINT_STATE, offered_qos(True, False, 1))
while True:
    now = time.time_ns()
    writer.write([("/right/joint_states", now, joint_state(now, NAMES, *[[0.1] * 4] * 3))])
    print(now, flush=True)
    time.sleep(0.2)
"""


def test_a_killed_recorder_loses_at_most_the_last_second(tmp_path):
    path = tmp_path / "bag"
    process = subprocess.Popen([sys.executable, "-c", RECORDER, str(path)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    stamps = []
    while len(stamps) < 2 or stamps[-1] - stamps[0] < 1.7e9:
        stamps.append(int(process.stdout.readline()))
    process.send_signal(signal.SIGKILL)
    stamps += [int(line) for line in process.stdout.read().split()]
    process.wait()
    assert not (path / "metadata.yaml").exists()
    read = read_bag(path)
    written = len(read.recordings[0].time)
    assert stamps[-1] - stamps[written - 1] < 1e9
    assert "cut short" in read.notes[0]


@pytest.fixture
def cut(tmp_path):
    """The folder of a recording whose file ends within a chunk, without metadata.yaml."""
    content = list(made.messages(made.trial(made.POSES, hold=6.0, rate=500.0)))
    with closing(BagWriter(tmp_path / "bag")) as writer:
        for topic, msgtype in {item[0]: item[1] for item in content}.items():
            writer.add_topic(topic, msgtype, offered_qos("step" not in topic, "step" in topic, 1))
        writer.write([(topic, stamp, data) for topic, _, stamp, data in content])
    made.cut(tmp_path / "bag" / "bag.mcap", 2 / 3)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    return tmp_path / "bag"


def test_the_copy_has_every_message_with_index_types_and_quality_of_service_and_rosbags_opens_it(cut):
    with pytest.raises((ReaderError, FileNotFoundError)), Reader(cut):
        pass
    original = (cut / "bag.mcap").read_bytes()
    folder, count = repair(cut)
    assert folder == cut.with_name("bag_repaired") and (cut / "bag.mcap").read_bytes() == original
    with (folder / "bag_repaired.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary.statistics.message_count == count > 1000 and summary.chunk_indexes
    with AnyReader([folder]) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles[0].durability.name for c in reader.connections}
        stamps = [stamp for c, stamp, data in reader.messages() if reader.deserialize(data, c.msgtype)]
        assert reader.message_count == count == len(stamps)
    assert stamps == sorted(stamps)
    assert offered[STEPS] == "TRANSIENT_LOCAL" and offered[STATES] == "VOLATILE"
    (before,), (after,) = read_bag(cut).recordings, read_bag(folder).recordings
    np.testing.assert_array_equal(after.position, before.position)
    np.testing.assert_array_equal(after.command, before.command)
    assert after.steps == before.steps and not read_bag(folder).notes


def test_a_recording_is_repaired_once_on_the_command_line_also_a_single_file(cut, capsys):
    repaired = cut.with_name("bag_repaired")
    assert main(["--repair", str(cut / "bag.mcap")]) == 0
    assert (cut / "bag_repaired").is_dir() and is_complete(cut / "bag_repaired")
    for path, code, words in ((cut, 0, str(repaired)), (cut, 2, "exists already"), (repaired, 0, "nothing to repair")):
        assert main(["--repair", str(path)]) == code
        printed = capsys.readouterr()
        assert words in printed.out + printed.err


def test_a_recording_without_messages_or_of_another_format_is_refused(tmp_path):
    (tmp_path / "empty.mcap").write_bytes(b"\x89MCAP0\r\n")
    made.write_bag(tmp_path / "sqlite", [made.text_entry("/a", 0.0, "b")], StoragePlugin.SQLITE3)
    for name, words in (("empty.mcap", "no message"), ("sqlite", r"an \.mcap file"), ("nothing", "no such file")):
        with pytest.raises(DataError, match=words):
            repair(tmp_path / name)
