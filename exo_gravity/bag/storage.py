"""Serialised messages of a rosbag2 recording, in batches: MCAP or sqlite3, complete or cut short.

A killed recorder leaves neither metadata.yaml nor an index, so neither is needed: MCAP files are read record by record,
databases row by row, up to the cut. Recordings that rosbag2 compressed by file or by message go through rosbags'
own reader, which requires complete files.

An MCAP file is a sequence of records (https://mcap.dev/spec): one byte of opcode, eight of length, the content. A
chunk's content, once decompressed, is such records again. This module extracts messages itself: the libraries drop a
chunk that is cut, and create an object for each message, while seven million must be read in seconds.
"""

from __future__ import annotations

import re
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import IO, BinaryIO, NamedTuple
from urllib.parse import quote

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from rosbags.rosbag2 import Reader, ReaderError

from exo_gravity.core.errors import DataError

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time

Wanted = Callable[[str, str], bool]  # (topic, type) -> whether to yield its messages
BATCH_SIZE = 5_000  # messages
Topic = tuple[str, str]  # name, type
Row = tuple[Topic, int, bytes]


class Batch(NamedTuple):
    """Messages of one topic: their times of arrival `stamps` in ns since 1970, and their bytes."""

    topic: str
    msgtype: str
    stamps: list[int]
    data: list[bytes]


class McapMessages:
    """The messages of one MCAP file, collected by channel.

    After reading, `cut_short` describes where the file ends too early; None for a complete file. announced: by topic,
    the definition of its type and the publishers' quality of service.
    """

    def __init__(self, stream: BinaryIO, topics: dict[str, str], wanted: Wanted) -> None:
        """Begin at the start of `stream`; topics: filled with the type of each topic. Raises DataError if not MCAP."""
        if stream.read(len(MAGIC)) != MAGIC:
            raise DataError(f"{stream.name}: not an MCAP file, or empty")
        self.cut_short: str | None = None
        self.announced: dict[str, tuple[str, str]] = {}
        self._stream = stream
        self._topics = topics
        self._wanted = wanted
        self._schemas: dict[int, Schema] = {}
        self._batches: dict[int, Batch] = {}

    def batches(self) -> Iterator[Batch]:
        """Yield the wanted messages; a batch has one topic."""
        try:
            for body in _bodies(self._stream):
                self._collect(body)
                if any(len(batch.stamps) >= BATCH_SIZE for batch in self._batches.values()):
                    yield from self._collected()
        except EOFError as error:
            self.cut_short = str(error)
        except (McapError, struct.error, ValueError):
            self.cut_short = "ends within a record, or is damaged"
        yield from self._collected()

    def _collect(self, body: bytes) -> None:
        """Read the records of a chunk, or a single one."""
        position, end = 0, len(body)
        batches, unpack = self._batches, MESSAGE.unpack_from
        while position < end:
            if body[position] == Opcode.MESSAGE:
                _, length, channel, _, stamp, _ = unpack(body, position)
                following = position + 9 + length
                if following > end:
                    raise EOFError("ends within a message")
                if channel in batches:
                    batches[channel].stamps.append(stamp)
                    batches[channel].data.append(body[position + 31 : following])
                position = following
                continue
            opcode, length = RECORD.unpack_from(body, position)
            self._describe(opcode, body[position + 9 : position + 9 + length])
            position += 9 + length

    def _collected(self) -> Iterator[Batch]:
        for channel, batch in self._batches.items():
            if batch.stamps:
                self._batches[channel] = batch._replace(stamps=[], data=[])
                yield batch

    def _describe(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(body)))
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(body)))
            schema = self._schemas.get(channel.schema_id)
            msgtype = schema.name if schema else ""
            self._topics[channel.topic] = msgtype
            definition = schema.data.decode(errors="replace") if schema else ""
            self.announced[channel.topic] = definition, channel.metadata.get("offered_qos_profiles", "")
            if self._wanted(channel.topic, msgtype) and channel.id not in self._batches:
                self._batches[channel.id] = Batch(channel.topic, msgtype, [], [])


