"""Serialised messages of an MCAP file, complete or cut short, read without its index.

The file is a sequence of records (https://mcap.dev/spec): one byte of opcode, eight of length, the content. A chunk's
content, once decompressed, is such records again. This module extracts messages itself, because the `mcap` library
creates an object for each one, and seven million must be read in seconds.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream

from exo_gravity.core.errors import DataError

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
BATCH_SIZE = 5_000  # messages

Wanted = Callable[[str, str], bool]  # (topic, type) -> whether to yield its messages


class Batch(NamedTuple):
    """Messages of one topic: their times of arrival `stamps` in ns since 1970, and their bytes."""

    topic: str
    msgtype: str
    stamps: list[int]
    data: list[bytes]


class Announced(NamedTuple):
    """What a file states about a topic: its type, the type's definition, and the publishers' quality of service."""

    msgtype: str
    definition: str
    offered_qos: str


class McapMessages:
    """The messages of one MCAP file, collected by channel.

    After reading, `cut_short` describes where the file ends too early; None for a complete file. announced: by topic.
    """

    def __init__(self, stream: BinaryIO, topics: dict[str, str], wanted: Wanted) -> None:
        """Begin at the start of `stream`; topics: filled with the type of each topic. Raises DataError if not MCAP."""
        if stream.read(len(MAGIC)) != MAGIC:
            raise DataError(f"{stream.name}: not an MCAP file, or empty")
        self.cut_short: str | None = None
        self.announced: dict[str, Announced] = {}
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
                self._batches[channel] = Batch(batch.topic, batch.msgtype, [], [])
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
            qos = channel.metadata.get("offered_qos_profiles", "")
            self.announced[channel.topic] = Announced(msgtype, definition, qos)
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
