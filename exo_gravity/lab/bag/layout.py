# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Serialised messages of one type -> their numbers as arrays, thousands at once.

CDR (OMG DDS-XTYPES 7.4.3, plain CDR version 1): a header of four bytes, the second of which is 1 for little-endian;
then the fields in order. A number is aligned to its size, a string is its length and its bytes with a final 0, a
sequence its length and its items. All messages of one publisher have the same length and the same texts. So the first
one gives the offsets of the numbers, and NumPy extracts them from all messages whose lengths and texts are equal.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from exo_gravity.core.errors import DataError

TYPES = get_typestore(Stores.ROS2_JAZZY)
HEADER = 4  # bytes; alignment counts from their end
MAX_LAYOUTS = 16  # of messages of one length, in one batch, that are looked for at once
NUMBERS = {
    "bool": "?", "octet": "u1", "byte": "u1", "uint8": "u1", "int8": "i1", "uint16": "u2", "int16": "i2",
    "uint32": "u4", "int32": "i4", "uint64": "u8", "int64": "i8", "float32": "f4", "float64": "f8",
}  # fmt: skip


class Batch(NamedTuple):
    """Messages in the order of their file, and where they lie in its bytes."""

    data: np.ndarray  #: (bytes,) uint8
    start: np.ndarray  #: (n,) of each message in data
    length: np.ndarray  #: (n,) bytes
    arrival: np.ndarray  #: (n,) ns since 1970

    def of(self, chosen: np.ndarray) -> "Batch":
        """Return the messages at the indices, or under the mask, `chosen`."""
        return Batch(self.data, self.start[chosen], self.length[chosen], self.arrival[chosen])

    def messages(self) -> list[bytes]:
        """Return each message."""
        ends = (self.start + self.length).tolist()
        return [self.data[start:end].tobytes() for start, end in zip(self.start.tolist(), ends, strict=True)]


class Layout(NamedTuple):
    """Where the numbers lie in messages of one length."""

    numbers: np.dtype[np.void]  #: by their paths, such as 'header.stamp.sec'
    constant: np.dtype[np.void]  #: bytes that messages of this layout share: header, lengths and texts, as words
    texts: dict[str, tuple[str, ...]]  #: by their paths


class Decoded(NamedTuple):
    """Messages of one layout."""

    rows: np.ndarray  #: (n,) in the batch
    layout: Layout
    values: np.ndarray  #: (n,) of the type `layout.numbers`


class _Walk:
    """Goes through the fields of one message."""

    def __init__(self, message: bytes) -> None:
        self.message, self.at = message, HEADER
        self.order = "<" if message[1] == 1 else ">"
        self.numbers: dict[str, tuple[Any, int]] = {}
        self.constant = [slice(0, HEADER)]
        self.texts: dict[str, tuple[str, ...]] = {}

    def align(self, size: int) -> None:
        self.at += -(self.at - HEADER) % size

    def take(self, count: int) -> int:
        """Go on by `count` bytes; return where they begin. Raises DataError beyond the end."""
        begin, self.at = self.at, self.at + count
        if self.at > len(self.message):
            raise DataError("it ends too early")
        return begin

    def size(self) -> int:
        """Return the length before a text or a sequence."""
        self.align(4)
        at = self.take(4)
        self.constant.append(slice(at, self.at))
        return int.from_bytes(self.message[at : self.at], "little" if self.order == "<" else "big")

    def text(self) -> str:
        length = self.size()
        at = self.take(length)
        self.constant.append(slice(at, self.at))
        return self.message[at : self.at - 1].decode()

    def number(self, path: str, name: str, shape: tuple[int, ...]) -> None:
        form = np.dtype(self.order + NUMBERS[name])
        self.align(form.itemsize)
        self.numbers[path] = (form, shape), self.take(form.itemsize * int(np.prod(shape, dtype=int)))

    def message_of(self, msgtype: str, prefix: str = "") -> None:
        fields: Any = TYPES.fielddefs[msgtype][1]
        for name, (node, of) in fields:
            path = prefix + name
            if node == Nodetype.NAME:
                self.message_of(of, f"{path}.")
                continue
            (item, (kind, *_)), count = ((node, of), 1) if node == Nodetype.BASE else of
            if item != Nodetype.BASE:
                raise DataError("it has a sequence of messages")
            if node == Nodetype.SEQUENCE:
                count = self.size()
            if kind == "string":
                if count > len(self.message):
                    raise DataError("it ends too early")
                self.texts[path] = tuple(self.text() for _ in range(count))
            elif count:
                self.number(path, kind, () if node == Nodetype.BASE else (count,))


