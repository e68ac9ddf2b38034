# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The true motion of the simulated arm at every physics step: in a file, for a judge in another process, or in memory.

The file is a sequence of records, of which `record_of` is the only description. They leave the process every
`FLUSH_PERIOD`; what was written stays when the process is frozen or killed.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import JOINT_COUNT


# time: wall clock in s. position, velocity: of the joints, rad and rad/s. torque: of the motors on the joints, Nm.
# damping: Nm s/rad, the part of that torque that is proportional to the velocity. weight: Nm that would hold the joints
# against gravity. wearer: Nm of the wearer on the joints. frames: received by each motor so far. step: of the wearer's
# script, -1 before it. on: whether each motor is on.
def record_of(count: int) -> np.dtype:
    """Return the type of a record of an arm with `count` joints."""
    return np.dtype(
        [
            ("time", "<f8"),
            ("position", "<f4", (count,)),
            ("velocity", "<f4", (count,)),
            ("torque", "<f4", (count,)),
            ("damping", "<f4", (count,)),
            ("weight", "<f4", (count,)),
            ("wearer", "<f4", (count,)),
            ("frames", "<u4", (count,)),
            ("step", "<i4"),
            ("on", "?", (count,)),
        ]
    )


RECORD = record_of(JOINT_COUNT)  # of the paper's arm
FLUSH_PERIOD = 0.02  # s


class TruthRecords:
    """Keeps the records in memory, by simulated time: for a judge in the same process."""

    def __init__(self) -> None:
        self._rows: list[tuple[Any, ...]] = []

    def synchronise(self, now: float) -> None:
        """Do nothing: the records have the simulated time."""

    def note(self, now: float, *state: Any) -> None:
        """Append the `state` of the arm at the simulated time `now` (s): the fields of RECORD from position on."""
        self._rows.append((now, *state))

    @property
    def records(self) -> np.ndarray:
        """All records so far, (n,) of RECORD."""
        records = np.empty(len(self._rows), record_of(len(self._rows[0][1])) if self._rows else RECORD)
        for name, column in zip(records.dtype.names or (), zip(*self._rows, strict=True), strict=False):
            records[name] = column
        return records


class TruthLog:
    """Writes the file at `path`. Raises ParameterError if it cannot be created."""

    def __init__(self, path: str | Path) -> None:
        try:
            self._file = open(path, "wb", buffering=0)  # noqa: SIM115, open as long as the process runs
        except OSError as error:
            raise ParameterError("truth", str(path), f"a file that can be written ({error.strerror})") from None
        self._rows = bytearray()
        self._record: np.dtype | None = None
        self._offset = 0.0  # wall clock minus simulated time, s
        self._flushed = 0.0

    def synchronise(self, now: float) -> None:
        """Note that the simulated time `now` (s) is the present time."""
        self._offset = time.time() - now

    def note(self, now: float, *state: Any) -> None:
        """Append the `state` of the arm at the simulated time `now` (s): the fields of RECORD from position on."""
        stamp = now + self._offset
        self._record = self._record or record_of(len(state[0]))
        self._rows += np.array((stamp, *state), self._record).tobytes()
        if abs(stamp - self._flushed) >= FLUSH_PERIOD:
            self._flushed = stamp
            self._file.write(self._rows)
            self._rows.clear()
