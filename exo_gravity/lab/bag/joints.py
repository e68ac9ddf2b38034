# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The joint states or efforts of one topic -> arrays of the joints of one arm.

Others publish there too: a gripper, or a driver of more joints. Messages are kept by the joints that they name, and
`arrays` takes those that have the joints of the arm.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.content import JOINT_STATE
from exo_gravity.lab.bag.layout import Batch, Decoder

FIELDS = ("position", "velocity", "effort")
GROWTH = 1.2  # by which arrays that are full become larger


class JointSeries(NamedTuple):
    """Messages of one arm in the order of the file."""

    ordinal: np.ndarray  #: (n,) their numbers among all messages of the recording
    arrival: np.ndarray  #: (n,) ns since 1970
    stamp: np.ndarray  #: (n,) ns since 1970
    values: np.ndarray  #: (n, fields, joints), NaN where unknown

    def of(self, chosen: Any) -> "JointSeries":
        """Return the messages at the indices, in the slice or under the mask `chosen`."""
        return JointSeries(*(column[chosen] for column in self))


class GrowingSeries:
    """Messages of the same joints, in arrays that grow in place: parts that are joined in the end need twice as much.

    `series` is valid until messages are added or left out.
    """

    def __init__(self, first: JointSeries) -> None:
        self._columns = [np.array(column) for column in first]
        self._count = len(first.ordinal)

    @property
    def series(self) -> JointSeries:
        """The messages."""
        return JointSeries(*(column[: self._count] for column in self._columns))

    def add(self, more: JointSeries) -> None:
        """Add messages."""
        begin, self._count = self._count, self._count + len(more.ordinal)
        if self._count > len(self._columns[0]):
            self._resize(int(GROWTH * self._count))
        for column, values in zip(self._columns, more, strict=True):
            column[begin : self._count] = values

    def leave_out(self, begin: int, left_out: np.ndarray) -> None:
        """Forget the messages under the mask `left_out` (k,), the first of which is that of the `begin`-th message."""
        kept = np.flatnonzero(~left_out) + begin
        tail = slice(begin + len(left_out), self._count)
        self._count -= len(left_out) - len(kept)
        for column in self._columns:
            rows = np.concatenate((column[kept], column[tail]))
            column[begin : self._count] = rows

    def trimmed(self) -> JointSeries:
        """Return the messages, in arrays without room for more. Nothing can be added then."""
        self._resize(self._count)
        return self.series

    def _resize(self, count: int) -> None:
        for column in self._columns:
            column.resize((count, *column.shape[1:]), refcheck=False)  # nothing else refers to it: see the class


def _problem(names: Sequence[str], given: Mapping[str, int]) -> str:
    """Return why a message with these names, and so many values in each field, is no joint state."""
    if not names:
        return f"a joint state names no joint, and has {given} values"
    if twice := [name for name in names if names.count(name) > 1]:
        return f"a joint state names {twice[0]!r} twice: {', '.join(names)}"
    return f"a joint state has {given} values for the joints {', '.join(names)}"


class JointArrays:
    """Collects the joint states of one topic: `count`, and `by_joints`, in order of appearance.

    fields: those of a message that are kept.
    every: of the messages with the same joints, the first of so many is kept.
    """

    def __init__(self, topic: str, fields: Sequence[str] = FIELDS, every: int = 1) -> None:
        self.topic, self.fields, self.every, self.count = topic, tuple(fields), every, 0
        self.decoder = Decoder(JOINT_STATE)
        self.by_joints: dict[tuple[str, ...], GrowingSeries] = {}
        self._seen: dict[tuple[str, ...], int] = {}  # messages by their joints, also those that are not kept

    def add(self, ordinals: np.ndarray, batch: Batch) -> None:
        """Decode the messages of a batch, which are the `ordinals`-th of the recording."""
        for index, layout, numbers in self.decoder.decode(batch):
            names = layout.texts["name"]
            given = {field: numbers.dtype[field].shape[0] for field in FIELDS if field in (numbers.dtype.names or ())}
            if not names or len(set(names)) < len(names) or set(given.values()) - {len(names)}:
                self.decoder.damaged += len(index)
                self.decoder.problem = _problem(names, given)
                continue
            seen = self._seen.get(names, 0)
            self._seen[names] = seen + len(index)
            index, numbers = (column[-seen % self.every :: self.every] for column in (index, numbers))
            if not len(index):
                continue
            stamp = numbers["header.stamp.sec"].astype(np.int64) * 1_000_000_000 + numbers["header.stamp.nanosec"]
            # float32 is 1000 times finer than a position code.
            values = np.full((len(index), len(self.fields), len(names)), np.nan, np.float32)
            with np.errstate(over="ignore", invalid="ignore"):
                for number, field in enumerate(self.fields):
                    if field in given:
                        values[:, number] = numbers[field]
            found = JointSeries(ordinals[index], batch.arrival[index], stamp, values)
            if names in self.by_joints:
                self.by_joints[names].add(found)
            else:
                self.by_joints[names] = GrowingSeries(found)
            self.count += len(index)

    @property
    def names(self) -> tuple[str, ...]:
        """The joints that most messages name; () without a message."""
        return max(self._seen, key=lambda names: self._seen[names], default=())

    def has(self, joints: Collection[str]) -> bool:
        """Return whether some messages have all of these joints."""
        return any(set(joints) <= set(names) for names in self.by_joints)

    def arrays(self, joints: Sequence[str]) -> tuple[JointSeries, int]:
        """Return the messages that have all `joints`, in their order, and the number of those that have not.

        They are forgotten then. Raises DataError if none has.
        """
        chosen: list[JointSeries] = []
        others = 0
        for names in [*self.by_joints]:
            found = self.by_joints.pop(names)
            if set(joints) <= set(names):
                series = found.trimmed()
                order = [names.index(joint) for joint in joints]
                is_same = names == tuple(joints)
                chosen.append(series if is_same else series._replace(values=series.values[:, :, order]))
            else:
                others += self._seen[names]
        if not chosen:
            raise DataError(f"{self.topic}: no message has the joints {', '.join(joints)}")
        columns = zip(*chosen, strict=True)
        series = chosen[0] if len(chosen) == 1 else JointSeries(*(np.concatenate(parts) for parts in columns))
        if np.any(np.diff(series.ordinal) < 0):
            series = series.of(np.argsort(series.ordinal, kind="stable"))
        return series, others
