"""Writes rosbag2 recordings (MCAP): from serialised messages, in a separate thread, and complete copies of cut ones.

rosbags collects messages in a chunk of up to 1 MiB before it writes them. This writer closes the chunk and hands it to
the kernel every 0.5 s, so a killed process loses no more than that. The index at the end of the file and metadata.yaml
are then missing; `report` reads the chunks without them, and `report --repair` makes a complete copy. A slow disk
delays this thread only: messages that find the queue full are lost and counted. A full disk ends the recording.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, ReaderError, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.metadata import parse_qos
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from exo_gravity.bag.storage import Announced, Batch, McapMessages, Storage
from exo_gravity.core.errors import DataError

FLUSH_PERIOD = 0.5  # s
MAX_WAITING = 2_000  # batches: 100 s at 20 Hz, about 100 MB of two arms at 500 Hz
FOREVER = QosTime(9_223_372_036, 854_775_807)  # 2^63 - 1 ns, infinite in rmw

Message = tuple[str, int, bytes]  # topic, time of arrival in ns since 1970, serialised message


def offered_qos(reliable: bool, transient_local: bool, depth: int) -> Qos:
    """Return the quality of service of a publisher in the form that rosbag2 stores with each topic."""
    return Qos(
        QosHistory.KEEP_LAST,
        depth,
        QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if transient_local else QosDurability.VOLATILE,
        FOREVER,
        FOREVER,
        QosLiveliness.AUTOMATIC,
        FOREVER,
        False,
    )


class BagWriter:
    """A recording in the new folder `path`; usable as a context manager.

    Call `add_topic`, `write` and `close` from one thread; only `close` waits for the disk. `error` is what ended the
    recording early, None if nothing did. `count` messages were written, `lost` were not.
    """

    def __init__(self, path: str | Path) -> None:
        """Create the folder and its MCAP file. Raises DataError if the folder exists or can't be written."""
        self.path = Path(path)
        self.error: DataError | None = None
        self.count = self.lost = 0
        self._types = get_typestore(Stores.ROS2_JAZZY)
        try:
            self._writer = Writer(self.path, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
        except (WriterError, OSError) as error:
            raise DataError(f"{self.path}: cannot record there ({error})") from None
        self._topics: dict[str, tuple[str, Qos]] = {}
        self._connections: dict[str, Connection] = {}
        self._waiting: queue.Queue[list[Message]] = queue.Queue(MAX_WAITING)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """Announce a topic with its type ('sensor_msgs/msg/JointState') before its first message.

        Raises DataError for a type that is not in ROS 2 Jazzy's common interfaces.
        """
        if msgtype not in self._types.fielddefs:
            raise DataError(f"{topic} has type {msgtype}: must be one of ROS 2 Jazzy's common interfaces")
        self._topics[topic] = msgtype, qos

    def write(self, messages: Sequence[Message]) -> None:
        """Queue messages, in the order of their times."""
        try:
            if messages and not self.error:
                self._waiting.put_nowait(list(messages))
                return
        except queue.Full:
            pass
        self.lost += len(messages)

    def close(self) -> None:
        """Write the queued messages, the index and metadata.yaml. A failure is in `error`."""
        self._ending.set()
        self._thread.join()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        try:
            self._write_until_end()
            self._writer.close()
        except Exception as error:  # of any kind: this thread must not end without a reason
            reason = getattr(error, "strerror", None) or str(error)
            self.error = DataError(f"{self.path}: recording ended after {self.count} messages: {reason}")
            # Closing the file retries the failed write, whose error is already known.
            if isinstance(self._writer.storage, McapWriter):
                with contextlib.suppress(OSError):
                    self._writer.storage.bio.close()

    def _write_until_end(self) -> None:
        flush_at = time.monotonic() + FLUSH_PERIOD
        while not (self._ending.is_set() and self._waiting.empty()):
            self._announce()
            with contextlib.suppress(queue.Empty):
                self._take(self._waiting.get(timeout=0.05))
            if time.monotonic() >= flush_at:
                self._flush()
                flush_at = time.monotonic() + FLUSH_PERIOD
        self._announce()

    def _announce(self) -> None:
        """Add the topics that are new."""
        for topic in [topic for topic in tuple(self._topics) if topic not in self._connections]:
            msgtype, qos = self._topics[topic]
            self._connections[topic] = self._writer.add_connection(
                topic, msgtype, typestore=self._types, offered_qos_profiles=[qos]
            )

    def _take(self, messages: list[Message]) -> None:
        self._announce()
        for topic, stamp, data in messages:
            connection = self._connections.get(topic)
            if connection is None or stamp < 0:  # a bad message must not end the recording
                self.lost += 1
                continue
            self._writer.write(connection, stamp, data)
            self.count += 1

    def _flush(self) -> None:
        storage = cast(McapWriter, self._writer.storage)
        if storage.chunk.bio.tell():
            storage.close_chunk()
            storage.bio.flush()


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
