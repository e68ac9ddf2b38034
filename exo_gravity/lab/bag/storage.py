"""Serialised messages of a rosbag2 recording: MCAP or sqlite3, complete or cut short.

A killed recorder leaves neither metadata.yaml nor an index, so neither is needed: MCAP files are read record by record,
databases row by row, up to the cut. Recordings that rosbag2 compressed by file or by message go through rosbags'
own reader, which requires complete files.

An MCAP file is a sequence of records (https://mcap.dev/spec): one byte of opcode, eight of length, the content. A
chunk's content, once decompressed, is such records again. This module extracts messages itself: the libraries drop a
chunk that is cut, and create an object for each message, while seven million must be read in seconds.
"""

import re
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Generator, Iterator
from io import BytesIO
from mmap import ACCESS_READ, mmap
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from rosbags.rosbag2 import Reader, ReaderError

from exo_gravity.core.errors import DataError

MAGIC = b"\x89MCAP0\r\n"
MESSAGE_OPCODE = int(Opcode.MESSAGE)  # a plain number is faster to compare than an enumeration
RECORD = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time; the message follows

Wanted = Callable[[str, str], bool]  # (topic, type) -> whether to yield its messages
Topic = tuple[str, str]  # name, type
Message = tuple[str, str, int, bytes]  # topic, type, time of arrival in ns since 1970, serialised message


class Storage:
    """A recording: a rosbag2 folder, or one of its files.

    `messages` fills: `topics`, the type of each topic, wanted or not; `announced`, by topic of an MCAP file, the
    definition of its type and the publishers' quality of service; `cut_short`, where the last file ends too early, None
    for complete files.
    """

    def __init__(self, path: str | Path) -> None:
        """Find the files. Raises DataError if there are none."""
        self.path = Path(path)
        self.topics: dict[str, str] = {}
        self.announced: dict[str, tuple[str, str]] = {}
        self.cut_short: str | None = None
        if not self.path.exists():
            raise DataError(f"{path}: no such file or folder")
        files = sorted(self.path.iterdir(), key=_natural) if self.path.is_dir() else [self.path]
        self.files = [file for file in files if file.suffix in (".mcap", ".db3", ".zstd")]
        if not self.files:
            raise DataError(f"{path}: must be a rosbag2 folder with an .mcap or .db3 file, or such a file")

    def messages(self, wanted: Wanted) -> Iterator[Message]:
        """Yield the messages of the `wanted` topics, file by file. Raises DataError for a file of unknown format."""
        metadata = self.path / "metadata.yaml"
        text = metadata.read_text(encoding="utf-8") if metadata.is_file() else ""
        by_message = re.search(r"^\s*compression_mode:\s*['\"]?message", text, re.MULTILINE | re.IGNORECASE)
        if by_message or any(file.suffix == ".zstd" for file in self.files):
            yield from self._by_rosbags(wanted)
            return
        for file in self.files:
            yield from (self._mcap if file.suffix == ".mcap" else self._sqlite)(file, wanted)

    def _mcap(self, file: Path, wanted: Wanted) -> Iterator[Message]:
        with file.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise DataError(f"{file}: not an MCAP file, or empty")
            data = mmap(stream.fileno(), 0, access=ACCESS_READ)
        try:
            if not (yield from self._records(data, len(MAGIC), wanted, {}, {})):
                self.cut_short = f"{file.name} ends without an index"
        except Exception:  # each decompressor raises its own type
            self.cut_short = f"{file.name} ends within a record, or is damaged"

    def _records(
        self, data: bytes | mmap, at: int, wanted: Wanted, schemas: dict[int, Schema], chosen: dict[int, Topic]
    ) -> Generator[Message, None, bool]:
        """Yield the messages among the records from `at` on, also those in chunks; return whether all data were read.

        schemas: read so far.
        chosen: the wanted topics by channel.

        Raises an error at a cut or damage.
        """
        end = len(data)
        while at + RECORD.size <= end:
            if data[at] == MESSAGE_OPCODE and at + MESSAGE.size <= end:
                _, length, number, _, stamp, _ = MESSAGE.unpack_from(data, at)
                start, at = at + MESSAGE.size, at + RECORD.size + length
                if number in chosen and at <= end:
                    yield *chosen[number], stamp, data[start:at]
                continue
            opcode, length = RECORD.unpack_from(data, at)
            at += RECORD.size + length
            body = ReadDataStream(BytesIO(data[at - length : at]))
            if opcode == Opcode.CHUNK:
                chunk, size = get_chunk_data_stream(Chunk.read(body))
                yield from self._records(chunk.read(size), 0, wanted, schemas, chosen)
            elif at > end:
                break
            elif opcode == Opcode.SCHEMA:
                described = Schema.read(body)
                schemas[described.id] = described
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(body)
                schema = schemas.get(channel.schema_id)
                msgtype, definition = (schema.name, schema.data.decode(errors="replace")) if schema else ("", "")
                self.topics[channel.topic] = msgtype
                self.announced[channel.topic] = definition, channel.metadata.get("offered_qos_profiles", "")
                if wanted(channel.topic, msgtype):
                    chosen[channel.id] = channel.topic, msgtype
            elif opcode == Opcode.DATA_END:
                return True
        if at != end:
            raise EOFError
        return False

    def _sqlite(self, file: Path, wanted: Wanted) -> Iterator[Message]:
        try:
            database, topics = _open_database(file)
        except sqlite3.Error as error:
            raise DataError(f"{file}: not a rosbag2 database ({error})") from None
        self.topics.update(topics.values())
        chosen = {key: topic for key, topic in topics.items() if wanted(*topic)}
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({','.join('?' * len(chosen))})"
        try:
            for key, stamp, data in database.execute(query, list(chosen)):
                yield *chosen[key], stamp, data
        except sqlite3.Error as error:  # the rows before the damage have been yielded
            self.cut_short = f"{file.name} {error}"
        database.close()

    def _by_rosbags(self, wanted: Wanted) -> Iterator[Message]:
        try:
            with Reader(self.path) as reader:
                self.topics.update((c.topic, c.msgtype) for c in reader.connections)
                chosen = [c for c in reader.connections if wanted(c.topic, c.msgtype)]
                for connection, stamp, data in reader.messages(chosen) if chosen else ():
                    yield connection.topic, connection.msgtype, stamp, bytes(data)
        except (ReaderError, FileNotFoundError) as error:
            raise DataError(f"{self.path}: a compressed recording must be complete ({error})") from None


