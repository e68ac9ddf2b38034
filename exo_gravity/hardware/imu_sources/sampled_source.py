"""What every source shares: measurements in, samples with stamps out."""

from __future__ import annotations

from typing import NamedTuple

from exo_gravity.core.trunk.imu_sample import ImuSample
from exo_gravity.hardware.imu_sources.sample_clock import SampleClock
from exo_gravity.hardware.imu_sources.source import Clock

Axes = tuple[float, float, float]


class Measurement(NamedTuple):
    """A sample without its time. skipped: samples before it that the device counted but that never arrived."""

    angular_velocity: Axes | None
    acceleration: Axes | None
    orientation: tuple[float, float, float, float] | None = None
    skipped: int = 0


class SampledSource:
    """Base of the sources; see `ImuSource`."""

    def __init__(self, name: str, rate: float, clock: Clock) -> None:
        self.name = name
        self.rate = rate
        self.lost = 0
        self.loss = ""
        self.temperature: float | None = None
        self.silence = "its supply may have broken down"
        self._why_lost = ""  # of samples that are not counted yet
        self._clock = clock
        self._sample_clock = SampleClock(rate)

    def read(self) -> list[ImuSample]:
        """Return every sample since the last call, the oldest first. Raises DeviceError."""
        arrival = self._clock()
        measurements = self._measure(arrival)
        stamps = self._sample_clock.stamps(arrival, [measurement.skipped for measurement in measurements])
        if self._sample_clock.lost > self.lost:
            self.lost, self.loss = self._sample_clock.lost, self._why_lost or "not read in time"
            self._why_lost = ""
        return [
            ImuSample(stamp, measurement.angular_velocity, measurement.acceleration, measurement.orientation)
            for stamp, measurement in zip(stamps, measurements, strict=True)
        ]

    def _measure(self, now: float) -> list[Measurement]:
        """Return what the device has measured since the last call, the oldest first."""
        raise NotImplementedError
