"""An IMU that is unplugged and plugged in again, and the stamps of its samples."""

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.imu_sources import Reopening, open_source
from exo_gravity.hardware.imu_sources.source import SampleClock

from ..support.fake_imu.bus import FakeBus, FakeTime
from ..support.fake_imu.invensense import FakeMpu6050


class Rig:
    """An MPU-6050 that is kept open."""

    def __init__(self):
        self.time = FakeTime()
        self.chip = FakeMpu6050(self.time)
        self.bus = FakeBus(self.chip, 0x68)
        self.self_tests = []
        self.reopening = Reopening(self.open)

    def open(self, self_test):
        self.self_tests.append(self_test)
        self.bus.closed = False
        values = {"source": "mpu6050", "rate": 100.0, "i2c.bus": 1, "i2c.address": 0}
        return open_source(values, self.time, self_test, wait=self.time.wait, open_i2c=lambda number: self.bus)

    def read_for(self, duration):
        samples = []
        for _ in range(round(duration / 0.01)):
            self.time.wait(0.01)
            samples += self.reopening.read(self.time())
        return samples


@pytest.fixture
def rig():
    """An MPU-6050 that has been read for 0.2 s."""
    rig = Rig()
    assert rig.read_for(0.2) and rig.reopening.problem == ""
    return rig


def test_a_sensor_that_is_plugged_in_again_comes_back_by_itself(rig):
    rig.bus.plugged = False
    assert rig.read_for(2.0) == []
    assert "at 0x68 on /dev/i2c-1" in rig.reopening.problem and "does not answer" in rig.reopening.problem
    assert rig.reopening.openings == 1
    rig.chip.reset()  # without supply it forgets its registers
    rig.bus.plugged = True
    assert len(rig.read_for(1.0)) > 20
    assert rig.reopening.problem == "" and rig.reopening.openings == 2


def test_attempts_are_half_a_second_apart(rig):
    rig.bus.plugged = False
    rig.read_for(3.0)
    assert len(rig.self_tests) - 1 == pytest.approx(6, abs=1)


def test_the_self_test_runs_until_it_has_passed_once_and_not_when_the_wearer_may_walk(rig):
    rig.bus.plugged = False
    rig.read_for(1.0)
    rig.bus.plugged = True
    rig.read_for(1.0)
    assert rig.self_tests[0] and not any(rig.self_tests[1:])


def test_a_chip_that_answers_but_sleeps_is_set_up_again(rig):
    rig.chip.reset()
    assert rig.read_for(0.4) == [] and rig.reopening.problem == ""
    rig.read_for(0.2)
    assert rig.reopening.problem.endswith("no sample for 0.5 s (its supply may have broken down)")
    assert rig.read_for(1.0) and rig.reopening.problem == ""


def test_the_time_that_opening_takes_is_not_silence():
    rig = Rig()
    rig.reopening.read(rig.time())  # opens, and tests for a second
    rig.time.wait(0.001)
    assert rig.reopening.read(rig.time()) == [] and rig.reopening.openings == 1
    assert rig.read_for(0.1) and rig.reopening.openings == 1


def test_a_sensor_that_is_missing_at_the_start_is_opened_when_it_appears():
    rig = Rig()
    rig.bus.plugged = False
    assert rig.read_for(1.0) == [] and rig.reopening.openings == 0
    rig.bus.plugged = True
    assert rig.read_for(1.5) and rig.reopening.openings == 1


def test_a_wrong_parameter_is_not_retried():
    def refuse(self_test):
        raise ParameterError("serial.baud", 9600, "44000 or more")

    with pytest.raises(ParameterError, match=r"serial\.baud"):
        Reopening(refuse).read(0.0)


def test_closing_closes_the_device(rig):
    rig.reopening.close()
    assert rig.bus.closed and rig.reopening.source is None


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


def test_a_gap_is_counted_and_the_stamps_resume_at_the_present():
    clock, stamps = stamped([1.0, 1.01, 1.02, 2.02], [1, 1, 1, 1])
    assert clock.lost == 99 and stamps[3][0] == pytest.approx(2.015)


def test_after_an_interruption_stamps_still_rise_and_never_precede_the_last_one():
    clock = SampleClock(100.0)
    stamps = clock.stamps(1.0, [0]) + clock.stamps(1.01, [0])
    clock.interrupt()
    stamps += clock.stamps(1.012, [0]) + clock.stamps(1.02, [0])
    assert np.all(np.diff(stamps) > 0) and stamps[-1] < 1.02


def test_a_clock_that_is_set_back_is_followed_at_once():
    clock, stamps = stamped([1000.0, 1000.01, 500.0, 500.01], [1, 1, 1, 1])
    assert clock.lost == 0 and stamps[2][0] == pytest.approx(499.995)
