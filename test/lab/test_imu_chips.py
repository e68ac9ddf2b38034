# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""IMUs that `imu` reads itself: chips on I2C behind Adafruit's drivers, and how each is opened again."""

import sys

import adafruit_icm20x
import adafruit_lsm6ds
import adafruit_mpu6050
import numpy as np
import pytest

from exo_gravity.core.errors import DeviceError, ParameterError
from exo_gravity.hardware.imu_source import Reopening
from exo_gravity.lab.imu_chips import PolledChip

from ..support.fake_chips import FAKES, FakeI2c, FakeTime, G

LSB = {"mpu6050": (1 / 16.4, 1 / 2048), "icm20948": (1 / 16.4, 1 / 2048), "lsm6dsox": (0.070, 0.488e-3)}  # deg/s, g


class ChipRig:
    def __init__(self, kind):
        self.time = FakeTime()
        self.chip = FAKES[kind](self.time)
        self.bus = FakeI2c(self.chip)
        self.values = {"source": kind, "rate": 100.0, "i2c.bus": 1, "i2c.address": 0}
        self.reopening = Reopening(self.open)
        self.attempts, self.opening_time = 0, 0.0

    def open(self, **values):
        self.attempts += 1
        self.time.wait(self.opening_time)
        self.bus.is_open = True
        return PolledChip(self.values | values, self.time)

    def read_for(self, duration, read=None, pause=0.005):
        """Return the samples of `duration` s; the thread of the node rests for `pause` s after each call."""
        samples, end = [], self.time() + duration
        while self.time() < end:
            self.time.wait(pause)
            samples += read() if read else self.reopening.read(self.time())
        return samples


@pytest.fixture(params=FAKES)
def rig(request, monkeypatch):
    """A rig of each chip; the drivers wait in its time."""
    rig = ChipRig(request.param)
    for module in (adafruit_icm20x, adafruit_lsm6ds, adafruit_mpu6050):
        monkeypatch.setattr(module, "sleep", rig.time.wait)
    monkeypatch.setattr("adafruit_extended_bus.ExtendedI2C", lambda number, frequency: rig.bus)
    rig.reopening.read(rig.time())  # opens it
    return rig