def layout_of(message: bytes, msgtype: str) -> Layout:
    """Return the layout of a message. Raises DataError if it is not one of this type, or has sequences of messages."""
    try:
        walk = _Walk(message)
        walk.message_of(msgtype)
    except (DataError, IndexError, UnicodeDecodeError) as error:
        raise DataError(f"a message is damaged, or is not a {msgtype} in CDR ({error})") from None
    formats, offsets = zip(*walk.numbers.values(), strict=True) if walk.numbers else ((), ())
    form: Any = {"names": [*walk.numbers], "formats": formats, "offsets": offsets, "itemsize": len(message)}
    return Layout(np.dtype(form), _words(walk.constant, len(message)), walk.texts)


def _words(parts: list[slice], size: int) -> np.dtype[np.void]:
    """Return the bytes `parts` of a message of `size` bytes as words, which may overlap: words are compared fast."""
    words: dict[int, int] = {}  # where each begins: its bytes
    for part in _joined(parts):
        length = part.stop - part.start
        width = next(width for width in (8, 4, 2, 1) if width <= length)
        words |= dict.fromkeys((*range(part.start, part.stop - width, width), part.stop - width), width)
    names, formats = [str(at) for at in words], [f"u{width}" for width in words.values()]
    form: Any = {"names": names, "formats": formats, "offsets": [*words], "itemsize": size}
    return np.dtype(form)


def _joined(parts: list[slice]) -> tuple[slice, ...]:
    """Return parts of a message without empty ones, neighbours as one."""
    joined = parts[:1]
    for part in parts[1:]:
        if part.start == joined[-1].stop:
            joined[-1] = slice(joined[-1].start, part.stop)
        else:
            joined.append(part)
    return tuple(joined)


class Decoder:
    """Decodes the messages of one topic; `damaged` counts those that are not of its type, `problem` describes one."""

    def __init__(self, msgtype: str) -> None:
        self.msgtype, self.damaged, self.problem = msgtype, 0, ""
        self._known: dict[int, tuple[Layout, np.ndarray]] = {}  # by length: the last layout, and a message of it

    def decode(self, batch: Batch) -> Iterator[Decoded]:
        """Yield the messages of a batch, those of one layout together."""
        for length in dict.fromkeys(batch.length.tolist()):  # in order of appearance
            chosen = np.flatnonzero(batch.length == length)
            rows = _rows(batch.data, batch.start[chosen], length)
            for _ in range(MAX_LAYOUTS):
                if not len(rows):
                    break
                same = self._matching(rows, length)
                if same is None:  # the first one is damaged
                    chosen, rows = chosen[1:], rows[1:]
                    continue
                layout, _ = self._known[length]
                yield Decoded(chosen[same], layout, rows[same].view(layout.numbers)[:, 0])
                chosen, rows = chosen[~same], rows[~same]
            for index, row in zip(chosen, rows, strict=True):  # layouts that change with every message
                if own := self._layout(row):
                    yield Decoded(np.array([index]), own, row.view(own.numbers))

    def _matching(self, rows: np.ndarray, length: int) -> np.ndarray | None:
        """Return which rows have the known layout or, if none has, that of the first row; None if that is damaged."""
        if length in self._known:
            same = _equal(rows, *self._known[length])
            if same.any():
                return same
        layout = self._layout(rows[0])
        if not layout:
            return None
        self._known[length] = layout, rows[0].copy()
        return _equal(rows, *self._known[length])

    def _layout(self, row: np.ndarray) -> Layout | None:
        try:
            return layout_of(row.tobytes(), self.msgtype)
        except DataError as error:
            self.damaged, self.problem = self.damaged + 1, str(error)
            return None


def records_at(data: np.ndarray, start: np.ndarray, form: np.dtype[np.void]) -> np.ndarray:
    """Return the records (n,) of a form that begin at `start` (n,) in data, (bytes,) uint8, which holds all of them."""
    count = max(len(data) - form.itemsize + 1, 0)
    # Whole records are copied several times as fast as rows of bytes are.
    raw = np.ndarray(count, np.dtype((np.void, form.itemsize)), data, strides=(1,))
    return raw[start].view(form)


def _rows(data: np.ndarray, start: np.ndarray, length: int) -> np.ndarray:
    """Return the messages (n, length) of equal length at `start` in data, as bytes."""
    if not length:
        return np.empty((len(start), 0), np.uint8)
    return records_at(data, start, np.dtype((np.void, length))).view(np.uint8).reshape(-1, length)


def _equal(rows: np.ndarray, layout: Layout, one: np.ndarray) -> np.ndarray:
    """Return whether each row shares the constant bytes of the message `one`."""
    same: np.ndarray = rows.view(layout.constant)[:, 0] == one.view(layout.constant)[0]
    return same
