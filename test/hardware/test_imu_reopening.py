# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An IMU that is unplugged and plugged in again, and the stamps of samples that arrive in batches."""

import numpy as np
import pytest

from exo_gravity.core.errors import DeviceError, ParameterError
from exo_gravity.core.trunk.imu_checks import ImuSample
from exo_gravity.hardware.imu_sources import ImuSource, Reopening
from exo_gravity.hardware.imu_sources.sample_clock import SampleClock

PERIOD = 0.01  # s


class Imu:
    """An IMU with a plug, kept open, in its own time."""

    def __init__(self):
        self.now, self.attempts, self.closed = 0.0, 0, 0
        self.plugged, self.silent, self.opening_time = True, False, 0.0
        self.reopening = Reopening(self.open)

    def open(self):
        self.attempts += 1
        self.now += self.opening_time
        return Source(self)

    def read_for(self, duration):
        samples = []
        for _ in range(round(duration / PERIOD)):
            self.now += PERIOD
            samples += self.reopening.read(self.now)
        return samples


class Source(ImuSource):
    """It gives a sample at each reading."""

    def __init__(self, imu):
        super().__init__("imu on its plug")
        self.imu = imu
        self._check()

    def read(self):
        self._check()
        return [] if self.imu.silent else [ImuSample(self.imu.now, (0, 0, 0), (0, 0, 9.8))]

    def close(self):
        self.imu.closed += 1

    def _check(self):
        if not self.imu.plugged:
            raise DeviceError(self.name, "does not answer")


@pytest.fixture
def imu():
    """An IMU that has been read for 0.2 s."""
    imu = Imu()
    assert imu.read_for(0.2) and imu.reopening.problem == ""
    return imu


def test_a_sensor_that_is_plugged_in_again_comes_back_by_itself(imu):
    imu.plugged = False
    assert imu.read_for(2.0) == []
    assert imu.reopening.problem == "imu on its plug: does not answer" and imu.reopening.openings == 1
    imu.plugged = True
    assert len(imu.read_for(1.0)) > 40
    assert imu.reopening.problem == "" and imu.reopening.openings == 2


def test_attempts_are_half_a_second_apart(imu):
    imu.plugged = False
    imu.read_for(3.0)
    assert imu.attempts - 1 == pytest.approx(6, abs=1)


def test_a_sensor_that_sends_nothing_is_closed_and_opened_again(imu):
    imu.silent = True
    assert imu.read_for(0.45) == [] and imu.reopening.problem == ""
    imu.read_for(0.1)
    assert imu.reopening.problem == "imu on its plug: no sample for 0.5 s (its supply may have broken down)"
    assert imu.closed == 1
    imu.silent = False
    assert imu.read_for(1.0) and imu.reopening.problem == ""


def test_the_time_that_opening_takes_is_not_silence():
    imu = Imu()
    imu.opening_time, imu.silent = 1.0, True
    imu.read_for(0.3)
    assert imu.reopening.openings == 1 and imu.closed == 0


def test_a_sensor_that_is_missing_at_the_start_is_opened_when_it_appears():
    imu = Imu()
    imu.plugged = False
    assert imu.read_for(1.0) == [] and imu.reopening.openings == 0
    imu.plugged = True
    assert imu.read_for(1.5) and imu.reopening.openings == 1


def test_a_wrong_parameter_is_not_retried():
    def refuse():
        raise ParameterError("serial.baud", 9600, "44000 or more")

    with pytest.raises(ParameterError, match=r"serial\.baud"):
        Reopening(refuse).read(0.0)


def test_closing_closes_the_device(imu):
    imu.reopening.close()
    assert imu.closed == 1 and imu.reopening.source is None


def stamped(arrivals, counts, rate=100.0):
    clock = SampleClock(rate)
    return clock, [clock.stamps(arrival, [0] * count) for arrival, count in zip(arrivals, counts, strict=True)]


def test_jitter_of_the_arrival_hardly_reaches_the_stamps():
    arrivals = np.arange(1, 501) * 0.01 + np.random.default_rng(1).uniform(0, 0.008, 500)
    clock, stamps = stamped(arrivals, [1] * 500)
    steps = np.diff(np.concatenate(stamps))[100:]
    assert np.ptp(steps) < 0.002 and steps.mean() == pytest.approx(0.01, rel=0.01) and clock.lost == 0


def test_no_stamp_is_later_than_its_arrival_and_stamps_rise():
    rng = np.random.default_rng(2)
    counts = rng.integers(0, 4, 400)
    arrivals = 0.0101 * np.cumsum(counts) + 0.001 * np.arange(400) + 1.0
    _, stamps = stamped(arrivals, counts.tolist())
    assert all(batch[-1] <= arrival for batch, arrival in zip(stamps, arrivals, strict=True) if batch)
    assert np.all(np.diff(np.concatenate([batch for batch in stamps if batch])) > 0)


def test_a_sensor_whose_own_clock_is_five_percent_fast_is_followed():
    arrivals = 1.0 + np.arange(1, 1001) * 0.01 / 1.05
    _, stamps = stamped(arrivals, [1] * 1000)
    late = np.subtract(arrivals, np.concatenate(stamps))[500:]
    assert late.min() >= 0.0 and late.max() < 0.01


def test_a_gap_is_counted_and_the_stamps_resume_at_the_present():
    clock, stamps = stamped([1.0, 1.01, 1.02, 2.02], [1, 1, 1, 1])
    assert clock.lost == 99 and stamps[3][0] == pytest.approx(2.015)


def test_a_clock_that_is_set_back_is_followed_at_once():
    clock, stamps = stamped([1000.0, 1000.01, 500.0, 500.01], [1, 1, 1, 1])
    assert clock.lost == 0 and stamps[2][0] == pytest.approx(499.995)