def _open_database(file: Path) -> tuple[sqlite3.Connection, dict[int, Topic]]:
    """Return a database, or a readable copy of a damaged one, and its topics. Raises sqlite3.Error.

    A killed recorder may leave a journal, which sqlite replays if it may write next to the file; the copy has none. If
    the file is truncated, the size in its header is wrong. The copy's is made invalid, so that sqlite uses the size of
    the file: it counts if the counter at byte 92 equals the one at 24 (https://www.sqlite.org/fileformat.html, 1.3.7).
    """
    try:
        return _connected(f"{file.resolve().as_uri()}?mode=ro")
    except sqlite3.Error:
        with tempfile.NamedTemporaryFile() as copy:
            shutil.copyfile(file, copy.name)
            copy.seek(24)
            counter = copy.read(4)
            copy.seek(92)
            copy.write(bytes(byte ^ 0xFF for byte in counter))
            copy.flush()
            return _connected(f"file:{copy.name}?immutable=1")


def _connected(uri: str) -> tuple[sqlite3.Connection, dict[int, Topic]]:
    database = sqlite3.connect(uri, uri=True)
    try:
        rows = database.execute("SELECT id, name, type FROM topics").fetchall()
    except sqlite3.Error:
        database.close()
        raise
    return database, {key: (topic, kind) for key, topic, kind in rows}


def _natural(path: Path) -> list[int | str]:
    """Return a sort key that puts bag_2 before bag_10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]
