"""The true motion of the simulated arm, written to a file at every physics step, for a judge in another process.

The file is a sequence of `RECORD`, the only description of the format. Records leave the process every `FLUSH_PERIOD`;
what was written stays when the process is frozen or killed.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.sim.motor import SimulatedMotor

# time: wall clock in s. position, velocity: of the joints, rad and rad/s. torque: of the motors on the joints, Nm.
# damping: Nm s/rad, the part of that torque that is proportional to the velocity. wearer: Nm of the wearer on the
# joints. frames: received by each motor so far. step: of the wearer's script, -1 before it. on: whether each motor is
# on.
RECORD = np.dtype(
    [
        ("time", "<f8"),
        ("position", "<f4", JOINT_COUNT),
        ("velocity", "<f4", JOINT_COUNT),
        ("torque", "<f4", JOINT_COUNT),
        ("damping", "<f4", JOINT_COUNT),
        ("wearer", "<f4", JOINT_COUNT),
        ("frames", "<u4", JOINT_COUNT),
        ("step", "<i4"),
        ("on", "?", JOINT_COUNT),
    ]
)
_ROW = struct.Struct(f"<d{5 * JOINT_COUNT}f{JOINT_COUNT}Ii{JOINT_COUNT}?")
FLUSH_PERIOD = 0.02  # s


class TruthLog:
    """Writes the file at `path`. Raises ParameterError if it cannot be created."""

    def __init__(self, path: str | Path) -> None:
        try:
            self._file = open(path, "wb", buffering=0)  # noqa: SIM115, open as long as the process runs
        except OSError as error:
            raise ParameterError("truth", str(path), f"a file that can be written ({error.strerror})") from None
        self._rows = bytearray()
        self._offset = 0.0  # wall clock minus simulated time, s
        self._flushed = 0.0

    def synchronise(self, now: float) -> None:
        """Note that the simulated time `now` (s) is the present time."""
        self._offset = time.time() - now

    def note(
        self,
        now: float,
        position: Sequence[float],
        velocity: Sequence[float],
        torque: Sequence[float],
        motors: Sequence[SimulatedMotor],
        frames: Sequence[int],
        wearer: tuple[Sequence[float], int | None],
    ) -> None:
        """Append the state of the arm at the simulated time `now` (s); sequences are (4,); wearer: torque, step."""
        stamp, (given, step) = now + self._offset, wearer
        damping, entered = [motor.damping for motor in motors], [motor.entered for motor in motors]
        number = -1 if step is None else step
        self._rows += _ROW.pack(stamp, *position, *velocity, *torque, *damping, *given, *frames, number, *entered)
        if abs(stamp - self._flushed) >= FLUSH_PERIOD:
            self._flushed = stamp
            self._file.write(self._rows)
            self._rows.clear()