@pytest.mark.parametrize(
    ("turn", "force"),
    [((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), ((100.0, -200.0, 1900.0), (0.25, -0.5, 15.0))],
    ids=["level and at rest", "a fast motion does not clip"],
)
def test_each_axis_of_a_chip_has_its_scale_and_sign(rig, turn, force):
    rig.chip.angular_velocity, rig.chip.acceleration = lambda time: turn, lambda time: force
    sample = rig.read_for(0.05)[-1]
    of_rate, of_force = LSB[rig.values["source"]]
    assert np.degrees(sample.angular_velocity) == pytest.approx(turn, abs=1.6 * of_rate)
    assert np.divide(sample.acceleration, G) == pytest.approx(force, abs=1.6 * of_force)
    assert sample.orientation is None


@pytest.mark.parametrize("rate", [100.0, 200.0])
def test_samples_come_at_the_rate_and_their_time_is_that_of_their_reading(rig, rate):
    rig.chip.acceleration = lambda time: (4.0 * (time - 1000.0) - 8.0, 0.0, 1.0)  # shows the time, for up to 5 s
    source = rig.open(rate=rate)
    samples = rig.read_for(1.0, source.read, pause=0.45 / rate)
    assert len(samples) == pytest.approx(rate, abs=2) and source.lost == 0
    shown = [(sample.acceleration[0] / G + 8.0) / 4.0 + 1000.0 for sample in samples]
    ages = np.subtract([sample.time for sample in samples], shown)
    assert ages.min() > -5e-4 and ages.max() < 0.5 / rate + 5e-4  # 5e-4: an LSB


def test_readings_that_are_late_are_counted_as_lost(rig):
    source = rig.open()
    assert source.read()
    rig.time.wait(0.065)  # the next was due 0.01 s later
    assert len(source.read()) == 1
    assert source.lost == 5 and source.loss == "read too late"


def test_a_clock_that_is_set_back_is_followed(rig):
    source = rig.open()
    rig.read_for(0.1, source.read)
    rig.time.now -= 100.0
    assert len(rig.read_for(0.1, source.read)) == pytest.approx(10, abs=1) and source.lost == 0


def test_one_failed_transfer_costs_a_sample_and_no_reopening(rig):
    rig.read_for(0.1)
    rig.bus.failing = 1
    assert len(rig.read_for(0.2)) == pytest.approx(19, abs=1)
    assert rig.reopening.openings == 1 and rig.reopening.source.loss == "a transfer failed"


def test_an_unplugged_chip_is_an_error_that_names_it_and_comes_back_when_it_is_plugged_in(rig):
    assert rig.read_for(0.1)
    rig.bus.plugged = False
    with pytest.raises(DeviceError, match="does not answer: Remote I/O error") as error:  # at the second failed reading
        rig.read_for(0.025, rig.reopening.source.read)
    assert error.value.device == rig.reopening.source.name
    assert rig.read_for(3.0) == []
    assert rig.attempts - 1 == pytest.approx(6, abs=1)
    place = f"{rig.values['source']} at 0x{rig.chip.address:02X} on /dev/i2c-1"
    assert rig.reopening.problem == f"{place}: cannot be opened: No I2C device at address: 0x{rig.chip.address:x}"
    assert rig.reopening.openings == 1 and not rig.bus.is_open
    rig.chip.reset()
    rig.bus.plugged = True
    rig.read_for(0.6)
    samples = rig.read_for(0.5)
    assert len(samples) > 40 and samples[-1].acceleration[2] == pytest.approx(G, rel=1e-2)
    assert rig.reopening.problem == "" and rig.reopening.openings == 2


def test_the_time_that_opening_takes_is_not_silence(rig):
    reopening, rig.opening_time = Reopening(rig.open), 1.0
    reopening.read(rig.time())
    rig.chip.reset()
    assert len(rig.read_for(0.3, lambda: reopening.read(rig.time()))) <= 1
    assert reopening.openings == 1 and reopening.problem == ""


def test_a_chip_whose_values_are_stuck_is_closed_after_half_a_second_and_set_up_again(rig):
    rig.read_for(0.1)
    rig.chip.reset()  # a broken supply: it answers, but sleeps
    assert len(rig.read_for(0.45)) <= 1 and rig.reopening.problem == ""
    rig.read_for(0.1)
    assert "no sample for 0.5 s (its values do not change" in rig.reopening.problem and not rig.bus.is_open
    rig.read_for(0.5)
    assert rig.read_for(0.2)[-1].acceleration[2] == pytest.approx(G, rel=1e-2)
    assert rig.reopening.problem == "" and rig.reopening.openings == 2


WHO_AM_I = {"mpu6050": 0x75, "icm20948": 0x000, "lsm6dsox": 0x0F}
REFUSED = {
    "another chip": (
        lambda rig: rig.chip.registers.update({WHO_AM_I[rig.values["source"]]: 0x71}),
        r"Failed to find .* \(a chip of another kind is read by its ROS driver"),
    "another address": (lambda rig: setattr(rig.chip, "address", 0x6B), "No I2C device at address"),
    "a rate that it does not have": (
        lambda rig: rig.values.update(rate=500.0), r"rate = 500\.0: must be 250 or less"),
}  # fmt: skip


@pytest.mark.parametrize("wrong", REFUSED)
def test_what_cannot_be_opened_is_refused_with_what_to_use(rig, wrong):
    spoil, words = REFUSED[wrong]
    rig.reopening.close()
    assert not rig.bus.is_open
    spoil(rig)
    with pytest.raises(ParameterError if "rate" in wrong else DeviceError, match=words):
        rig.open()
    assert rig.bus.is_open == ("rate" in wrong)
    if rig.chip.address == 0x6B:
        assert "at 0x6B" in rig.open(**{"i2c.address": 0x6B}).name


def test_the_temperature_is_read_where_the_driver_reports_it(rig):
    source = rig.open()
    rig.read_for(0.1, source.read)
    expected = {"mpu6050": 26.03, "icm20948": None, "lsm6dsox": 26.0}[rig.values["source"]]
    assert source.temperature == (None if expected is None else pytest.approx(expected, abs=0.01))


def test_a_missing_library_is_a_parameter_error_that_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "adafruit_mpu6050", None)
    monkeypatch.setattr("adafruit_extended_bus.ExtendedI2C", lambda number, frequency: None)
    with pytest.raises(ParameterError, match=r"topic, or install the extra imu \(adafruit_mpu6050 is missing\)"):
        PolledChip({"source": "mpu6050", "rate": 100.0, "i2c.bus": 1, "i2c.address": 0}, FakeTime())
