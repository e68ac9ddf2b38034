# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Serialised messages of one type -> their numbers as arrays, thousands at once.

CDR (OMG DDS-XTYPES 7.4.3, plain CDR version 1): a header of four bytes, the second of which is 1 for little-endian;
then the fields in order. A number is aligned to its size, a string is its length and its bytes with a final 0, a
sequence its length and its items. All messages of one publisher have the same length and the same texts. So the first
one gives the offsets of the numbers, and NumPy extracts them from all messages whose lengths and texts are equal.
"""

from collections.abc import Collection, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.content import JOINT_STATE

TYPES = get_typestore(Stores.ROS2_JAZZY)
FIELDS = ("position", "velocity", "effort")  # of a joint state
HEADER = 4  # bytes; alignment counts from their end


class Messages(NamedTuple):
    """Messages of one topic in the order of their file."""

    topic: str
    msgtype: str
    ordinal: np.ndarray  #: (n,) their numbers among all messages of the recording
    arrival: np.ndarray  #: (n,) ns since 1970, 0 where no clock shows it
    data: Sequence[bytes]  #: (n,) each more than a header


class Layout(NamedTuple):
    """Where the numbers lie in messages of one length."""

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
        self._known: dict[int, Layout] = {}  # the last layout by the length of its messages

    def decode(self, messages: Messages) -> Iterator[tuple[np.ndarray, Layout, np.ndarray]]:
        """Yield the messages of each layout: which of `messages` they are (n,), the layout, and their numbers (n,)."""
        lengths = np.array([*map(len, messages.data)])
        for length in np.unique(lengths).tolist():
            left = np.flatnonzero(lengths == length)
            content = messages.data if len(left) == len(lengths) else [messages.data[n] for n in left.tolist()]
            rows = np.frombuffer(b"".join(content), np.uint8).reshape(-1, length)
            layout = self._known.get(length)
            while len(left):
                try:
                    layout = layout or layout_of(rows[0].tobytes(), self.msgtype)
                except DataError as error:
                    self.damaged, self.problem = self.damaged + 1, str(error)
                    left, rows = left[1:], rows[1:]
                    continue
                same = (rows[:, layout.where] == layout.shared).all(axis=1)
                if same.any():
                    self._known[length] = layout
                    yield left[same], layout, rows[same].view(layout.numbers)[:, 0]
                    left, rows = left[~same], rows[~same]
                layout = None


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
