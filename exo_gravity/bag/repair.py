"""A recording that was cut short -> a complete copy next to it, which `ros2 bag` opens: MCAP with index, metadata.yaml.

The copy has every message that the reader finds in the original, which stays as it is.
"""

from __future__ import annotations

from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, ReaderError, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from exo_gravity.bag.mcap import Announced, Batch, McapMessages
from exo_gravity.bag.storage import Storage
from exo_gravity.core.errors import DataError

SUFFIX = "_repaired"


def is_complete(path: str | Path) -> bool:
    """Return whether rosbags' own reader opens the recording. Raises DataError if there is none."""
    Storage(path)
    try:
        with Reader(path):
            return True
    except (ReaderError, OSError, AssertionError):
        return False


def repair(path: str | Path) -> tuple[Path, int]:
    """Write a complete copy of an MCAP recording; return its folder and the number of messages in it.

    Raises DataError if the recording is not MCAP, has no message, or has been repaired before.
    """
    source = Storage(path)
    other = next((file for file in source.files if file.suffix != ".mcap"), None)
    if other:
        raise DataError(f"{other}: must be an .mcap file; try `ros2 bag reindex`")
    folder = source.path.resolve().with_name(f"{source.path.resolve().stem}{SUFFIX}")
    copy = _Copy(folder)
    try:
        for file in source.files:
            with file.open("rb") as stream:
                messages = McapMessages(stream, {}, lambda topic, msgtype: bool(msgtype))
                for batch in messages.batches():
                    copy.add(batch, messages.announced[batch.topic])
        return folder, copy.close()
    except (WriterError, OSError) as error:
        raise DataError(f"{folder}: cannot write the repaired recording ({error})") from None


class _Copy:
    """The copy, which is created with its first message."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._writer: Writer | None = None
        self._connections: dict[str, Connection] = {}
        self._count = 0

    def add(self, batch: Batch, announced: Announced) -> None:
        """Write the messages of one topic."""
        if self._writer is None:
            self._writer = Writer(self._folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
        if batch.topic not in self._connections:
            self._connections[batch.topic] = self._announce(self._writer, batch.topic, announced)
        for stamp, data in zip(batch.stamps, batch.data, strict=True):
            self._writer.write(self._connections[batch.topic], stamp, data)
        self._count += len(batch.stamps)

    def _announce(self, writer: Writer, topic: str, announced: Announced) -> Connection:
        msgtype, definition, qos = announced
        if msgtype not in self._types.fielddefs:
            self._types.register(get_types_from_msg(definition, msgtype))
        return writer.add_connection(topic, msgtype, typestore=self._types, offered_qos_profiles=parse_qos(qos))

    def close(self) -> int:
        """Complete the copy, check that it can be read, and return the number of its messages."""
        if self._writer is None:
            raise DataError(f"{self._folder}: not written: the recording has no message")
        self._writer.close()
        with Reader(self._folder) as reader:
            found = sum(1 for _ in reader.messages())
        if found != self._count:
            raise DataError(f"{self._folder}: {found} messages can be read: must be {self._count}")
        return found
