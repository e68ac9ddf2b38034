"""Serialised sensor_msgs/JointState -> arrays, thousands of messages at once.

CDR (OMG DDS-XTYPES 7.4.3, plain CDR version 1): a header of four bytes, the second of which is 1 for little-endian;
then stamp, frame_id, name[], position[], velocity[], effort[]. A number is aligned to its size, a string is its length
and its bytes with a final 0, a sequence its length and its items. All messages of one publisher have the same length
and names. So the first one gives the offsets of the numbers, and NumPy extracts them from all messages whose other
bytes are equal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from exo_gravity.bag.content import JOINT_STATE
from exo_gravity.core.errors import DataError

FIELDS = ("position", "velocity", "effort")
TYPES = get_typestore(Stores.ROS2_JAZZY)


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the numbers of a message are."""

    names: tuple[str, ...]
    fixed: np.ndarray  #: (n,) offsets of the bytes that identify this layout
    content: np.ndarray  #: (n,) those bytes
    numbers: np.dtype[np.void]  #: of a message: sec, nanosec, and those of `FIELDS` that are not empty, (joints,) each

    @classmethod
    def of(cls, message: bytes) -> Layout:
        """Return the layout of one message. Raises DataError if it is not a JointState."""
        try:
            decoded: Any = TYPES.deserialize_cdr(message, JOINT_STATE)
        except Exception:  # rosbags raises what its generated code meets
            raise DataError("a message is damaged, or is not a sensor_msgs/msg/JointState in CDR") from None
        is_fixed = np.zeros(len(message), bool)  # the header, lengths and texts; not the stamp, numbers and padding
        is_fixed[:4] = True
        at, order, count = 12, "<" if message[1] == 1 else ">", len(decoded.name)
        texts = [len(text.encode()) + 1 for text in (decoded.header.frame_id, *decoded.name)]
        for size in (4 + texts[0], 4, *(4 + length for length in texts[1:])):
            at += -at % 4
            is_fixed[at : at + size] = True
            at += size
        offsets = {"sec": 4, "nanosec": 8}
        formats: dict[str, Any] = {"sec": f"{order}i4", "nanosec": f"{order}u4"}
        for field in FIELDS:
            given = len(getattr(decoded, field))
            if given not in (0, count):
                raise DataError(f"a joint state has {given} values of {field} for {count} names")
            at += -at % 4
            is_fixed[at : at + 4] = True
            at += 4
            if given:
                at += -(at - 4) % 8  # alignment counts from the end of the header
                offsets[field], formats[field] = at, (f"{order}f8", (count,))
                at += 8 * count
        fixed, places = np.flatnonzero(is_fixed), list(offsets.values())
        kinds = list(formats.values())
        form: Any = {"names": list(offsets), "formats": kinds, "offsets": places, "itemsize": len(message)}
        return cls(tuple(decoded.name), fixed, np.frombuffer(message, np.uint8)[fixed], np.dtype(form))

    def matches(self, rows: np.ndarray) -> np.ndarray:
        """Return which messages have this layout, (n,) bool; rows: their bytes (n, length)."""
        return np.asarray(np.all(rows[:, self.fixed] == self.content, axis=1))

    def stamps(self, rows: np.ndarray) -> np.ndarray:
        """Return the stamps in ns since 1970, (n,) int64."""
        numbers = rows.view(self.numbers)[:, 0]
        return np.asarray(numbers["sec"].astype(np.int64) * 1_000_000_000 + numbers["nanosec"])

    def values(self, rows: np.ndarray, names: Sequence[str], fields: Sequence[str]) -> np.ndarray:
        """Return (n, fields, joints) in the order of `names`; float32 is 1000 times finer than a position code."""
        result = np.full((len(rows), len(fields), len(names)), np.nan, np.float32)
        chosen, numbers = [self.names.index(name) for name in names], rows.view(self.numbers)[:, 0]
        for field, name in enumerate(fields):
            if name in (self.numbers.names or ()):
                result[:, field] = numbers[name][:, chosen]
        return result


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
            joined = b"".join([messages[i] for i in chosen.tolist()])
            rows = np.frombuffer(joined, np.uint8).reshape(len(chosen), length)
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
            differing, expected = ", ".join(layout.names), ", ".join(self.names)
            raise DataError(f"{self.topic}: joint names differ: {differing}; must be {expected}")
        self._layouts.append(layout)
        return layout

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return times of arrival (n,) and stamps (n,) in ns, values (n, fields, joints); forget them."""
        arrival, stamp, values = (np.concatenate(columns) for columns in zip(*self._parts, strict=True))
        self._parts.clear()
        return arrival, stamp, values
