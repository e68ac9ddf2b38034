# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The joint states or efforts of one topic -> arrays of the joints of one arm.

Others publish there too: a gripper, or a driver of more joints. Messages are kept by the joints that they name, and
`arrays` takes those that have the joints of the arm.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.lab.bag.content import JOINT_STATE
from exo_gravity.lab.bag.layout import Batch, Decoder

FIELDS = ("position", "velocity", "effort")


class JointSeries(NamedTuple):
    """Messages of one arm in the order of the file."""

    ordinal: np.ndarray  #: (n,) their numbers among all messages of the recording
    arrival: np.ndarray  #: (n,) ns since 1970
    stamp: np.ndarray  #: (n,) ns since 1970
    values: np.ndarray  #: (n, fields, joints), NaN where unknown


class JointArrays(Decoder):
    """Collects the joint states of one topic by their joints, in order of appearance.

    fields: those of a message that are kept.
    every: of the messages with the same joints, the first of so many is kept.
    """

    def __init__(self, topic: str, fields: Sequence[str] = FIELDS, every: int = 1) -> None:
        super().__init__(JOINT_STATE)
        self.topic, self.fields, self.every = topic, tuple(fields), every
        self._seen: dict[tuple[str, ...], int] = {}  # messages by their joints, also those that are not kept
        # Columns grow in place: parts that are joined in the end need twice the memory.
        self._kept: dict[tuple[str, ...], list[bytearray]] = {}

    def add(self, batch: Batch) -> None:
        """Decode the messages of a batch."""
        for rows, layout, numbers in self.decode(batch):
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
            for column, found in zip(columns, (batch.ordinal[rows], batch.arrival[rows], stamp, values), strict=True):
                column += found.tobytes()

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
