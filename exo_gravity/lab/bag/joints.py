# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The joint states or efforts of one topic -> arrays of the joints of one arm.

Others publish there too: a gripper, or a driver of more joints. Messages are kept by the joints that they name, and
`arrays` takes those that have the joints of the arm.
"""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.content import JOINT_STATE
from exo_gravity.lab.bag.layout import Batch, Decoder

FIELDS = ("position", "velocity", "effort")


class JointSeries(NamedTuple):
    """Messages of one arm in the order of the file."""

    ordinal: np.ndarray  #: (n,) their numbers among all messages of the recording
    arrival: np.ndarray  #: (n,) ns since 1970
    stamp: np.ndarray  #: (n,) ns since 1970
    values: np.ndarray  #: (n, fields, joints), NaN where unknown

    def of(self, chosen: Any) -> "JointSeries":
        """Return the messages at the indices, in the slice or under the mask `chosen`."""
        return JointSeries(*(column[chosen] for column in self))


def joined(parts: Sequence[JointSeries]) -> JointSeries:
    """Return parts, of which there is at least one, as one."""
    return JointSeries(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class JointArrays:
    """Collects the joint states of one topic: `count`, and as `parts` by the joints, in order of appearance.

    fields: those of a message that are kept.
    every: of the messages with the same joints, the first of so many is kept.
    """

    def __init__(self, topic: str, fields: Sequence[str] = FIELDS, every: int = 1) -> None:
        self.topic, self.fields, self.every, self.count = topic, tuple(fields), every, 0
        self.decoder = Decoder(JOINT_STATE)
        self.parts: dict[tuple[str, ...], list[JointSeries]] = {}
        self._seen: dict[tuple[str, ...], int] = {}  # messages by their joints, also those that are not kept

    def add(self, ordinals: np.ndarray, batch: Batch) -> None:
        """Decode the messages of a batch, which are the `ordinals`-th of the recording."""
        for index, layout, numbers in self.decoder.decode(batch):
            names = layout.texts["name"]
            given = {field: numbers.dtype[field].shape[0] for field in FIELDS if field in (numbers.dtype.names or ())}
            if not names or len(set(names)) < len(names) or set(given.values()) - {len(names)}:
                self.decoder.damaged += len(index)
                self.decoder.problem = f"a joint state has {given} values for the joints {', '.join(names)}"
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
            part = JointSeries(ordinals[index], batch.arrival[index], stamp, values)
            self.parts.setdefault(names, []).append(part)
            self.count += len(index)

    @property
    def names(self) -> tuple[str, ...]:
        """The joints that most messages name; () without a message."""
        return max(self._seen, key=lambda names: self._seen[names], default=())

    def has(self, joints: Collection[str]) -> bool:
        """Return whether some messages have all of these joints."""
        return any(set(joints) <= set(names) for names in self.parts)

    def arrays(self, joints: Sequence[str]) -> tuple[JointSeries, int]:
        """Return the messages that have all `joints`, in their order, and the number of those that have not.

        They are forgotten then. Raises DataError if none has.
        """
        chosen: list[JointSeries] = []
        others = 0
        for names, parts in self.parts.items():
            if set(joints) <= set(names):
                order = [names.index(joint) for joint in joints]
                is_same = names == tuple(joints)
                chosen += parts if is_same else [part._replace(values=part.values[:, :, order]) for part in parts]
            else:
                others += self._seen[names]
        self.parts = {}
        if not chosen:
            raise DataError(f"{self.topic}: no message has the joints {', '.join(joints)}")
        series = joined(chosen)
        if np.any(np.diff(series.ordinal) < 0):
            series = series.of(np.argsort(series.ordinal, kind="stable"))
        return series, others
