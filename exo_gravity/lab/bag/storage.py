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
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.content import JOINT_STATE

TYPES = get_typestore(Stores.ROS2_JAZZY)
FIELDS = ("position", "velocity", "effort")  # of a joint state
LATEST = 2**62  # ns since 1970, in the year 2116; a later time is damage
HEADER = 4  # bytes; alignment counts from their end


class Messages(NamedTuple):
    """Messages of one topic in the order of their file."""

    topic: str
    msgtype: str
    ordinal: np.ndarray  #: (n,) their numbers among all messages of the recording
    arrival: np.ndarray  #: (n,) ns since 1970, 0 where no clock shows it
    data: Sequence[bytes]  #: (n,) each more than a header


class Layout(NamedTuple):
    """Where the numbers lie in messages of one length.

    CDR (OMG DDS-XTYPES 7.4.3, plain CDR version 1): a header of four bytes, the second of which is 1 for little-endian;
    then the fields in order. A number is aligned to its size, a string is its length and its bytes with a final 0, a
    sequence its length and its items. All messages of one publisher have the same length and the same texts. So the
    first one gives the offsets of the numbers, and NumPy extracts them from all messages whose lengths and texts are
    equal.
    """

    numbers: np.dtype[np.void]  #: by their paths, such as 'header.stamp.sec'
    texts: dict[str, tuple[str, ...]]  #: by their paths
    where: np.ndarray  #: (k,) the bytes that messages of this layout share: header, lengths and texts
    shared: np.ndarray  #: (k,) these bytes


class _Walk:
    """Goes through the fields of one message. Raises DataError beyond its end."""

    def __init__(self, message: bytes) -> None:
        self.message, self.at = message, HEADER
        self.is_little = message[1] == 1
        self.numbers: dict[str, tuple[Any, int]] = {}
        self.texts: dict[str, tuple[str, ...]] = {}
        self.shared = [*range(HEADER)]

    def take(self, count: int, align: int = 1) -> int:
        """Go on by `count` bytes; return where they begin."""
        begin = self.at + -(self.at - HEADER) % align
        self.at = begin + count
        if self.at > len(self.message):
            raise DataError("it ends too early")
        return begin

    def share(self, count: int, align: int = 1) -> bytes:
        """Return `count` bytes that messages of this layout share."""
        begin = self.take(count, align)
        self.shared.extend(range(begin, self.at))
        return self.message[begin : self.at]

    def size(self) -> int:
        """Return the length before a text or a sequence."""
        return int.from_bytes(self.share(4, align=4), "little" if self.is_little else "big")

    def read(self, msgtype: str, prefix: str = "") -> None:
        fields: Any = TYPES.fielddefs[msgtype][1]
        for name, (node, of) in fields:
            path = prefix + name
            if node == Nodetype.NAME:
                self.read(of, f"{path}.")
                continue
            (item, (kind, *_)), count = ((node, of), 1) if node == Nodetype.BASE else of
            if item != Nodetype.BASE:
                raise DataError("it has a sequence of messages")
            if node == Nodetype.SEQUENCE:
                count = self.size()
            if kind == "string":
                self.texts[path] = tuple(self.share(self.size())[:-1].decode() for _ in range(count))
            elif count:
                form = np.dtype(kind).newbyteorder("<" if self.is_little else ">")
                shape = () if node == Nodetype.BASE else (count,)
                self.numbers[path] = (form, shape), self.take(form.itemsize * count, form.itemsize)


def layout_of(message: bytes, msgtype: str) -> Layout:
    """Return the layout of a message. Raises DataError if it is not one of this type, or has sequences of messages."""
    try:
        walk = _Walk(message)
        walk.read(msgtype)
    except (DataError, UnicodeDecodeError) as error:
        raise DataError(f"a message is damaged, or is not a {msgtype} in CDR ({error})") from None
    formats, offsets = zip(*walk.numbers.values(), strict=True) if walk.numbers else ((), ())
    form: Any = {"names": [*walk.numbers], "formats": formats, "offsets": offsets, "itemsize": len(message)}
    return Layout(np.dtype(form), walk.texts, np.array(walk.shared), np.frombuffer(message, np.uint8)[walk.shared])


