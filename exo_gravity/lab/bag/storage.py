# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Serialised messages of a rosbag2 recording: MCAP or sqlite3, compressed or not, complete or cut short.

Files are read in their own order, which shows where the clock was set: rosbags sorts messages by time. A killed
recorder leaves neither metadata.yaml nor an index, so neither is needed. Where there is a metadata.yaml, the files that
it names are read: others beside them are copies. mcap reads the records of a file, but would make an object of each
message in a chunk, while seven million must be read in seconds: these are found here.
"""

import re
import shutil
import sqlite3
import struct
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from io import BytesIO
from pathlib import Path

import numpy as np
import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.clock import LATEST
from exo_gravity.lab.bag.layout import HEADER, Messages

MAGIC = b"\x89MCAP0\r\n"
ZSTD = b"\x28"  # with which data that zstd compressed begin; CDR begins with 0
RECORD = struct.Struct("<BQ")  # of MCAP: opcode, length of the content (https://mcap.dev/spec)
HEAD = struct.Struct("<BQHIQQ")  # of a message: the same, channel, sequence, time, time of sending; the message follows
MESSAGE = int(Opcode.MESSAGE)  # a plain number is faster to compare than an enumeration
LARGEST = 256 * 2**20  # bytes of an MCAP record; more is damage
BLOCK = 4_000  # messages at once
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
        self._found = defaultdict[Topic, list[tuple[int, int, bytes]]](list)  # number, time of arrival in ns, message
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

    def rows(self, wanted: Wanted) -> Iterator[Messages]:
        """Yield the messages of the `wanted` topics, file by file, those of a topic together.

        Raises DataError for a file of unknown format, and for a damaged one of which nothing can be read.
        """
        for file in self.files:
            with tempfile.TemporaryDirectory() as folder:
                content = _decompressed(file, Path(folder)) if file.suffix.lower() in COMPRESSED else file
                for _ in (self._mcap if kind_of(file) == ".mcap" else self._sqlite)(content, wanted):
                    for topic, found in self._found.items():
                        ordinal, arrival, messages = zip(*found, strict=True)
                        times = np.array(arrival)
                        known = np.where((times >= 0) & (times <= LATEST), times, 0).astype(np.int64)
                        yield Messages(*topic, np.array(ordinal), known, messages)
                    self._found.clear()

    def _take(self, topic: Topic, arrival: int, message: bytes) -> None:
        """Add a message that arrived at `arrival` ns."""
        self._count += 1
        if message[:1] == ZSTD:
            message = _unpacked(message)
        if len(message) > HEADER:
            self._found[topic].append((self._count, arrival, message))
        else:
            self.damaged += 1

    def _mcap(self, file: Path, wanted: Wanted) -> Iterator[None]:
        """Take the messages of an MCAP file up to the end of its data or a cut; yield after each chunk."""
        schemas, chosen = {0: ""}, dict[int, Topic]()  # the wanted topics by channel

        def take(data: bytes) -> None:
            """Take each of the records in data, which may be a chunk of others."""
            at = 0
            while at < len(data):
                opcode, length = RECORD.unpack_from(data, at)
                begin, at = at, at + RECORD.size + length
                if opcode == MESSAGE:
                    _, _, channel, _, arrival, _ = HEAD.unpack_from(data, begin)
                    if channel in chosen:
                        self._take(chosen[channel], arrival, data[begin + HEAD.size : at])
                    continue
                content = ReadDataStream(BytesIO(data[begin + RECORD.size : at]))
                if opcode == Opcode.CHUNK:
                    stream, size = get_chunk_data_stream(Chunk.read(content), validate_crc=True)
                    take(stream.read(size))
                elif opcode == Opcode.SCHEMA:
                    schema = Schema.read(content)
                    schemas[schema.id] = schema.name
                elif opcode == Opcode.CHANNEL:
                    channel = Channel.read(content)
                    topic = channel.topic, schemas[channel.schema_id]
                    self.topics.update([topic])
                    if wanted(*topic):
                        chosen[channel.id] = topic

        with file.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise DataError(f"{file}: not an MCAP file, or empty: must be {EXPECTED}")
            while len(head := stream.read(RECORD.size)) == RECORD.size:
                opcode, length = RECORD.unpack(head)
                content = stream.read(min(length, LARGEST))
                if len(content) < length or opcode == Opcode.DATA_END:
                    break
                try:
                    take(head + content)
                except Exception:  # mcap and each decompressor raise their own types
                    self.damaged += 1
                if opcode == Opcode.CHUNK or self._count % BLOCK == 0:
                    yield
        yield
        if len(head) < RECORD.size or opcode != Opcode.DATA_END:
            self.cut_short = f"{file.name} ends without an index, or is damaged"

    def _sqlite(self, file: Path, wanted: Wanted) -> Iterator[None]:
        """Take the messages of a database; yield now and then."""
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
                while rows := cursor.fetchmany(BLOCK):
                    for topic, arrival, message in rows:
                        if isinstance(arrival, int) and isinstance(message, bytes):
                            self._take(chosen[topic], arrival, message)
                        else:
                            self.damaged += 1
                    yield
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
    """Return a message that rosbag2 compressed; nothing of a damaged one."""
    try:
        return zstandard.decompress(message)
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
