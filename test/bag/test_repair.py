"""Recordings that were cut short -> complete copies, read by rosbags' own readers."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader, ReaderError, StoragePlugin

from exo_gravity.bag.reader import read_bag
from exo_gravity.bag.writer import BagWriter, is_complete, offered_qos, repair
from exo_gravity.core.errors import DataError
from exo_gravity.tools.report import main

from ..support import synthetic_bags as made


@pytest.fixture
def cut(tmp_path):
    """The folder of a recording whose file ends within a chunk, without metadata.yaml."""
    recording = made.trial([[0.1, 0.4, 0.5, 0.6], [-0.2, 0.8, 0.3, 0.9]], hold=3.0, rate=200.0)
    with BagWriter(tmp_path / "bag") as writer:
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
