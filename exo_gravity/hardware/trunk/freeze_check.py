"""Detects an IMU that repeats one measurement with new stamps: its tilt would be believed while the trunk moves.

Gyroscope and accelerometer of a MEMS IMU have noise, so their values differ from sample to sample (measured: no two
samples in a row were equal in 13,514). A vector of zeros does not count: some drivers fill in zeros for what the IMU
does not measure. A reported orientation does not count
either: filters round it, and at rest it can stay the same.
"""

from __future__ import annotations

from collections.abc import Sequence

from exo_gravity.core.errors import ParameterError

FROZEN_TIME = 0.1  # s of equal samples
FROZEN_SAMPLES = 10  # and at least this many

Reading = tuple[Sequence[float] | None, ...]


class FreezeCheck:
    """Compares the samples of one IMU."""

    def __init__(self) -> None:
        self._reading: Reading = ()
        self._since = 0.0
        self._count = 0

    def check(self, time: float, *vectors: Sequence[float] | None) -> None:
        """Check the reported `vectors` of the sample of `time` (s). Raises ParameterError once they are frozen."""
        if vectors != self._reading or time < self._since or not any(any(v) for v in vectors if v is not None):
            self._reading, self._since, self._count = vectors, time, 1
            return
        self._count += 1
        if self._count >= FROZEN_SAMPLES and time - self._since >= FROZEN_TIME:
            expected = "different from sample to sample, as noise makes them: the IMU or its driver is frozen"
            raise ParameterError(
                "angular_velocity and linear_acceleration", [list(v) for v in vectors if v is not None], expected
            )
