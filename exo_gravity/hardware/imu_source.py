# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An IMU that the node `imu` reads itself, and one that is opened again after it was unplugged.

An entry point of the group GROUP (core/trunk/checks.py) names what opens it, given the parameters' values and the clock
of the stamps; its name is that of the parameter `source`. It raises DeviceError, and ParameterError if a value does not
suit the device. Ours are chips (lab/imu_chips.py).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from exo_gravity.core.errors import DeviceError
from exo_gravity.core.trunk.checks import ImuSample

StampClock = Callable[[], float]  # s; the clock of the stamps
Axes = tuple[float, float, float]


class ImuSource(ABC):
    """An open IMU. A new kind needs `read`, `close`, and an entry point."""

    lost = 0  #: samples known to be lost since the device was opened
    loss = ""  #: why the last of them were
    temperature: float | None = None  #: degrees Celsius; None: not reported
    silence = "its supply may have broken down"  #: the probable reason while no samples come

    def __init__(self, name: str) -> None:
        self.name = name  #: the device and its address, for messages

    @abstractmethod
    def read(self) -> list[ImuSample]:
        """Return every sample since the last call, the oldest first, without waiting for one.

        The samples are in the IMU's own axes, with the time at which each was taken. Raises DeviceError.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the device; never raises."""


@dataclass(frozen=True)
class ReopeningTimes:
    """When a device is opened again, in s."""

    pause: float = 0.5  #: between two attempts
    longest_silence: float = 0.5  #: without a sample: a device whose supply broke down may answer, but asleep


class Reopening:
    """Keeps an IMU open that may be unplugged: after a failure it is opened again, with a pause between attempts."""

    times = ReopeningTimes()

    def __init__(self, open_source: Callable[[], ImuSource]) -> None:
        """Create it closed; `open_source` opens the device, and raises DeviceError if it cannot."""
        self.problem = "not opened yet"  #: why there are no samples; '' while there are
        self.openings = 0  #: how often the device was opened
        self.source: ImuSource | None = None
        self._open_source = open_source
        self._retry_at = -math.inf
        self._heard_at = 0.0

    def read(self, now: float) -> list[ImuSample]:
        """Return the samples since the last call, or open the device if it is closed and its pause is over.

        now: s, monotonic. Raises ParameterError if a parameter does not suit the device.
        """
        if self.source is None and now < self._retry_at:
            return []
        self._heard_at = min(self._heard_at, now)
        try:
            if self.source is None:
                self.source = self._open_source()
                self._heard_at = math.inf  # opening takes time: silence counts from the next call
                self.openings += 1
                return []
            samples = self.source.read()
            silence = self.times.longest_silence
            if not samples and now - self._heard_at > silence:
                raise DeviceError(self.source.name, f"no sample for {silence:g} s ({self.source.silence})")
        except DeviceError as error:
            self.close()
            self.problem, self._retry_at = str(error), now + self.times.pause
            return []
        if samples:
            self.problem, self._heard_at = "", now
        return samples

    def close(self) -> None:
        """Close the device."""
        if self.source is not None:
            self.source.close()
            self.source = None
