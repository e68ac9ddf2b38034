# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Serialised messages of a rosbag2 recording: MCAP or sqlite3, compressed or not, complete or cut short.

Files are read in their own order, which shows where the clock was set: rosbags sorts messages by time. A killed
recorder leaves neither metadata.yaml nor an index, so neither is needed. Where there is a metadata.yaml, the files that
it names are read: others beside them are copies. mcap decodes schemas, channels and chunks, but would make an object of
each message and each entry of an index, while seven million must be read in seconds: these are found here.
"""

import re
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.clock import LATEST
from exo_gravity.lab.bag.layout import HEADER, Batch, batch_of, records_at

MAGIC = b"\x89MCAP0\r\n"
ZSTD = 0x28  # with which data that zstd compressed begin; CDR begins with 0
RECORD = struct.Struct("<BQ")  # of MCAP: opcode, length of the content (https://mcap.dev/spec)
MESSAGE = int(Opcode.MESSAGE)  # a plain number is faster to compare than an enumeration
HEAD = np.dtype([  # of a message's record; the serialised message follows
    ("opcode", "u1"), ("size", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("time", "<u8"), ("sent", "<u8"),
])  # fmt: skip
LEAST = HEAD.itemsize - RECORD.size + HEADER  # bytes of a message's content; no more are damage
LARGEST = 256 * 2**20  # bytes of an MCAP record; more is damage
BLOCK = 2**20  # bytes of messages without a chunk at once
ROWS = 4_000  # messages of a database at once
ROW = int, int, bytes  # types of a message of a database
TOPICS = "SELECT id, name, type FROM topics"
MESSAGES = "SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN"
KINDS = (".mcap", ".db3")
COMPRESSED = (".zstd", ".zst")  # ends of the names of files that rosbag2, or a person, compressed
EXPECTED = (
    "a rosbag2 folder with .mcap or .db3 files, or such a file, unpacked (of ROS 1: converted by "
    "`rosbags-convert --src FILE.bag --dst FOLDER`)"
)

Wanted = Callable[[str, str], bool]  # (topic, type) -> whether to yield its messages
Topic = tuple[str, str]  # name, type


class StoredRows(NamedTuple):
    """Messages of several topics in the order of their file."""

    topics: Mapping[int, Topic]  #: by their numbers
    topic: np.ndarray  #: (n,) number of each message's topic
    batch: Batch


class Storage:
    """A recording: a rosbag2 folder, or one of its files.

    `rows` fills: `topics`, the type of each topic, wanted or not; `cut_short`, where the last file ends too early, ''
    for complete files; `damaged`, the number of parts that were left out; `notes`, sentences on files.
    """

    def __init__(self, path: str | Path) -> None:
        """Find the files. Raises DataError if there are none, or if they are of more than one recording."""
        self.path = Path(path)
        self.topics: dict[str, str] = {}
        self.cut_short = ""
        self.damaged = 0
        self.notes: list[str] = []
        self._count = 0  # of the messages so far
        check_name(path)
        if not self.path.exists():
            raise DataError(f"{path}: no such file or folder")
        here = sorted(self.path.iterdir(), key=_natural) if self.path.is_dir() else [self.path]
        files = [f for f in here if f.is_file() and (f == self.path or not f.name.startswith("."))]
        self.files = [file for file in files if kind_of(file)]
        if not self.files:
            raise DataError(f"{path}: must be {EXPECTED}")
        if self.path.is_dir():
            self.files = self._of_one_recording()

    def _of_one_recording(self) -> list[Path]:
        """Return the files that metadata.yaml names; one that was compressed stands for its name."""
        named = _named_files(self.path / "metadata.yaml")
        kept = [file for file in self.files if file.name in named] or [f for f in self.files if f.stem in named]
        if missing := [name for name in named if name not in {part for f in kept for part in (f.name, f.stem)}]:
            self.notes.append(f"metadata.yaml names {', '.join(missing)}, which is not there")
        if not kept:
            series = {re.sub(r"_\d+(?=(\.\w+){1,2}$)", "", file.name): file.name for file in self.files}
            if len(series) > 1:
                raise DataError(
                    f"{self.path}: {' and '.join(series.values())} are of different recordings, and no metadata.yaml "
                    f"says which is meant: name one of them"
                )
            return self.files
        if others := [file.name for file in self.files if file not in kept]:
            self.notes.append(f"not read, because metadata.yaml does not name it: {', '.join(others)}")
        return kept

    def rows(self, wanted: Wanted) -> Iterator[StoredRows]:
        """Yield the messages of the `wanted` topics, file by file.

        Raises DataError for a file of unknown format, and for a damaged one of which nothing can be read.
        """
        for file in self.files:
            with tempfile.TemporaryDirectory() as folder:
                content = _decompressed(file, Path(folder)) if file.suffix.lower() in COMPRESSED else file
                for topics, topic, batch in (self._mcap if kind_of(file) == ".mcap" else self._sqlite)(content, wanted):
                    if np.any(batch.data[batch.start] == ZSTD):
                        found = [_unpacked(message) for message in batch.messages()]
                        kept = np.array([len(message) > HEADER for message in found])
                        self.damaged += int(np.sum(~kept))
                        messages = [message for message in found if len(message) > HEADER]
                        topic, batch = topic[kept], batch_of(messages, batch.arrival[kept], batch.ordinal[kept])
                    if len(topic):
                        yield StoredRows(topics, topic, batch)

    def _numbered(self, arrival: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return times of arrival (n,) in ns, 0 for those that no clock shows, and the messages' numbers."""
        ordinal = np.arange(self._count, self._count + len(arrival))
        self._count += len(arrival)
        return np.where((arrival >= 0) & (arrival <= LATEST), arrival, 0).astype(np.int64), ordinal

    def _mcap(self, file: Path, wanted: Wanted) -> Iterator[StoredRows]:
        schemas = {0: Schema(id=0, name="", encoding="", data=b"")}
        chosen: dict[int, Topic] = {}  # the wanted topics by channel
        for data in self._blocks(file):
            found, at = [], 0  # where the records of messages begin
            try:
                while at < len(data):
                    opcode, length = RECORD.unpack_from(data, at)
                    begin, at = at + RECORD.size, at + RECORD.size + length
                    if opcode == MESSAGE and length > LEAST and at <= len(data):
                        found.append(begin - RECORD.size)
                    elif opcode == MESSAGE:
                        self.damaged += 1
                    elif opcode == Opcode.SCHEMA:
                        schema = Schema.read(ReadDataStream(BytesIO(data[begin:at])))
                        schemas[schema.id] = schema
                    elif opcode == Opcode.CHANNEL:
                        channel = Channel.read(ReadDataStream(BytesIO(data[begin:at])))
                        schema = schemas[channel.schema_id]
                        self.topics[channel.topic] = schema.name
                        if wanted(channel.topic, schema.name):
                            chosen[channel.id] = channel.topic, schema.name
            except Exception:  # mcap raises whatever its reading meets
                self.damaged += 1
            if found and chosen:
                buffer, start = np.frombuffer(data, np.uint8), np.array(found)
                head = records_at(buffer, start, HEAD.itemsize).view(HEAD)[:, 0]
                is_chosen = np.isin(head["channel"], [*chosen])
                start, head = start[is_chosen] + HEAD.itemsize, head[is_chosen]
                size = head["size"].astype(np.int64) - (HEAD.itemsize - RECORD.size)
                yield StoredRows(chosen, head["channel"], Batch(buffer, start, size, *self._numbered(head["time"])))

    def _blocks(self, file: Path) -> Iterator[bytes]:
        """Yield the records of an MCAP file, chunk by chunk, up to the end of its data, a cut or damage."""
        loose = bytearray()  # records without a chunk
        with file.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise DataError(f"{file}: not an MCAP file, or empty: must be {EXPECTED}")
            while len(head := stream.read(RECORD.size)) == RECORD.size:
                opcode, length = RECORD.unpack(head)
                content = stream.read(min(length, LARGEST))
                if len(content) < length or opcode == Opcode.DATA_END:
                    break
                if opcode in (MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                    loose += head + content
                if opcode == Opcode.CHUNK or len(loose) > BLOCK:
                    yield bytes(loose)
                    loose.clear()
                if opcode == Opcode.CHUNK:
                    yield self._content(content)
        yield bytes(loose)
        if len(head) < RECORD.size or opcode != Opcode.DATA_END:
            self.cut_short = f"{file.name} ends without an index, or is damaged"

    def _content(self, chunk: bytes) -> bytes:
        """Return the records in a chunk, none if it is damaged."""
        try:
            content, size = get_chunk_data_stream(Chunk.read(ReadDataStream(BytesIO(chunk))), validate_crc=True)
            return content.read(size)
        except Exception:  # mcap and each decompressor raise their own types
            self.damaged += 1
            return b""

    def _sqlite(self, file: Path, wanted: Wanted) -> Iterator[StoredRows]:
        with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
            try:
                database = stack.enter_context(closing(_opened(file, Path(folder))))
                topics = {key: (str(topic), str(kind)) for key, topic, kind in database.execute(TOPICS)}
                chosen = {key: topic for key, topic in topics.items() if wanted(*topic)}
                cursor = database.execute(f"{MESSAGES} ({','.join('?' * len(chosen))})", list(chosen))
            except (sqlite3.Error, OSError, UnicodeDecodeError) as error:
                reason = " ".join(str(error).split())  # it may quote several lines of a damaged file
                way = f"copy {file.name}-wal, too, if there is one, or recover it by `sqlite3 {file.name} .recover`"
                raise DataError(f"{file}: not a rosbag2 database, or damaged ({reason}): {way}") from None
            self.topics.update(topics.values())
            try:
                while found := cursor.fetchmany(ROWS):
                    whole = [row for row in found if tuple(map(type, row)) == ROW and len(row[2]) > HEADER]
                    self.damaged += len(found) - len(whole)
                    if whole:
                        topic, arrival, messages = zip(*whole, strict=True)
                        batch = batch_of(messages, *self._numbered(np.array(arrival)))
                        yield StoredRows(chosen, np.array(topic), batch)
            except sqlite3.Error:  # the rows before the damage are kept
                self.cut_short = f"{file.name} is cut or damaged"


def _opened(file: Path, folder: Path) -> sqlite3.Connection:
    """Return a database.

    A write-ahead log beside the file belongs to it. Where sqlite may not write, on a read-only medium, it reads both as
    copies in `folder`.
    """
    database = sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True)
    with suppress(sqlite3.Error, UnicodeDecodeError):
        database.execute("SELECT topic_id FROM messages LIMIT 1").fetchall()
        return database
    database.close()
    for end in ("", "-wal"):
        if (part := file.with_name(f"{file.name}{end}")).exists():
            shutil.copyfile(part, folder / f"copy.db3{end}")
    return sqlite3.connect(folder / "copy.db3")


def _unpacked(message: bytes) -> bytes:
    """Return a message, decompressed if rosbag2 compressed it; nothing of a damaged one."""
    try:
        return zstandard.decompress(message) if message[0] == ZSTD else message
    except (zstandard.ZstdError, MemoryError):
        return b""


def _decompressed(file: Path, folder: Path) -> Path:
    """Return a copy in `folder` of a file that was compressed, up to where it ends. Raises DataError for damage."""
    content = folder / file.stem
    try:
        with file.open("rb") as source, content.open("wb") as target:
            zstandard.ZstdDecompressor().copy_stream(source, target)
    except zstandard.ZstdError as error:
        raise DataError(f"{file}: the compressed file is damaged ({error}): copy it again") from None
    return content


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
        content = yaml.safe_load(metadata.read_text(encoding="utf-8"))
        return [Path(path).name for path in content["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (OSError, ValueError, yaml.YAMLError, LookupError, TypeError, RecursionError):
        return []


def _natural(path: Path) -> list[int | str]:
    """Return a sort key that puts bag_2 before bag_10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]
