"""Serialised sensor_msgs/JointState -> arrays, thousands of messages at once.

CDR (OMG DDS-XTYPES 7.4.3, plain CDR version 1): a header of four bytes, the second of which is 1 for little-endian;
then stamp, frame_id, name[], position[], velocity[], effort[]. A number is aligned to its size, a string is its length
and its bytes with a final 0, a sequence its length and its items. All messages of one publisher have the same length
and names. So the first one gives the offsets of the numbers, and NumPy extracts them from all messages whose other
bytes are equal.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.errors import DataError

FIELDS = ("position", "velocity", "effort")


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the numbers of a message are.

    order: '<' or '>', the byte order. fixed: (n,) offsets of the bytes that identify this layout. content: (n,) those
    bytes. offset: of the first number of each of `FIELDS`, None for an empty field.
    """

    names: tuple[str, ...]
    order: str
    fixed: np.ndarray
    content: np.ndarray
    offset: tuple[int | None, ...]

    @classmethod
    def of(cls, message: bytes) -> Layout:
        """Return the layout of one message. Raises DataError if it is not a JointState."""
        cursor = _Cursor(message)
        try:
            cursor.take(4)
            cursor.position += 8  # the stamp
            cursor.text()
            names = tuple(cursor.text() for _ in range(cursor.count()))
            offset = []
            for field in FIELDS:
                length = cursor.count()
                if length not in (0, len(names)):
                    raise DataError(f"a joint state has {length} values of {field} for {len(names)} names")
                offset.append(cursor.numbers(length))
        except (struct.error, IndexError, UnicodeDecodeError):
            raise DataError("a message is damaged, or is not a sensor_msgs/msg/JointState in CDR") from None
        fixed = np.concatenate([np.arange(*span) for span in cursor.spans])
        return cls(names, cursor.order, fixed, np.frombuffer(message, np.uint8)[fixed], tuple(offset))

    def matches(self, rows: np.ndarray) -> np.ndarray:
        """Return which messages have this layout, (n,) bool; rows: their bytes (n, length)."""
        matching: np.ndarray = np.all(rows[:, self.fixed] == self.content, axis=1)
        return matching

    def stamps(self, rows: np.ndarray) -> np.ndarray:
        """Return the stamps in ns since 1970, (n,) int64."""
        seconds, nanoseconds = (self._extract(rows, place, kind) for place, kind in ((4, "i4"), (8, "u4")))
        stamps: np.ndarray = seconds[:, 0].astype(np.int64) * 1_000_000_000 + nanoseconds[:, 0]
        return stamps

    def values(self, rows: np.ndarray, names: Sequence[str], fields: Sequence[str]) -> np.ndarray:
        """Return (n, fields, joints) in the order of `names`; float32 is 1000 times finer than a position code."""
        result = np.full((len(rows), len(fields), len(names)), np.nan, np.float32)
        chosen = [self.names.index(name) for name in names]
        for field, name in enumerate(fields):
            if (offset := self.offset[FIELDS.index(name)]) is not None:
                result[:, field] = self._extract(rows, offset, "f8", len(self.names))[:, chosen]
        return result

    def _extract(self, rows: np.ndarray, offset: int, kind: str, count: int = 1) -> np.ndarray:
        """Return `count` numbers of type `kind` at `offset` of each message, (n, count)."""
        part = np.ascontiguousarray(rows[:, offset : offset + int(kind[1]) * count])
        return part.view(np.dtype(self.order + kind))


class _Cursor:
    """Walks through one message and notes the spans of bytes that hold lengths and names."""

    def __init__(self, message: bytes) -> None:
        self._message = message
        self.order = "<" if message[1:2] == b"\x01" else ">"
        self.position = 0
        self.spans: list[tuple[int, int]] = []

    def take(self, length: int) -> bytes:
        """Return the next bytes, which are part of the layout."""
        start, self.position = self.position, self.position + length
        if self.position > len(self._message):
            raise IndexError(self.position)
        self.spans.append((start, self.position))
        return self._message[start : self.position]

    def count(self) -> int:
        """Return the length of a sequence or a string."""
        self.align(4)
        return int(struct.unpack(f"{self.order}I", self.take(4))[0])

    def text(self) -> str:
        """Return a string."""
        return self.take(self.count()).rstrip(b"\x00").decode()

    def numbers(self, count: int) -> int | None:
        """Skip `count` doubles; return the offset of the first, None for no doubles."""
        if not count:
            return None
        self.align(8)
        start, self.position = self.position, self.position + 8 * count
        if self.position > len(self._message):
            raise IndexError(self.position)
        return start

    def align(self, size: int) -> None:
        """Skip padding, whose bytes are undefined. Alignment counts from the end of the header."""
        self.position += -(self.position - 4) % size


class JointArrays:
    """Collects `fields` of the joint states of one topic. The first message gives the order of the joints, `names`."""

    def __init__(self, topic: str, fields: Sequence[str] = FIELDS) -> None:
        self.topic = topic
        self.fields = tuple(fields)
        self.names: tuple[str, ...] = ()
        self._layouts: list[Layout] = []
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, arrivals: Sequence[int], messages: Sequence[bytes]) -> None:
        """Decode messages that arrived at `arrivals` ns. Raises DataError if joints change or a message is damaged."""
        arrival = np.array(arrivals, dtype=np.int64)
        lengths = np.fromiter(map(len, messages), np.int64, len(messages))
        stamp = np.empty(len(messages), np.int64)
        values = np.empty((0, 0, 0), np.float32)
        for length in lengths[np.sort(np.unique(lengths, return_index=True)[1])]:  # in order of appearance
            chosen = np.flatnonzero(lengths == length)
            rows = np.frombuffer(b"".join([messages[i] for i in chosen.tolist()]), np.uint8).reshape(
                len(chosen), length
            )
            while len(chosen):
                layout = self._layout(rows[0].tobytes())
                same = layout.matches(rows)
                if not values.size:
                    values = np.empty((len(messages), len(self.fields), len(self.names)), np.float32)
                stamp[chosen[same]] = layout.stamps(rows[same])
                values[chosen[same]] = layout.values(rows[same], self.names, self.fields)
                chosen, rows = chosen[~same], rows[~same]
        self._parts.append((arrival, stamp, values))

    @property
    def first_arrival(self) -> int:
        """Time of arrival of the first message in ns."""
        return int(self._parts[0][0][0])

    def _layout(self, message: bytes) -> Layout:
        row = np.frombuffer(message, np.uint8)[None]
        for layout in self._layouts:
            if layout.fixed[-1] < len(message) and layout.matches(row)[0]:
                return layout
        layout = Layout.of(message)
        self.names = self.names or layout.names
        if sorted(layout.names) != sorted(self.names):
            raise DataError(
                f"{self.topic}: joint names differ: {', '.join(layout.names)}; must be {', '.join(self.names)}"
            )
        self._layouts.append(layout)
        return layout

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return times of arrival (n,) and stamps (n,) in ns, values (n, fields, joints); forget them."""
        parts, self._parts = self._parts, []
        arrival, stamp, values = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return arrival, stamp, values
