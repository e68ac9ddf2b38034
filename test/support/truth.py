# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Reads the truth log of a simulated device while it grows; exo_gravity/sim/device.py describes the format."""

from pathlib import Path

import numpy as np

from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.sim.device import record_of


class Truth:
    """The truth log at `path`, of an arm with so many joints."""

    def __init__(self, path: Path, joints: int = JOINT_COUNT) -> None:
        self.path = path
        self._record = record_of(joints)

    @property
    def count(self) -> int:
        """How many records there are; 0 without a file."""
        return self.path.stat().st_size // self._record.itemsize if self.path.exists() else 0

    def newest(self) -> np.ndarray | None:
        """Return the newest record, None if there is none."""
        count = self.count
        return self._read(count - 1, count)[0] if count else None

    def since(self, time: float) -> np.ndarray:
        """Return the records from `time` (wall clock, s) on."""
        records = self._read(0, self.count)
        return records[records["time"] >= time]

    def motors_are_off(self) -> bool:
        """Return whether no motor is on."""
        newest = self.newest()
        return newest is not None and not newest["on"].any()

    def _read(self, start: int, end: int) -> np.ndarray:
        if end <= start:
            return np.empty(0, self._record)
        return np.fromfile(self.path, self._record, end - start, offset=start * self._record.itemsize)
