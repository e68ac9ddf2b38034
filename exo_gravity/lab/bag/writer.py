# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Writes rosbag2 recordings (MCAP) from serialised messages, in a separate thread.

rosbags collects messages in a chunk of up to 1 MiB before it writes them. This writer closes the chunk and hands it to
the kernel every 0.5 s, so a killed process loses no more than that. The index at the end of the file and metadata.yaml
are then missing; `report` reads the chunks without them. A slow disk delays this thread only: messages that find the
queue full are lost and counted. A full disk ends the recording.
"""

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import cast

from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.typesys import Stores, get_typestore

from exo_gravity.core.errors import DataError

FLUSH_PERIOD = 0.5  # s
MAX_WAITING = 2_000  # batches: 100 s at 20 Hz, about 100 MB of two arms at 500 Hz
FOREVER = QosTime(9_223_372_036, 854_775_807)  # 2^63 - 1 ns, infinite in rmw

Message = tuple[str, int, bytes]  # topic, time of arrival in ns since 1970, serialised message


def offered_qos(reliable: bool, transient_local: bool, depth: int) -> Qos:
    """Return the quality of service of a publisher in the form that rosbag2 stores with each topic."""
    reliability = QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT
    durability = QosDurability.TRANSIENT_LOCAL if transient_local else QosDurability.VOLATILE
    automatic = QosLiveliness.AUTOMATIC
    return Qos(QosHistory.KEEP_LAST, depth, reliability, durability, FOREVER, FOREVER, automatic, FOREVER, False)


class BagWriter:
    """A recording in the new folder `path`.

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
        self._storage = cast(McapWriter, self._writer.storage)
        self._connections: dict[str, Connection] = {}
        self._waiting: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()  # what the thread has to do
        self._is_open = True
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """Announce a topic with its type ('sensor_msgs/msg/JointState') before its first message.

        Raises DataError for a type that is not in ROS 2 Jazzy's common interfaces.
        """
        if msgtype not in self._types.fielddefs:
            raise DataError(f"{topic} has type {msgtype}: must be one of ROS 2 Jazzy's common interfaces")
        self._waiting.put(partial(self._announce, topic, msgtype, qos))

    def write(self, messages: Sequence[Message]) -> None:
        """Queue messages, in the order of their times."""
        if self.error or self._waiting.qsize() >= MAX_WAITING:
            self.lost += len(messages)
        elif messages:
            self._waiting.put(partial(self._take, list(messages)))

    def close(self) -> None:
        """Write the queued messages, the index and metadata.yaml. A failure is in `error`."""
        self._waiting.put(self._finish)
        self._thread.join()

    def _run(self) -> None:
        flush_at = time.monotonic() + FLUSH_PERIOD
        try:
            while self._is_open:
                if time.monotonic() >= flush_at:
                    flush_at = time.monotonic() + FLUSH_PERIOD
                    if self._storage.chunk.bio.tell():
                        self._storage.close_chunk()
                        self._storage.bio.flush()
                with contextlib.suppress(queue.Empty):
                    self._waiting.get(timeout=0.05)()
        except Exception as error:  # of any kind: this thread must not end without a reason
            reason = getattr(error, "strerror", None) or str(error)
            self.error = DataError(f"{self.path}: recording ended after {self.count} messages: {reason}")
            with contextlib.suppress(OSError):  # closing the file tries the failed write again
                self._storage.bio.close()

    def _announce(self, topic: str, msgtype: str, qos: Qos) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, msgtype, typestore=self._types, offered_qos_profiles=[qos]
            )

    def _take(self, messages: list[Message]) -> None:
        for topic, stamp, data in messages:
            connection = self._connections.get(topic)
            if connection is None or stamp < 0:  # a bad message must not end the recording
                self.lost += 1
                continue
            self._writer.write(connection, stamp, data)
            self.count += 1

    def _finish(self) -> None:
        self._is_open = False
        self._writer.close()
