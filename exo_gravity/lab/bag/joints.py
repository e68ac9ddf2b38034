"""Serialised sensor_msgs/JointState -> arrays, thousands of messages at once.

CDR (OMG DDS-XTYPES 7.4.3, plain CDR version 1): a header of four bytes, the second of which is 1 for little-endian;
then stamp, frame_id, name[], position[], velocity[], effort[]. A number is aligned to its size, a string is its length
and its bytes with a final 0, a sequence its length and its items. All messages of one publisher have the same length
and names. So the first one gives the offsets of the numbers, and NumPy extracts them from all messages whose other
bytes are equal.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.content import JOINT_STATE

FIELDS = ("position", "velocity", "effort")
TYPES = get_typestore(Stores.ROS2_JAZZY)


class JointArrays:
    """Collects the joint states of one topic. The first message gives the order of the joints, `names`."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.names: tuple[str, ...] = ()
        self.first_arrival = 0  #: ns
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, arrivals: Sequence[int], messages: Sequence[bytes]) -> None:
        """Decode messages that arrived at `arrivals` ns. Raises DataError if joints change or a message is damaged."""
        self.first_arrival = self.first_arrival or arrivals[0]
        arrived = np.array(arrivals, np.int64)
        lengths = np.fromiter(map(len, messages), np.int64, len(messages))
        for length in dict.fromkeys(lengths.tolist()):  # in order of appearance
            chosen = np.flatnonzero(lengths == length)
            rows = np.frombuffer(b"".join([messages[i] for i in chosen.tolist()]), np.uint8).reshape(-1, length)
            while len(chosen):
                names, fixed, numbers = _layout(rows[0].tobytes())
                self.names = self.names or names
                if sorted(names) != sorted(self.names):
                    differing, expected = ", ".join(names), ", ".join(self.names)
                    raise DataError(f"{self.topic}: joint names differ: {differing}; must be {expected}")
                same = np.all(rows[:, fixed] == rows[0, fixed], axis=1)
                self._parts.append((arrived[chosen[same]], *self._decoded(rows[same].view(numbers)[:, 0], names)))
                chosen, rows = chosen[~same], rows[~same]

    def _decoded(self, numbers: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return stamps (n,) in ns and values (n, 3, joints); float32 is 1000 times finer than a position code."""
        values = np.full((len(numbers), len(FIELDS), len(self.names)), np.nan, np.float32)
        order = [names.index(name) for name in self.names]
        for field, name in enumerate(FIELDS):
            if name in (numbers.dtype.names or ()):
                values[:, field] = numbers[name][:, order]
        return numbers["sec"].astype(np.int64) * 1_000_000_000 + numbers["nanosec"], values

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return times of arrival (n,) in order and stamps (n,) in ns, and the values (n, 3, joints) of `FIELDS`.

        They are forgotten then.
        """
        arrival, stamp, values = (np.concatenate(columns) for columns in zip(*self._parts, strict=True))
        self._parts.clear()
        order = np.argsort(arrival, kind="stable")
        return arrival[order], stamp[order], values[order]


def _layout(message: bytes) -> tuple[tuple[str, ...], np.ndarray, np.dtype[np.void]]:
    """Return the joints of a message, the offsets (n,) of the bytes that identify its layout, and its numbers' type.

    The bytes are the header, lengths and texts, not the padding. The numbers are sec, nanosec, and those of `FIELDS`
    that are not empty, (joints,) each. Raises DataError if the message is not a JointState.
    """
    try:
        decoded: Any = TYPES.deserialize_cdr(message, JOINT_STATE)
    except Exception:  # rosbags raises whatever its generated code raises
        raise DataError("a message is damaged, or is not a sensor_msgs/msg/JointState in CDR") from None
    order, count = "<" if message[1] == 1 else ">", len(decoded.name)
    fixed, at = [*range(4)], 12
    texts = [len(text.encode()) + 1 for text in (decoded.header.frame_id, *decoded.name)]
    for size in (4 + texts[0], 4, *(4 + length for length in texts[1:])):
        at += -at % 4
        fixed += range(at, at + size)
        at += size
    numbers: dict[str, tuple[Any, int]] = {"sec": (f"{order}i4", 4), "nanosec": (f"{order}u4", 8)}
    for field in FIELDS:
        given = len(getattr(decoded, field))
        if given not in (0, count):
            raise DataError(f"a joint state has {given} values of {field} for {count} names")
        at += -at % 4
        fixed += range(at, at + 4)
        at += 4
        if given:
            at += -(at - 4) % 8  # alignment counts from the end of the header
            numbers[field] = (f"{order}f8", (count,)), at
            at += 8 * count
    formats, offsets = zip(*numbers.values(), strict=True)
    form: Any = {"names": [*numbers], "formats": formats, "offsets": offsets, "itemsize": len(message)}
    return tuple(decoded.name), np.array(fixed), np.dtype(form)
