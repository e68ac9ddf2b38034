"""Serialised sensor_msgs/JointState -> arrays, thousands of messages at once.

CDR (OMG DDS-XTYPES 7.4.3, plain CDR version 1): four bytes of header, of which the second says little-endian; then
stamp, frame_id, name[], position[], velocity[], effort[], where a number is aligned to its size, a string is its length
and its bytes with a final 0, a sequence its length and its items. All messages of one publisher have the same length
and names, so the first says where the numbers are, and NumPy takes them out of all that agree with it byte for byte.
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
    """Where the numbers of a message are. fixed: (n,) the places of the bytes that make it this layout, and `content`
    (n,) those bytes. offset: of the first number of each of `FIELDS`, None where it is empty."""

    names: tuple[str, ...]
    order: str
    fixed: np.ndarray
    content: np.ndarray
    offset: tuple[int | None, ...]

    @classmethod
    def of(cls, message: bytes) -> Layout:
        """Return the layout of one message. Raises DataError if it is no JointState."""
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
            raise DataError("a message is no sensor_msgs/msg/JointState in CDR, or is damaged") from None
        fixed = np.concatenate([np.arange(*span) for span in cursor.spans])
        return cls(names, cursor.order, fixed, np.frombuffer(message, np.uint8)[fixed], tuple(offset))

    def matches(self, rows: np.ndarray) -> np.ndarray:
        """Return which of rows (n, length) of bytes have this layout, (n,) bool."""
        return np.all(rows[:, self.fixed] == self.content, axis=1)

    def stamps(self, rows: np.ndarray) -> np.ndarray:
        """Return the stamps in ns since 1970, (n,) int64."""
        seconds, nanoseconds = (self._taken(rows, place, kind) for place, kind in ((4, "i4"), (8, "u4")))
        return seconds[:, 0].astype(np.int64) * 1_000_000_000 + nanoseconds[:, 0]

    def values(self, rows: np.ndarray, names: Sequence[str], fields: Sequence[str]) -> np.ndarray:
        """Return (n, fields, joints) in the order of `names`, as float32: position codes are 1000 times coarser."""
        result = np.full((len(rows), len(fields), len(names)), np.nan, np.float32)
        chosen = [self.names.index(name) for name in names]
        for field, name in enumerate(fields):
            if (offset := self.offset[FIELDS.index(name)]) is not None:
                result[:, field] = self._taken(rows, offset, "f8", len(self.names))[:, chosen]
        return result

    def _taken(self, rows: np.ndarray, offset: int, kind: str, count: int = 1) -> np.ndarray:
        part = np.ascontiguousarray(rows[:, offset : offset + int(kind[1]) * count])
        return part.view(np.dtype(self.order + kind))


class _Cursor:
    """Walks through one message, and notes the spans of bytes that say how long things are and how they are named."""

    def __init__(self, message: bytes):
        self._message = message
        self.order = "<" if message[1:2] == b"\x01" else ">"
        self.position = 0
        self.spans: list[tuple[int, int]] = []

    def take(self, length: int) -> bytes:
        """Return the next bytes, which belong to the layout."""
        start, self.position = self.position, self.position + length
        if self.position > len(self._message):
            raise IndexError(self.position)
        self.spans.append((start, self.position))
        return self._message[start : self.position]

    def count(self) -> int:
        """Return the length of a sequence or a string."""
        self.align(4)
        return struct.unpack(f"{self.order}I", self.take(4))[0]

    def text(self) -> str:
        """Return a string."""
        return self.take(self.count()).rstrip(b"\x00").decode()

    def numbers(self, count: int) -> int | None:
        """Skip `count` doubles; return where they begin."""
        if not count:
            return None
        self.align(8)
        start, self.position = self.position, self.position + 8 * count
        if self.position > len(self._message):
            raise IndexError(self.position)
        return start

    def align(self, size: int) -> None:
        """Skip padding: its bytes mean nothing and may be anything. Places count from the end of the header."""
        self.position += -(self.position - 4) % size


class JointArrays:
    """Collects `fields` of the joint states of one topic; the first message orders the joints (`names`)."""

    def __init__(self, topic: str, fields: Sequence[str] = FIELDS):
        self.topic = topic
        self.fields = tuple(fields)
        self.names: tuple[str, ...] = ()
        self._layouts: list[Layout] = []
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, arrivals: Sequence[int], messages: Sequence[bytes]) -> None:
        """Decode messages and their times of arrival (ns). Raises DataError for other joints or damaged messages."""
        arrival = np.array(arrivals, dtype=np.int64)
        lengths = np.fromiter(map(len, messages), np.int64, len(messages))
        stamp = np.empty(len(messages), np.int64)
        values = np.empty((0, 0, 0), np.float32)
        for length in lengths[np.sort(np.unique(lengths, return_index=True)[1])]:  # as they came
            chosen = np.flatnonzero(lengths == length)
            rows = np.frombuffer(b"".join([messages[i] for i in chosen]), np.uint8).reshape(len(chosen), length)
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
        """Return times of arrival (n,) and stamps (n,) in ns, values (n, fields, joints); and forget them."""
        parts, self._parts = self._parts, []
        return tuple(np.concatenate([part[i] for part in parts]) for i in range(3))
