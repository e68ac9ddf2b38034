"""Keeps an IMU open: after a failure it is opened again, with a pause between the attempts.

A state machine; the caller passes the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from exo_gravity.core.errors import DeviceError
from exo_gravity.core.trunk.imu_sample import ImuSample
from exo_gravity.hardware.imu_sources.source import ImuSource

PAUSE = 0.5  # s between two attempts
# s without a sample. A chip whose supply broke down for a moment answers, but sleeps.
MAX_SILENCE = 0.5


class Reopening:
    """One IMU that may be unplugged and plugged in again.

    problem: why there are no samples; '' while there are. openings: how often the device was opened.
    """

    def __init__(self, open_source: Callable[[bool], ImuSource]) -> None:
        """Create it closed; `open_source(self_test)` opens the device, and raises DeviceError if it cannot."""
        self.problem = "not opened yet"
        self.openings = 0
        self.source: ImuSource | None = None
        self._open_source = open_source
        self._tested = False
        self._retry_at = -math.inf
        self._heard_at = 0.0

    def read(self, now: float) -> list[ImuSample]:
        """Return the samples since the last call; open the device if it is closed and its pause is over.

        now: s, monotonic. Raises ParameterError if a parameter does not suit the device.
        """
        if self.source is None and now < self._retry_at:
            return []
        self._heard_at = min(self._heard_at, now)
        try:
            if self.source is None:
                # A self-test needs a sensor at rest: it is not repeated after a loose plug, when the wearer walks.
                self.source = self._open_source(not self._tested)
                self._tested, self._heard_at = True, math.inf  # opening takes time: silence counts from the next read
                self.openings += 1
            samples = self.source.read()
            if not samples and now - self._heard_at > MAX_SILENCE:
                raise DeviceError(self.source.name, f"no sample for {MAX_SILENCE:g} s ({self.source.silence})")
        except DeviceError as error:
            self.close()
            self.problem, self._retry_at = str(error), now + PAUSE
            return []
        if samples:
            self.problem, self._heard_at = "", now
        return samples

    def close(self) -> None:
        """Close the device."""
        if self.source is not None:
            self.source.close()
            self.source = None
