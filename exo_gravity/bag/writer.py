"""Writes a rosbag2 recording (MCAP) from serialised messages, in a thread of its own. Needs `rosbags`, not ROS.

rosbags collects messages in a chunk of up to 1 MiB before it writes them. Here the chunk under way is closed and handed
to the kernel every half second, so a process that is killed loses no more than that; the index at the end of the file
and metadata.yaml are missing then, and `report` reads the chunks without them. A slow disk delays this thread and
nobody else; a full one ends the recording.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from exo_gravity.core.errors import DataError

FLUSH_PERIOD = 0.5  # s
MAX_WAITING = 2_000  # batches: 100 s at 20 Hz, some 100 MB of two arms at 500 Hz
FOREVER = QosTime(9_223_372_036, 854_775_807)  # 2^63 - 1 ns, which rmw calls infinite

Message = tuple[str, int, bytes]  # topic, time of arrival in ns since 1970, serialised message


def offered_qos(reliable: bool, transient_local: bool, depth: int) -> Qos:
    """Return the quality of service that a publisher offers, as rosbag2 writes it beside a topic."""
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

    `add_topic`, `write` and `close` are called from one thread and do not wait for the disk, but for `close`.
    `error` says what ended the recording early, if anything did; messages are dropped from then on.
    """

    def __init__(self, path: str | Path):
        """Create the folder and its MCAP file. Raises DataError where it exists or can't be written."""
        self.path = Path(path)
        self.error: DataError | None = None
        self.count = 0
        self._types = get_typestore(Stores.ROS2_JAZZY)
        try:
            self._writer = Writer(self.path, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
        except (WriterError, OSError) as error:
            raise DataError(f"{self.path}: no recording can be made there ({error})") from None
        self._connections = {}
        self._waiting: queue.Queue = queue.Queue(MAX_WAITING)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """Announce a topic with its type ('sensor_msgs/msg/JointState') before its first message.

        Raises DataError for a type that is not among Jazzy's own.
        """
        if msgtype not in self._types.fielddefs:
            raise DataError(f"{topic} has the type {msgtype}: must be one of ROS 2 Jazzy's common interfaces")
        self._put((topic, msgtype, qos))

    def write(self, messages: Sequence[Message]) -> None:
        """Hand over messages, in the order of their times."""
        if messages:
            self._put(list(messages))

    def close(self) -> None:
        """Write what is waiting, the index and metadata.yaml. Whether that went well, `error` says."""
        self._ending.set()
        self._thread.join()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _put(self, item: tuple | list) -> None:
        if self.error:
            return
        try:
            self._waiting.put_nowait(item)
        except queue.Full:
            self.error = DataError(f"{self.path}: recording ended: the disk is too slow for it")

    def _run(self) -> None:
        try:
            self._write_until_end()
            self._writer.close()
        except (OSError, WriterError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            self.error = DataError(f"{self.path}: recording ended after {self.count} messages: {reason}")
            # Closing the file tries the failed write again: the error is known already.
            if self._writer.storage:
                with contextlib.suppress(OSError):
                    self._writer.storage.bio.close()

    def _write_until_end(self) -> None:
        flush_at = time.monotonic() + FLUSH_PERIOD
        while not (self._ending.is_set() and self._waiting.empty()):
            with contextlib.suppress(queue.Empty):
                self._take(self._waiting.get(timeout=0.05))
            if time.monotonic() >= flush_at:
                self._flush()
                flush_at = time.monotonic() + FLUSH_PERIOD

    def _take(self, item: tuple | list) -> None:
        if isinstance(item, tuple):
            topic, msgtype, qos = item
            self._connections[topic] = self._writer.add_connection(
                topic, msgtype, typestore=self._types, offered_qos_profiles=[qos]
            )
            return
        for topic, stamp, data in item:
            self._writer.write(self._connections[topic], stamp, data)
        self.count += len(item)

    def _flush(self) -> None:
        storage = self._writer.storage
        if storage.chunk.bio.tell():
            storage.close_chunk()
            storage.bio.flush()
