# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Serialised messages of a rosbag2 recording: MCAP or sqlite3, compressed or not, complete or cut short.

A killed recorder leaves neither metadata.yaml nor an index, so neither is needed: MCAP files are read record by record,
databases row by row, up to the cut. Where there is a metadata.yaml, the files that it names are read: others beside
them are copies.

An MCAP file is a sequence of records (https://mcap.dev/spec): one byte of opcode, eight of length, the content. A
chunk's content, once decompressed, is such records again. This module extracts messages itself: the libraries drop a
chunk that is cut, and create an object for each message, while seven million must be read in seconds.
"""

import mmap
import re
import shutil
import sqlite3
import struct
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import lz4.frame
import numpy as np
import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.clock import LATEST, SECOND
from exo_gravity.lab.bag.layout import Batch, records_at

MAGIC = b"\x89MCAP0\r\n"
ROS_1_MAGIC = b"#ROSBAG"
ZSTD = b"\x28\xb5\x2f\xfd"  # with which zstd's data begin; CDR begins with 0
WRITE_AHEAD = b"\x02\x02"  # at byte 18 of a database whose newest data are in a second file
MESSAGE_OPCODE = int(Opcode.MESSAGE)  # a plain number is faster to compare than an enumeration
RECORD = struct.Struct("<BQ")  # opcode, length of the content
LAYOUT: Any = {
    "names": ["size", "channel", "time"], "formats": ["<u8", "<u2", "<u8"], "offsets": [1, 9, 15], "itemsize": 31,
}  # fmt: skip
HEAD = np.dtype(LAYOUT)  # of a message's record; the serialised message follows
LEAST = HEAD.itemsize - RECORD.size  # bytes of a message's content; fewer are damage
LARGEST = 256 * 2**20  # bytes of a chunk or message; more is damage
ROWS = 20_000  # messages in a batch, at most
KEPT_BATCHES = 16  # of an MCAP file, in memory at once: to release each costs more time
CACHED_ROWS = 4_000  # of a database, at once: more leave the processor's cache before they are put together
BLOCK = 2**20  # bytes that are decompressed at once
KINDS = (".mcap", ".db3")
COMPRESSED = (".zstd", ".zst")  # ends of the names of files that rosbag2, or a person, compressed
ROS_1 = "is a ROS 1 recording: convert it with `rosbags-convert --src FILE.bag --dst FOLDER`"
OTHERS = {  # what is said of other files, by the ends of their names
    ".bag": ROS_1,
    ".yaml": "must be the folder of the recording, with its .mcap or .db3 files",
    **dict.fromkeys((".gz", ".bz2", ".xz", ".lz4", ".zip", ".tar", ".tgz", ".7z"), "is packed: unpack it first"),
}
REPAIRED = "_repaired"  # with which the names of complete copies end

Wanted = Callable[[str, str], bool]  # (topic, type) -> whether to yield its messages
Topic = tuple[str, str]  # name, type
Message = tuple[str, str, int, bytes]  # topic, type, time of arrival in ns since 1970, serialised message


class StoredRows(NamedTuple):
    """Messages of several topics in the order of their file."""

    topics: Mapping[int, Topic]  #: by their numbers
    topic: np.ndarray  #: (n,) number of each message's topic
    batch: Batch

    def by_topic(self) -> Iterator[tuple[Topic, np.ndarray, Batch]]:
        """Yield each topic, which rows are its messages (m,), and these messages."""
        for number in dict.fromkeys(self.topic.tolist()):
            chosen = np.flatnonzero(self.topic == number)
            yield self.topics[number], chosen, self.batch.of(chosen)


class Storage:
    """A recording: a rosbag2 folder, or one of its files.

    `rows` and `messages` fill: `topics`, the type of each topic, wanted or not; `announced`, by topic of an MCAP file,
    the definition of its type and the publishers' quality of service; `cut_short`, where the last file ends too early,
    None for complete files; `damaged`, the number of parts that were left out; `notes`, sentences on files.
    """

    def __init__(self, path: str | Path) -> None:
        """Find the files. Raises DataError if there are none."""
        self.path = Path(path)
        self.topics: dict[str, str] = {}
        self.announced: dict[str, tuple[str, str]] = {}
        self.cut_short: str | None = None
        self.damaged = 0
        self.notes: list[str] = []
        check_name(path)
        if not self.path.exists():
            raise DataError(f"{path}: no such file or folder")
        here = sorted(self.path.iterdir(), key=_natural) if self.path.is_dir() else [self.path]
        files = [f for f in here if f.is_file() and (f == self.path or not f.name.startswith("."))]
        self.files = [file for file in files if kind_of(file)]
        if not self.files:
            others = (OTHERS[file.suffix.lower()] for file in files if file.suffix.lower() in OTHERS)
            expected = next(others, "must be a rosbag2 folder with an .mcap or .db3 file, or such a file")
            raise DataError(f"{path}: {expected}")
        named = _named_files(self.path / "metadata.yaml") if self.path.is_dir() else []
        self.is_listed = bool(named)  # by metadata.yaml, or is the file that was asked for
        if named:
            self._keep(named)

    def _keep(self, named: Sequence[str]) -> None:
        """Keep the files that metadata.yaml names; one that was compressed stands for its name."""
        found = {file.name: file for file in self.files}
        forms = ("", *COMPRESSED)
        chosen = [next((found[name + end] for end in forms if name + end in found), None) for name in named]
        if missing := [name for name, file in zip(named, chosen, strict=True) if file is None]:
            self.notes.append(f"metadata.yaml names {', '.join(missing)}, which is not there")
        if kept := [file for file in chosen if file]:
            if others := [file.name for file in self.files if file not in kept]:
                self.notes.append(f"not read, because metadata.yaml does not name it: {', '.join(others)}")
            self.files = kept
        else:
            self.is_listed = False

    def messages(self, wanted: Wanted) -> Iterator[Message]:
        """Yield the messages of the `wanted` topics one by one; see `rows`."""
        for rows in self.rows(wanted):
            arrivals = rows.batch.arrival.tolist()
            for number, stamp, data in zip(rows.topic.tolist(), arrivals, rows.batch.messages(), strict=True):
                yield *rows.topics[number], stamp, data

    def rows(self, wanted: Wanted) -> Iterator[StoredRows]:
        """Yield the messages of the `wanted` topics, file by file.

        Raises DataError for a file of unknown format, for one that is compressed and cut or damaged, and where two
        files hold the same time and no metadata.yaml says which belong to the recording.
        """
        spans: list[tuple[Path, int, int]] = []
        for file in self.files:
            low, high = LATEST, 0
            for rows in self._of_file(file, wanted):
                low, high = min(low, int(rows.batch.arrival[0])), max(high, int(rows.batch.arrival[-1]))
                is_twice = (f for f, begin, end in spans if low < end - SECOND and begin < high - SECOND)
                if not self.is_listed and (other := next(is_twice, None)):
                    raise DataError(
                        f"{self.path}: {other.name} and {file.name} hold the same time, and no metadata.yaml says "
                        f"which belongs to the recording: name one of them"
                    )
                yield rows
            spans.append((file, low, high))

    def _of_file(self, file: Path, wanted: Wanted) -> Iterator[StoredRows]:
        with ExitStack() as stack:
            content = file
            if file.suffix.lower() in COMPRESSED:
                content = Path(stack.enter_context(tempfile.TemporaryDirectory()), file.stem)
                _decompress_file(file, content)
            read = self._mcap if kind_of(file) == ".mcap" else self._sqlite
            for rows in read(content, wanted):
                if decompressed := self._decompressed(rows):
                    yield decompressed

    def _decompressed(self, rows: StoredRows) -> StoredRows | None:
        """Return rows whose messages are not compressed; None without any."""
        topics, topic, batch = rows
        whole = (batch.length > len(ZSTD)) & (batch.start + batch.length <= len(batch.data))
        self.damaged += int(np.sum(~whole))
        if not whole.all():
            topic, batch = topic[whole], batch.of(whole)
        if not len(topic):
            return None
        if not np.any(batch.data[batch.start] == ZSTD[0]):
            return StoredRows(topics, topic, batch)
        messages, kept = [], []
        for index, message in enumerate(batch.messages()):
            try:
                messages.append(_unpacked("zstd", message, None) if message.startswith(ZSTD) else message)
                kept.append(index)
            except (zstandard.ZstdError, ValueError):
                self.damaged += 1
        if not kept:
            return None
        return StoredRows(topics, topic[kept], _batch(messages, batch.arrival[kept]))

    def _mcap(self, file: Path, wanted: Wanted) -> Iterator[StoredRows]:
        with file.open("rb") as stream:
            if (first := stream.read(len(MAGIC))) != MAGIC:
                is_ros_1 = first.startswith(ROS_1_MAGIC)
                raise DataError(f"{file}: {ROS_1 if is_ros_1 else 'not an MCAP file, or empty'}")
            data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        reading = _McapFile(self, wanted)
        for number, rows in enumerate(reading.rows(data, len(MAGIC)), 1):
            yield rows
            if number % KEPT_BATCHES == 0 and sys.platform != "win32":
                with suppress(OSError):  # of a process whose memory is locked
                    data.madvise(mmap.MADV_DONTNEED)  # else the whole file counts as memory of this process
        if not reading.is_complete:
            where = "without an index" if reading.at == len(data) else "within a record, or is damaged"
            self.cut_short = f"{file.name} ends {where}"

    def _sqlite(self, file: Path, wanted: Wanted) -> Iterator[StoredRows]:
        with ExitStack() as stack:
            try:
                database, topics = _open_database(file, stack)
            except (sqlite3.Error, OSError) as error:
                why = _why_unread(file) or f"not a rosbag2 database ({_one_line(error)})"
                raise DataError(f"{file}: {why}") from None
            self.topics.update(topics.values())
            chosen = {key: topic for key, topic in topics.items() if wanted(*topic)}
            query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({','.join('?' * len(chosen))})"
            found: list[tuple[Any, Any, Any]] = []
            try:
                cursor = database.execute(query, list(chosen))
                while True:
                    found.extend(islice(cursor, CACHED_ROWS))  # fetchmany would lose the rows before the damage
                    if not found:
                        return
                    yield from self._whole(found, chosen)
                    found = []
            except (sqlite3.Error, UnicodeDecodeError) as error:  # the rows before the damage are kept
                self.cut_short = f"{file.name} {_one_line(error)}"
            yield from self._whole(found, chosen)

    def _whole(self, found: Sequence[tuple[Any, Any, Any]], chosen: Mapping[int, Topic]) -> Iterator[StoredRows]:
        """Yield rows of a database without those that are damaged, which have values of other types."""
        if not found:
            return
        numbers, stamps, data = zip(*found, strict=True)
        if {*map(type, numbers), *map(type, stamps)} != {int} or {*map(type, data)} != {bytes}:
            whole = [row for row in found if type(row[0]) is type(row[1]) is int and type(row[2]) is bytes]
            self.damaged += len(found) - len(whole)
            yield from self._whole(whole, chosen)
            return
        yield StoredRows(chosen, np.array(numbers), _batch(data, np.array(stamps, np.int64)))


class _McapFile:
    """Reads the records of an MCAP file: `at` is where it is, and `is_complete` whether it met the end of the data."""

    def __init__(self, storage: Storage, wanted: Wanted) -> None:
        self.storage, self.wanted = storage, wanted
        self.schemas: dict[int, Schema] = {}
        self.chosen: dict[int, Topic] = {}  # the wanted topics by channel
        self.at, self.is_complete = 0, False

    def rows(self, data: bytes | mmap.mmap, at: int) -> Iterator[StoredRows]:
        """Yield the messages among the records from `at` on, also those in chunks, up to a cut or damage."""
        end, size, unpack, buffer = len(data), RECORD.size, RECORD.unpack_from, np.frombuffer(data, np.uint8)
        found: list[int] = []  # where records of messages begin
        while at + size <= end:
            opcode, length = unpack(data, at)
            begin, after = at + size, at + size + length
            if after > end:
                if opcode == Opcode.CHUNK and (content := _of_cut_chunk(bytes(data[begin:]))):
                    yield from self._messages(buffer, found)
                    yield from self.rows(content, 0)
                break
            if opcode == MESSAGE_OPCODE and length >= LEAST:  # nothing else is done for each message
                found.append(at)
                at = after
                if len(found) == ROWS:
                    yield from self._messages(buffer, found)
                continue
            at = after
            if opcode == Opcode.CHUNK:
                yield from self._messages(buffer, found)
                if content := self._chunk(bytes(data[begin:after])):
                    yield from self.rows(content, 0)
                    if self.at < len(content):
                        self.storage.damaged += 1
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                yield from self._messages(buffer, found)
                self._describe(opcode, bytes(data[begin:after]))
            elif opcode == Opcode.DATA_END:
                self.is_complete = True
                break
            elif opcode == MESSAGE_OPCODE:
                self.storage.damaged += 1
        yield from self._messages(buffer, found)
        self.at = at

    def _messages(self, data: np.ndarray, found: list[int]) -> Iterator[StoredRows]:
        """Yield the messages of the chosen topics whose records begin at `found` in data, and empty that list."""
        if not found:
            return
        start = np.array(found)
        found.clear()
        head = records_at(data, start, HEAD)
        chosen = np.isin(head["channel"], np.array([*self.chosen], np.uint16))
        if chosen.any():
            start, head = start[chosen], head[chosen]
            batch = Batch(data, start + HEAD.itemsize, head["size"].astype(np.int64) - LEAST, plausible(head["time"]))
            yield StoredRows(self.chosen, head["channel"].astype(np.int64), batch)

    def _chunk(self, record: bytes) -> bytes | None:
        """Return the records in a chunk; None if it is damaged, and counted."""
        try:
            chunk = Chunk.read(ReadDataStream(BytesIO(record)))
            content = _unpacked(chunk.compression, chunk.data, chunk.uncompressed_size)
            if chunk.uncompressed_crc in (0, crc32(content)):
                return content
        except Exception:  # each decompressor raises its own type
            pass
        self.storage.damaged += 1
        return None

    def _describe(self, opcode: int, record: bytes) -> None:
        """Take in a schema or a channel; a damaged one is counted."""
        body = ReadDataStream(BytesIO(record))
        try:
            if opcode == Opcode.SCHEMA:
                described = Schema.read(body)
                self.schemas[described.id] = described
                return
            channel = Channel.read(body)
        except Exception:  # mcap raises whatever its reading meets
            self.storage.damaged += 1
            return
        schema = self.schemas.get(channel.schema_id)
        msgtype, definition = (schema.name, schema.data.decode(errors="replace")) if schema else ("", "")
        self.storage.topics[channel.topic] = msgtype
        self.storage.announced[channel.topic] = definition, channel.metadata.get("offered_qos_profiles", "")
        if self.wanted(channel.topic, msgtype):
            self.chosen[channel.id] = channel.topic, msgtype


def _of_cut_chunk(record: bytes) -> bytes | None:
    """Return the records in the first part of a chunk, unless it is compressed."""
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(record)))
    except Exception:  # mcap raises whatever its reading meets
        return None
    return None if chunk.compression else chunk.data


def plausible(stamps: np.ndarray) -> np.ndarray:
    """Return times of arrival (n,) in ns as int64, 0 for those that no clock shows."""
    return np.where((stamps >= 0) & (stamps <= LATEST), stamps, 0).astype(np.int64)


def _batch(messages: Iterable[bytes], arrival: np.ndarray) -> Batch:
    messages = list(messages)
    length = np.fromiter(map(len, messages), np.int64, len(messages))
    data = np.frombuffer(b"".join(messages), np.uint8)
    return Batch(data, np.cumsum(length) - length, length, plausible(arrival))


def _unpacked(compression: str, data: bytes, size: int | None) -> bytes:
    """Return decompressed bytes, of which there are `size` unless None.

    Raises ValueError, or what the decompressor raises.
    """
    most = LARGEST if size is None else size
    if most > LARGEST:
        raise ValueError
    if not compression:
        content = data
    elif compression == "zstd":
        # A reader takes no more memory than it gives, whatever a damaged header claims.
        reader = zstandard.ZstdDecompressor(max_window_size=LARGEST // 2).stream_reader(data)
        content = reader.read(most + 1) if size is not None else b"".join(_blocks(reader, LARGEST))
    elif compression == "lz4":
        content = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most + 1)
    else:
        raise ValueError
    if size is not None and len(content) != size:
        raise ValueError
    return content


def _blocks(reader: Any, most: int) -> Iterator[bytes]:
    """Yield what a reader gives, up to `most` bytes. Raises ValueError beyond."""
    taken = 0
    while block := reader.read(BLOCK):
        taken += len(block)
        if taken > most:
            raise ValueError
        yield block


def _decompress_file(file: Path, content: Path) -> None:
    """Decompress a file that rosbag2 compressed. Raises DataError if it is cut or damaged."""
    decompressor = zstandard.ZstdDecompressor().decompressobj()
    try:
        with file.open("rb") as source, content.open("wb") as target:
            while block := source.read(BLOCK):
                target.write(decompressor.decompress(block))
                if decompressor.eof:
                    break
        if decompressor.eof:
            return
        reason = "it ends too early"
    except zstandard.ZstdError as error:
        reason = str(error)
    raise DataError(f"{file}: the compressed file is cut or damaged ({reason}): copy it again")


def kind_of(file: Path) -> str:
    """Return how the name of a recording's file ends, ".mcap" or ".db3", compressed or not; "" of any other file."""
    name = file.with_suffix("") if file.suffix.lower() in COMPRESSED else file
    return name.suffix.lower() if name.suffix.lower() in KINDS else ""


def check_name(path: str | Path) -> None:
    """Raise DataError unless the name of a recording is UTF-8, as are the reports that show it."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise DataError(f"{str(path)!a}: its name must be UTF-8: rename it") from None


def _named_files(metadata: Path) -> list[str]:
    """Return the names of the files of a recording, of any version of metadata.yaml; [] if it is not readable."""
    try:
        paths = yaml.safe_load(metadata.read_text(encoding="utf-8"))["rosbag2_bagfile_information"][
            "relative_file_paths"
        ]
        return [Path(path).name for path in paths]
    except (OSError, ValueError, yaml.YAMLError, LookupError, TypeError, RecursionError):
        return []


def _open_database(file: Path, stack: ExitStack) -> tuple[sqlite3.Connection, dict[int, Topic]]:
    """Return a database, or a readable copy of it, and its topics; `stack` closes them. Raises sqlite3.Error.

    A write-ahead log beside the file belongs to it: where sqlite may not write, on a read-only medium, it reads both as
    copies. A killed recorder may leave a journal, which sqlite replays if it may write next to the file; the copy has
    none. If the file is truncated, the size in its header is wrong. The copy's is made invalid, so that sqlite uses the
    size of the file: it counts if the counter at byte 92 equals the one at 24
    (https://www.sqlite.org/fileformat.html, 1.3.7).
    """
    try:
        return _connected(f"{file.resolve().as_uri()}?mode=ro", stack)
    except sqlite3.Error:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        copy = Path(shutil.copyfile(file, folder / "copy.db3"))
    if (log := file.with_name(f"{file.name}-wal")).exists():
        with_log = Path(shutil.copyfile(file, folder / "with_log.db3"))
        shutil.copyfile(log, folder / "with_log.db3-wal")
        with suppress(sqlite3.Error):
            return _connected(f"{with_log.as_uri()}?mode=rw", stack)
    with copy.open("r+b") as changed:
        changed.seek(24)
        counter = changed.read(4)
        changed.seek(92)
        changed.write(bytes(byte ^ 0xFF for byte in counter))
    return _connected(f"{copy.as_uri()}?immutable=1", stack)


def _connected(uri: str, stack: ExitStack) -> tuple[sqlite3.Connection, dict[int, Topic]]:
    database = sqlite3.connect(uri, uri=True)
    try:
        database.text_factory = lambda data: data.decode(errors="replace")
        rows = database.execute("SELECT id, name, type FROM topics").fetchall()
        database.execute("SELECT topic_id, timestamp, data FROM messages LIMIT 1").fetchall()
    except UnicodeDecodeError as error:  # sqlite3 decodes its messages, which name what is damaged
        database.close()
        raise sqlite3.DatabaseError(str(error)) from None
    except sqlite3.Error:
        database.close()
        raise
    stack.callback(database.close)
    return database, {key: (str(topic), str(kind)) for key, topic, kind in rows}


def _why_unread(file: Path) -> str:
    """Return what a database lacks that was copied by itself; '' if that does not show."""
    with suppress(OSError), file.open("rb") as data:
        header = data.read(100)
        if not header:
            return "the file is empty"
        log = file.with_name(f"{file.name}-wal")  # sqlite itself may have made an empty one
        if header[18:20] == WRITE_AHEAD and not (log.exists() and log.stat().st_size):
            return f"its data are in its write-ahead log: copy {file.name}-wal, too"
    return ""


def _one_line(error: Exception) -> str:
    """Return the text of an error, which may quote several lines of a damaged file."""
    return " ".join(str(error).split())


def _natural(path: Path) -> list[int | str]:
    """Return a sort key that puts bag_2 before bag_10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]