class Decoder:
    """Decodes the messages of one topic; `damaged` counts those that are not of its type, `problem` describes one."""

    def __init__(self, msgtype: str) -> None:
        self.msgtype, self.damaged, self.problem = msgtype, 0, ""

    def decode(self, messages: Messages) -> Iterator[tuple[np.ndarray, Layout, np.ndarray]]:
        """Yield the messages of each layout: which of `messages` they are (n,), the layout, and their numbers (n,)."""
        lengths = np.array([*map(len, messages.data)])
        for length in np.unique(lengths).tolist():
            left = np.flatnonzero(lengths == length)
            content = messages.data if len(left) == len(lengths) else [messages.data[n] for n in left.tolist()]
            rows = np.frombuffer(b"".join(content), np.uint8).reshape(-1, length)
            while len(left):
                try:
                    layout = layout_of(rows[0].tobytes(), self.msgtype)
                except DataError as error:
                    self.damaged, self.problem = self.damaged + 1, str(error)
                    left, rows = left[1:], rows[1:]
                    continue
                same = (rows[:, layout.where] == layout.shared).all(axis=1)
                yield left[same], layout, rows[same].view(layout.numbers)[:, 0]
                left, rows = left[~same], rows[~same]


class JointSeries(NamedTuple):
    """Messages of one arm in the order of the file."""

    ordinal: np.ndarray  #: (n,) their numbers among all messages of the recording
    arrival: np.ndarray  #: (n,) ns since 1970
    stamp: np.ndarray  #: (n,) ns since 1970
    values: np.ndarray  #: (n, fields, joints), NaN where unknown


class JointArrays(Decoder):
    """Collects the joint states or efforts of one topic by their joints, in order of appearance.

    Others publish there too: a gripper, or a driver of more joints. `arrays` takes the messages that have the joints of
    an arm.

    fields: those of a message that are kept.
    every: of the messages with the same joints, the first of so many is kept.
    """

    def __init__(self, topic: str, fields: Sequence[str] = FIELDS, every: int = 1) -> None:
        super().__init__(JOINT_STATE)
        self.topic, self.fields, self.every = topic, tuple(fields), every
        self._seen: dict[tuple[str, ...], int] = {}  # messages by their joints, also those that are not kept
        # Columns grow in place: parts that are joined in the end need twice the memory.
        self._kept: dict[tuple[str, ...], list[bytearray]] = {}

    def add(self, messages: Messages) -> None:
        """Decode messages."""
        for rows, layout, numbers in self.decode(messages):
            names = layout.texts["name"]
            given = {field: numbers.dtype[field].shape[0] for field in FIELDS if field in (numbers.dtype.names or ())}
            if not names or len(set(names)) < len(names) or set(given.values()) - {len(names)}:
                self.damaged += len(rows)
                self.problem = f"a joint state names {', '.join(names) or 'no joint'}, and has {given or 'no'} values"
                continue
            seen = self._seen.get(names, 0)
            self._seen[names] = seen + len(rows)
            rows, numbers = (column[-seen % self.every :: self.every] for column in (rows, numbers))
            stamp = numbers["header.stamp.sec"].astype(np.int64) * 1_000_000_000 + numbers["header.stamp.nanosec"]
            # float32 is 1000 times finer than a position code.
            values = np.full((len(rows), len(self.fields), len(names)), np.nan, np.float32)
            with np.errstate(over="ignore", invalid="ignore"):
                for number, field in enumerate(self.fields):
                    if field in given:
                        values[:, number] = numbers[field]
            columns = self._kept.setdefault(names, [bytearray() for _ in JointSeries._fields])
            found = messages.ordinal[rows], messages.arrival[rows], stamp, values
            for column, more in zip(columns, found, strict=True):
                column += more.tobytes()

    @property
    def names(self) -> tuple[str, ...]:
        """The joints that most messages name; () without a message."""
        return max(self._seen, key=lambda names: self._seen[names], default=())

    def has(self, joints: Collection[str]) -> bool:
        """Return whether some messages have all of these joints."""
        return any(set(joints) <= set(names) for names in self._kept)

    def arrays(self, joints: Sequence[str]) -> tuple[JointSeries, int]:
        """Return the messages that have all `joints`, in their order, and the number of those that have not.

        They are forgotten then.
        """
        chosen, others = list[JointSeries](), 0
        for names in [*self._kept]:
            *times, values = self._kept.pop(names)
            if set(joints) <= set(names):
                found = np.frombuffer(values, np.float32).reshape(-1, len(self.fields), len(names))
                order = [names.index(joint) for joint in joints]
                found = found if names == tuple(joints) else found[:, :, order]
                ordinal, arrival, stamp = (np.frombuffer(column, np.int64) for column in times)
                chosen.append(JointSeries(ordinal, arrival, stamp, found))
            else:
                others += self._seen[names]
        series = JointSeries(*map(np.concatenate, zip(*chosen, strict=True))) if len(chosen) > 1 else chosen[0]
        if np.any(np.diff(series.ordinal) < 0):
            order_of_file = np.argsort(series.ordinal, kind="stable")
            series = JointSeries(*(column[order_of_file] for column in series))
        return series, others