def _bodies(stream: BinaryIO) -> Iterator[bytes]:
    """Yield the content of each chunk and each relevant record outside chunks. Raises EOFError at a cut."""
    while True:
        head = stream.read(RECORD.size)
        if len(head) < RECORD.size:
            raise EOFError("ends without an index")
        opcode, length = RECORD.unpack(head)
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        if opcode not in (Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            stream.seek(length, 1)
            continue
        record = stream.read(min(length, 2**32))
        if opcode != Opcode.CHUNK:
            yield head + record
        else:
            yield _decompressed(Chunk.read(ReadDataStream(BytesIO(record))))
        if len(record) < length:
            raise EOFError("ends within a chunk")


def _decompressed(chunk: Chunk) -> bytes:
    if not chunk.compression:
        return chunk.data
    try:
        return get_chunk_data_stream(chunk)[0].read(chunk.uncompressed_size)
    except Exception as error:  # each decompressor raises its own type
        raise EOFError(f"ends within a compressed chunk, or is damaged ({error})") from None


class Storage:
    """A recording: a rosbag2 folder, or one of its files.

    `batches` fills: `topics`, the type of each topic, wanted or not; `cut_short`, where the last file ends too early,
    None for complete files; `done`, the bytes read of `size`.
    """

    def __init__(self, path: str | Path) -> None:
        """Find the files. Raises DataError if there are none."""
        self.path = Path(path)
        self.topics: dict[str, str] = {}
        self.cut_short: str | None = None
        self.done = 0
        if not self.path.exists():
            raise DataError(f"{path}: no such file or folder")
        files = sorted(self.path.iterdir(), key=_natural) if self.path.is_dir() else [self.path]
        self.files = [file for file in files if file.suffix in (".mcap", ".db3", ".zstd")]
        if not self.files:
            raise DataError(f"{path}: must be a rosbag2 folder with an .mcap or .db3 file, or such a file")
        self.size = sum(file.stat().st_size for file in self.files)

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """Yield the messages of the `wanted` topics. Raises DataError for a file of unknown format."""
        if any(file.suffix == ".zstd" for file in self.files) or self._compressed_messages():
            yield from self._by_rosbags(wanted)
            return
        for file in self.files:
            before = self.done
            yield from self._mcap(file, wanted) if file.suffix == ".mcap" else self._sqlite(file, wanted)
            self.done = before + file.stat().st_size

    def _compressed_messages(self) -> bool:
        metadata = self.path / "metadata.yaml"
        text = metadata.read_text(encoding="utf-8") if metadata.is_file() else ""
        return re.search(r"^\s*compression_mode:\s*['\"]?message", text, re.MULTILINE | re.IGNORECASE) is not None

    def _mcap(self, file: Path, wanted: Wanted) -> Iterator[Batch]:
        before = self.done
        with file.open("rb") as stream:
            reader = McapMessages(stream, self.topics, wanted)
            for batch in reader.batches():
                self.done = before + stream.tell()
                yield batch
        if reader.cut_short:
            self.cut_short = f"{file.name} {reader.cut_short}"

    def _sqlite(self, file: Path, wanted: Wanted) -> Iterator[Batch]:
        try:
            database, topics = _open_database(file)
        except sqlite3.Error as error:
            raise DataError(f"{file}: not a rosbag2 database ({error})") from None
        self.topics.update(topics.values())
        chosen = {key: topic for key, topic in topics.items() if wanted(*topic)}
        for batch in _grouped(self._rows(database, chosen, file.name)):
            self.done += sum(map(len, batch.data))
            yield batch
        database.close()

    def _rows(self, database: sqlite3.Connection, chosen: dict[int, Topic], name: str) -> Iterator[Row]:
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({','.join('?' * len(chosen))})"
        try:
            for key, stamp, data in database.execute(query, list(chosen)):
                yield chosen[key], stamp, data
        except sqlite3.Error as error:  # the rows before the damage have been yielded
            self.cut_short = f"{name} {error}"

    def _by_rosbags(self, wanted: Wanted) -> Iterator[Batch]:
        try:
            with Reader(self.path) as reader:
                self.topics.update((c.topic, c.msgtype) for c in reader.connections)
                chosen = [c for c in reader.connections if wanted(c.topic, c.msgtype)]
                messages = reader.messages(chosen) if chosen else ()
                yield from _grouped(((c.topic, c.msgtype), stamp, bytes(data)) for c, stamp, data in messages)
        except (ReaderError, FileNotFoundError) as error:
            raise DataError(f"{self.path}: a compressed recording must be complete ({error})") from None


def _grouped(rows: Iterator[Row]) -> Iterator[Batch]:
    while part := list(islice(rows, BATCH_SIZE)):
        batches: dict[str, Batch] = {}
        for topic, stamp, data in part:
            batch = batches.get(topic[0]) or batches.setdefault(topic[0], Batch(*topic, [], []))
            batch.stamps.append(stamp)
            batch.data.append(data)
        yield from batches.values()


def _open_database(file: Path) -> tuple[sqlite3.Connection, dict[int, Topic]]:
    """Open a database in one of three ways and return it with its topics. Raises sqlite3.Error if all of them fail."""
    with tempfile.NamedTemporaryFile(suffix=file.suffix) as copy:
        # A killed recorder may leave a journal, which sqlite replays if it may write next to the file.
        for name, mode in ((file, "mode=ro"), (file, "immutable=1"), (copy.name, "immutable=1")):
            if name == copy.name:
                _copy_without_page_count(file, copy)
            database = sqlite3.connect(f"file:{quote(str(Path(name).resolve()))}?{mode}", uri=True)
            try:
                rows = database.execute("SELECT id, name, type FROM topics").fetchall()
                return database, {key: (topic, kind) for key, topic, kind in rows}
            except sqlite3.Error as error:
                database.close()
                failure = error
        raise failure


def _copy_without_page_count(file: Path, copy: IO[bytes]) -> None:
    """Copy a truncated database and invalidate the size in its header, so that sqlite uses the size of the file.

    The size is valid if the counter at byte 92 equals the one at 24 (https://www.sqlite.org/fileformat.html, 1.3.7).
    """
    with file.open("rb") as original:
        shutil.copyfileobj(original, copy)
    copy.seek(24)
    counter = copy.read(4)
    copy.seek(92)
    copy.write(bytes(byte ^ 0xFF for byte in counter))
    copy.flush()


def _natural(path: Path) -> list[int | str]:
    """Return a sort key that puts bag_2 before bag_10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]
