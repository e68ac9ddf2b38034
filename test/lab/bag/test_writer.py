"""Recordings of `BagWriter` and complete copies of cut ones, read by independent readers; also of a killed process."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from contextlib import closing

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader, ReaderError, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.bag.writer import BagWriter, is_complete, offered_qos, repair
from exo_gravity.tools.report import main

from ...support import ROOT
from ...support import synthetic_bags as made

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE, STRING = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
NAMES = ["shoulder", "abduction", "flexion", "elbow"]
START = 1_700_000_000_000_000_000
RELIABLE = offered_qos(True, False, 1)


def joint_state(k):
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](sec=START // 10**9, nanosec=k)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    return bytes(
        STORE.serialize_cdr(types[JOINT_STATE](header, NAMES, *[np.array([k, 0.1, 0.2, 0.3])] * 3), JOINT_STATE)
    )


@pytest.fixture
def bag(tmp_path):
    with closing(BagWriter(tmp_path / "bag")) as writer:
        writer.add_topic("/right/joint_states", JOINT_STATE, RELIABLE)
        writer.add_topic("/right/wearer_step", STRING, offered_qos(True, True, 1))
        writer.write([("/right/joint_states", START + k, joint_state(k)) for k in range(100)])
    assert writer.error is None
    return tmp_path / "bag"


def test_mcap_decodes_the_joint_names_from_the_schema_in_the_file(bag):
    with (bag / "bag.mcap").open("rb") as file:
        decoded = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert [message.position[0] for _, _, _, message in decoded] == list(range(100))
    schema, channel, record, message = decoded[7]
    assert (schema.name, channel.topic, record.log_time) == (JOINT_STATE, "/right/joint_states", START + 7)
    assert list(message.name) == NAMES


def test_rosbags_reads_topics_types_and_messages(bag):
    with AnyReader([bag]) as reader:
        messages = [(c.topic, stamp, reader.deserialize(data, c.msgtype)) for c, stamp, data in reader.messages()]
        assert {topic: info.msgtype for topic, info in reader.topics.items()} == {
            "/right/joint_states": JOINT_STATE,
            "/right/wearer_step": STRING,
        }
    assert [(stamp, state.position[0]) for _, stamp, state in messages] == [(START + k, k) for k in range(100)]


def test_the_offered_quality_of_service_is_recorded(bag):
    with AnyReader([bag]) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
    assert offered["/right/joint_states"].reliability == QosReliability.RELIABLE
    assert offered["/right/joint_states"].durability == QosDurability.VOLATILE
    assert offered["/right/wearer_step"].durability == QosDurability.TRANSIENT_LOCAL


def test_metadata_has_rosbag2s_form_and_the_hash_of_each_type(bag):
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["storage_identifier"] == "mcap" and metadata["message_count"] == 100
    topic = metadata["topics_with_message_count"][0]["topic_metadata"]
    # What Jazzy's own publishers of a JointState announce.
    expected = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
    assert topic["type_description_hash"] == expected


def test_an_existing_folder_is_not_overwritten(bag):
    with pytest.raises(DataError, match="exists already"):
        BagWriter(bag)


def test_an_unknown_type_is_refused_by_name(tmp_path):
    with closing(BagWriter(tmp_path / "bag")) as writer, pytest.raises(DataError, match="my_msgs/msg/Mine"):
        writer.add_topic("/mine", "my_msgs/msg/Mine", RELIABLE)


def test_queued_messages_are_written_before_the_end(tmp_path):
    with closing(BagWriter(tmp_path / "bag")) as writer:
        writer.add_topic("/right/joint_states", JOINT_STATE, RELIABLE)
        for k in range(1500):
            writer.write([("/right/joint_states", START + k, joint_state(k))])
    assert writer.count == len(read_bag(tmp_path / "bag").recordings[0].time) == 1500


def test_messages_that_a_slow_disk_cannot_take_are_counted_and_the_recording_goes_on(tmp_path, monkeypatch):
    ready = threading.Event()
    monkeypatch.setattr("exo_gravity.lab.bag.writer.MAX_WAITING", 10)
    write = Writer.write
    monkeypatch.setattr(Writer, "write", lambda self, *message: ready.wait() and write(self, *message))
    with closing(BagWriter(tmp_path / "bag")) as writer:
        writer.add_topic("/right/joint_states", JOINT_STATE, RELIABLE)
        for k in range(20):
            writer.write([("/right/joint_states", START + k, joint_state(k))])
        assert writer.lost in (9, 10)  # the writer holds ten or eleven
        ready.set()
    assert writer.error is None and writer.count == 20 - writer.lost
    assert len(read_bag(tmp_path / "bag").recordings[0].time) == writer.count


def test_a_message_that_cannot_be_written_is_counted_and_the_others_are_written(tmp_path):
    with closing(BagWriter(tmp_path / "bag")) as writer:
        writer.add_topic("/right/joint_states", JOINT_STATE, RELIABLE)
        good = [("/right/joint_states", START + k, joint_state(k)) for k in range(4)]
        writer.write([*good[:2], ("/nowhere", START, b""), ("/right/joint_states", -1, b""), *good[2:]])
    assert (writer.count, writer.lost, writer.error) == (4, 2, None)


def test_a_killed_recorder_loses_at_most_the_last_second(tmp_path):
    path = tmp_path / "bag"
    process = subprocess.Popen(
        [sys.executable, "-m", "test.support.bag_processes", str(path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
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
    recording = made.trial([[0.1, 0.4, 0.5, 0.6], [-0.2, 0.8, 0.3, 0.9]], hold=3.0, rate=200.0)
    with closing(BagWriter(tmp_path / "bag")) as writer:
        for topic, msgtype in {item[0]: item[1] for item in made.messages(recording)}.items():
            writer.add_topic(topic, msgtype, offered_qos("step" not in topic, "step" in topic, 1))
        writer.write([(topic, stamp, data) for topic, _, stamp, data in made.messages(recording)])
    file = tmp_path / "bag" / "bag.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    (tmp_path / "bag" / "metadata.yaml").unlink()
    return tmp_path / "bag"


def test_the_copy_has_every_message_that_can_be_read_and_rosbags_opens_it(cut):
    with pytest.raises((ReaderError, FileNotFoundError)), Reader(cut):
        pass
    original = (cut / "bag.mcap").read_bytes()
    folder, count = repair(cut)
    assert folder == cut.with_name("bag_repaired") and (cut / "bag.mcap").read_bytes() == original
    with Reader(folder) as reader:
        stamps = [stamp for _, stamp, _ in reader.messages()]
        assert reader.message_count == count == len(stamps) > 1000
    assert stamps == sorted(stamps)
    (before,), (after,) = read_bag(cut).recordings, read_bag(folder).recordings
    np.testing.assert_array_equal(after.position, before.position)
    np.testing.assert_array_equal(after.command, before.command)
    assert after.steps == before.steps and not read_bag(folder).notes


def test_the_copy_has_an_index_and_metadata_with_types_and_quality_of_service(cut):
    folder, count = repair(cut)
    with (folder / "bag_repaired.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary.statistics.message_count == count and summary.chunk_indexes
    metadata = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["message_count"] == count and metadata["storage_identifier"] == "mcap"
    with AnyReader([folder]) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles[0].durability.name for c in reader.connections}
        messages = [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages()]
    assert offered["/right/wearer_step"] == "TRANSIENT_LOCAL" and offered["/right/joint_states"] == "VOLATILE"
    assert len(messages) == count


def test_a_recording_is_repaired_once_on_the_command_line(cut, capsys):
    assert main(["--repair", str(cut)]) == 0
    assert f"Written: {cut}_repaired, complete, with " in capsys.readouterr().out
    assert main(["--repair", str(cut)]) == 2  # not twice
    assert "exists already" in capsys.readouterr().err
    assert main(["--repair", f"{cut}_repaired"]) == 0
    assert "nothing to repair" in capsys.readouterr().out


def test_a_single_file_is_repaired_too(cut):
    folder, count = repair(cut / "bag.mcap")
    assert folder == cut / "bag_repaired" and count > 1000 and is_complete(folder)


def test_a_recording_without_messages_or_of_another_format_is_refused(tmp_path, cut):
    (tmp_path / "empty.mcap").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(DataError, match="the recording has no message"):
        repair(tmp_path / "empty.mcap")
    sqlite = made.write_bag(
        tmp_path / "sqlite", [("/a", "std_msgs/msg/String", 1, made.string("b"))], StoragePlugin.SQLITE3
    )
    with pytest.raises(DataError, match=r"must be an \.mcap file"):
        repair(sqlite)
    with pytest.raises(DataError, match="no such file"):
        repair(tmp_path / "nothing")
