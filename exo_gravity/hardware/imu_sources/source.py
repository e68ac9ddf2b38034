"""What every source of IMU samples shares: their stamps, and an IMU that is unplugged and plugged in again."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from exo_gravity.core.errors import DeviceError
from exo_gravity.core.trunk.imu_checks import ImuSample

RADIANS_PER_DEGREE = math.pi / 180.0

PHASE_GAIN = 0.05  # share of the error that one sample corrects: settles in about 40 samples
PERIOD_GAIN = PHASE_GAIN**2 / 4  # critically damped
MAX_DRIFT = 0.1  # share by which the sensor's period may differ from the nominal one
MAX_SLIP = 10  # periods between prediction and arrival, beyond which samples were lost or the clock was set

PAUSE = 0.5  # s between two attempts to open a device
MAX_SILENCE = 0.5  # s without a sample. A chip whose supply broke down for a moment answers, but sleeps.

Clock = Callable[[], float]  # s; the clock of the stamps
Axes = tuple[float, float, float]


class Measurement(NamedTuple):
    """A sample without its time."""

    angular_velocity: Axes | None
    acceleration: Axes | None
    orientation: tuple[float, float, float, float] | None = None
    #: samples before it that the device counted but that never arrived
    skipped: int = 0


class ImuSource:
    """Base of the sources: an open device. Its samples are in its own axes, with the time at which they were taken."""

    def __init__(self, name: str, rate: float, clock: Clock) -> None:
        self.name = name  #: the device and its address, for messages
        self.rate = rate  #: samples a second, as set up
        self.lost = 0  #: samples known to be lost since the device was opened
        self.loss = ""  #: why the last of them were
        self.temperature: float | None = None  #: degrees Celsius; None if not reported
        self.silence = "its supply may have broken down"  #: what may be the reason while no samples come
        self._why_lost = ""  # of samples that are not counted yet
        self._clock = clock
        self._sample_clock = SampleClock(rate)

    def read(self) -> list[ImuSample]:
        """Return every sample since the last call, the oldest first, without waiting for one. Raises DeviceError."""
        arrival = self._clock()
        measurements = [measured for packet in self._packets(arrival) if (measured := self._decode(packet))]
        stamps = self._sample_clock.stamps(arrival, [measurement.skipped for measurement in measurements])
        if self._sample_clock.lost > self.lost:
            self.lost, self.loss = self._sample_clock.lost, self._why_lost or "not read in time"
            self._why_lost = ""
        return [ImuSample(stamp, *measured[:3]) for stamp, measured in zip(stamps, measurements, strict=True)]

    def close(self) -> None:
        """Release the device; never raises."""
        raise NotImplementedError

    def _packets(self, now: float) -> list[bytes]:
        """Return the packets that the device has sent since the last call, the oldest first."""
        raise NotImplementedError

    def _decode(self, packet: bytes) -> Measurement | None:
        """Return the measurement that a packet completes."""
        raise NotImplementedError


class SampleClock:
    """Stamps samples that arrive in batches: spaced by the sensor's own clock, disciplined to ours.

    A sensor's oscillator is off by up to 5 %, and a batch is read up to one period, or a scheduling delay, after its
    newest sample. A phase-locked loop follows the sensor's period, so that this jitter does not reach the stamps.
    """

    def __init__(self, rate: float) -> None:
        self.lost = 0  #: samples that never came, by the gaps that they left
        self._nominal = self._period = 1.0 / rate
        self._last: float | None = None  # stamp of the newest sample
        self._is_interrupted = False

    def interrupt(self) -> None:
        """Note that an unknown number of samples is lost before the next one."""
        self._is_interrupted = True

    def stamps(self, arrival: float, skipped: Sequence[int]) -> list[float]:
        """Return a stamp in s for each sample of a batch, rising and at most `arrival`.

        arrival: s, when the newest sample was there. skipped: for each sample, how many before it are known lost.
        """
        if not skipped:
            return []
        self.lost += sum(skipped)
        positions = list(itertools.accumulate(missing + 1 for missing in skipped))
        start, self._last = self._span(arrival, positions[-1])
        step = (self._last - start) / positions[-1]
        return [start + position * step for position in positions]

    def _span(self, arrival: float, steps: int) -> tuple[float, float]:
        """Return the stamp before the first and that of the last of `steps` periods."""
        if self._last is not None:
            predicted = self._last + steps * self._period
            # On average the newest sample is half a period old.
            error = arrival - self._period / 2 - predicted
            if abs(error) <= MAX_SLIP * self._period and not self._is_interrupted:
                period = self._period + PERIOD_GAIN * error * min(steps, MAX_SLIP)
                self._period = min(max(period, self._nominal * (1 - MAX_DRIFT)), self._nominal * (1 + MAX_DRIFT))
                return self._last, min(predicted + min(0.5, PHASE_GAIN * steps) * error, arrival)
            self.lost += max(0, round(error / self._period))
        self._is_interrupted = False
        newest = arrival - self._period / 2
        start = newest - steps * self._period
        if self._last is None or self._last >= arrival:  # the clock was set back
            return start, newest
        return max(start, self._last), max(newest, (self._last + arrival) / 2)


class Reopening:
    """Keeps an IMU open that may be unplugged: after a failure it is opened again, with a pause between attempts."""

    def __init__(self, open_source: Callable[[bool], ImuSource]) -> None:
        """Create it closed; `open_source(self_test)` opens the device, and raises DeviceError if it cannot."""
        self.problem = "not opened yet"  #: why there are no samples; '' while there are
        self.openings = 0  #: how often the device was opened
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