MAGIC = b"\x89MCAP0\r\n"
ZSTD = b"\x28"  # with which data that zstd compressed begin; CDR begins with 0
RECORD = struct.Struct("<BQ")  # of MCAP: opcode, length of the content (https://mcap.dev/spec)
HEAD = struct.Struct("<BQHIQQ")  # of a message: the same, channel, sequence, time, time of sending; the message follows
MESSAGE = int(Opcode.MESSAGE)  # a plain number is faster to compare than an enumeration
LARGEST = 256 * 2**20  # bytes of an MCAP record; more is damage
BLOCK = 4_000  # messages at once
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
                for _ in (self._mcap if kind_of(file) == ".mcap" else self._sqlite)(file, content, wanted):
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

    def _mcap(self, file: Path, unpacked: Path, wanted: Wanted) -> Iterator[None]:
        """Take the messages of an MCAP file up to the end of its data or a cut; yield after each chunk.

        unpacked: the file, or a copy of one that was compressed.
        """
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

        with unpacked.open("rb") as stream:
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
            self.cut_short = f"{unpacked.name} ends without an index, or is damaged"

    def _sqlite(self, file: Path, unpacked: Path, wanted: Wanted) -> Iterator[None]:
        """Take the messages of a database; yield now and then. unpacked: as in `_mcap`."""
        with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
            try:
                database = stack.enter_context(closing(_opened(unpacked, Path(folder))))
                topics = {
                    key: (str(topic), str(kind))
                    for key, topic, kind in database.execute("SELECT id, name, type FROM topics")
                }
                chosen = {key: topic for key, topic in topics.items() if wanted(*topic)}
                cursor = database.execute(
                    f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({','.join('?' * len(chosen))})",
                    list(chosen),
                )
            except (sqlite3.Error, OSError, UnicodeDecodeError) as error:
                reason = " ".join(str(error).split())  # it may quote several lines of a damaged file
                name = unpacked.name
                way = f"copy {name}-wal, too, if there is one, or recover it by `sqlite3 {name} .recover`"
                raise DataError(f"{file}: not a rosbag2 database, or damaged ({reason}): {way}") from None
            self.topics.update(topics.values())
            try:
                while rows := cursor.fetchmany(BLOCK):
                    for topic, arrival, message in rows:
                        if topic in chosen and isinstance(arrival, int) and isinstance(message, bytes):
                            self._take(chosen[topic], arrival, message)
                        else:
                            self.damaged += 1
                    yield
            except sqlite3.Error:  # the rows before the damage are kept
                self.cut_short = f"{unpacked.name} is cut or damaged"


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
