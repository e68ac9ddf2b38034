# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings of `BagWriter`, read by independent readers; also of a killed process."""

import signal
import subprocess
import sys
import threading
from contextlib import closing

import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Writer

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.bag.writer import BagWriter, offered_qos

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


def test_rosbags_reads_what_was_queued_with_its_quality_of_service_and_what_cannot_be_written_is_counted(opened):
    for k in range(1500):
        opened.write([state(k)])
    opened.write([state(1500), ("/nowhere", START, b""), (STATES, -1, b""), state(1501)])
    opened.close()
    assert (opened.count, opened.lost, opened.error) == (1502, 2, None)
    with AnyReader([opened.path]) as reader:
        messages = [(stamp, reader.deserialize(data, c.msgtype).position[0]) for c, stamp, data in reader.messages()]
        types = {topic: info.msgtype for topic, info in reader.topics.items()}
        offered = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
    assert types == {STATES: JOINT_STATE, STEPS: STRING}
    assert messages == [(START + k, k / 1000) for k in range(1502)]
    assert {offered[topic].reliability for topic in types} == {QosReliability.RELIABLE}
    durability = [offered[topic].durability for topic in (STATES, STEPS)]
    assert durability == [QosDurability.VOLATILE, QosDurability.TRANSIENT_LOCAL]


def test_an_existing_folder_is_not_overwritten_and_an_unknown_type_is_refused_by_name(opened):
    with pytest.raises(DataError, match="exists already"):
        BagWriter(opened.path)
    with pytest.raises(DataError, match="my_msgs/msg/Mine"):
        opened.add_topic("/mine", "my_msgs/msg/Mine", RELIABLE)


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
