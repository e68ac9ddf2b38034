"""IMUs on I2C, against models of the chips that follow their data sheets."""

import math

import numpy as np
import pytest

from exo_gravity.core.errors import DeviceError
from exo_gravity.hardware.imu_sources import open_source
from exo_gravity.hardware.imu_sources.i2c import open_bus

from ..support.fake_imu.bus import FakeBus, FakeTime
from ..support.fake_imu.chip import G, Motion
from ..support.fake_imu.icm20948 import FakeIcm20948
from ..support.fake_imu.invensense import FakeMpu6050
from ..support.fake_imu.lsm6dsox import FakeLsm6dsox


def mpu9250(clock, motion=None, fast=1.0, **options):
    return FakeMpu6050(clock, motion, fast, who_am_i=0x71, **options)


# source, address, model, rates of 100 and 200 Hz, scale of an LSB in deg/s and mg
CHIPS = {
    "mpu6050": ("mpu6050", 0x68, FakeMpu6050, (100.0, 200.0), (1 / 16.4, 1 / 2.048)),
    "mpu9250": ("mpu6050", 0x68, mpu9250, (100.0, 200.0), (1 / 16.4, 1 / 2.048)),
    "icm20948": ("icm20948", 0x69, FakeIcm20948, (1125 / 11, 1125 / 6), (1 / 16.4, 1 / 2.048)),
    "lsm6dsox": ("lsm6dsox", 0x6A, FakeLsm6dsox, (104.0, 208.0), (0.070, 0.488)),
}


def turning():
    """A motion of which each axis differs in size and sign."""
    return Motion(lambda time: (100.0, -200.0, 1500.0), lambda time: (0.25, -0.5, 12.0), temperature=41.5)


class Rig:
    """A chip on a bus, and the source that reads it."""

    def __init__(self, chip, motion=None, fast=1.0, **options):
        kind, address, model, self.rates, self.lsb = CHIPS[chip]
        self.time = FakeTime()
        self.chip = model(self.time, motion, fast, **options)
        self.bus = FakeBus(self.chip, address)
        self.values = {"source": kind, "rate": 100.0, "i2c.bus": 1, "i2c.address": 0}

    def open(self, self_test=True, **values):
        return open_source(
            self.values | values, self.time, self_test, wait=self.time.wait, open_i2c=lambda number: self.bus
        )

    def read_for(self, source, duration, period=0.005):
        """Return the samples of `duration` s, read every `period` s."""
        samples = []
        for _ in range(round(duration / period)):
            self.time.wait(period)
            samples += source.read()
        return samples


@pytest.fixture(params=CHIPS)
def chip(request):
    """The name of each chip."""
    return request.param


def counting_motion(time):
    """An acceleration along x from which the time can be read, for up to 3 s."""
    return (4.0 * (time - 1000.0) - 8.0, 0.0, 1.0)


def test_each_axis_has_the_scale_and_sign_of_the_data_sheet(chip):
    rig = Rig(chip, turning())
    samples = rig.read_for(rig.open(self_test=False), 0.1)
    assert len(samples) >= 9
    for sample in samples:
        assert np.degrees(sample.angular_velocity) == pytest.approx((100, -200, 1500), abs=0.6 * rig.lsb[0])
        assert np.divide(sample.acceleration, G) * 1000 == pytest.approx((250, -500, 12000), abs=0.6 * rig.lsb[1])
        assert sample.orientation is None


def test_a_level_sensor_at_rest_measures_one_g_upward(chip):
    rig = Rig(chip)
    sample = rig.read_for(rig.open(), 0.05)[-1]
    assert sample.acceleration == pytest.approx((0, 0, G), rel=1e-3)
    assert sample.angular_velocity == (0, 0, 0)


@pytest.mark.parametrize("number", [0, 1])
def test_the_chip_has_the_rate_that_is_nearest_to_the_parameter(chip, number):
    rig = Rig(chip)
    source = rig.open(rate=(100.0, 200.0)[number])
    assert source.rate == pytest.approx(rig.rates[number])
    assert len(rig.read_for(source, 1.0)) == pytest.approx(rig.rates[number], abs=1.5)


def test_no_sample_is_lost_or_out_of_order_when_the_fifo_is_read_late(chip):
    rig = Rig(chip, Motion(acceleration=counting_motion))
    source = rig.open(self_test=False)
    taken = len(rig.chip.sampler.instants)
    samples = rig.read_for(source, 0.1)
    for delay in (0.001, 0.3, 0.002, 0.2, 0.25):
        rig.time.wait(delay)
        samples += source.read()
    instants = rig.chip.sampler.instants[taken:]
    assert len(samples) == len(instants) and source.lost == 0 and source.loss == ""
    expected = [G * counting_motion(instant)[0] for instant in instants]
    assert [sample.acceleration[0] for sample in samples] == pytest.approx(expected, abs=0.003)
    assert rig.bus.longest <= 32


def test_the_long_fifo_of_the_lsm6dsox_bridges_two_seconds_and_its_samples_are_never_half_new():
    rig = Rig("lsm6dsox", Motion(acceleration=counting_motion))
    source = rig.open(self_test=False)
    taken = len(rig.chip.sampler.instants)
    rig.time.wait(2.2)
    assert len(source.read()) == len(rig.chip.sampler.instants) - taken > 220 and source.loss == ""
    assert rig.chip.registers[0x12] == 0x44  # CTRL3_C: BDU, IF_INC


@pytest.mark.parametrize("fast", [0.96, 1.0, 1.04])
def test_stamps_follow_the_sensors_own_clock(chip, fast):
    rig = Rig(chip, fast=fast)
    source = rig.open()
    rig.read_for(source, 3.0)
    taken = len(rig.chip.sampler.instants)
    samples = rig.read_for(source, 2.0, period=0.0063)
    error = np.subtract([sample.time for sample in samples], rig.chip.sampler.instants[taken:])
    period = 1 / source.rate
    assert abs(error.mean()) < 0.5 * period and np.ptp(error) < 0.5 * period
    assert np.diff([sample.time for sample in samples]) == pytest.approx(period / fast, rel=0.1)


def test_an_overflow_is_reported_and_the_next_samples_are_whole(chip):
    rig = Rig(chip, turning())
    source = rig.open(self_test=False)
    rig.read_for(source, 0.2)
    rig.time.wait(6.0)
    assert source.read() == []
    samples = rig.read_for(source, 0.2)
    assert source.loss == "FIFO overflowed" and source.lost == pytest.approx(6.0 * source.rate, rel=0.01)
    assert np.degrees([sample.angular_velocity for sample in samples]) == pytest.approx(
        np.tile((100, -200, 1500), (len(samples), 1)), abs=0.6 * rig.lsb[0]
    )
    assert rig.time() - samples[-1].time < 2 / source.rate and np.all(np.diff([s.time for s in samples]) > 0)


def test_the_temperature_is_read(chip):
    rig = Rig(chip, turning())
    source = rig.open(self_test=False)
    source.read()
    assert source.temperature == pytest.approx(41.5, abs=0.01)
    rig.chip.motion.temperature = 20.0
    rig.read_for(source, 1.1)
    assert source.temperature == pytest.approx(20.0, abs=0.01)


@pytest.mark.parametrize(("chip", "register"), [("mpu6050", 0x75), ("icm20948", 0x00), ("lsm6dsox", 0x0F)])
def test_another_chip_is_refused_by_its_who_am_i(chip, register):
    rig = Rig(chip)
    rig.chip.registers[register] = 0x12
    with pytest.raises(
        DeviceError, match=rf"^{chip} at 0x6. on /dev/i2c-1, register 0x{register:02X}: WHO_AM_I is 0x12: must be 0x"
    ):
        rig.open()
    assert rig.bus.closed


def test_the_name_has_the_chip_its_address_and_its_bus():
    assert Rig("mpu9250").open().name == "MPU-9250 at 0x68 on /dev/i2c-1"


def test_a_missing_bus_is_named():
    with pytest.raises(DeviceError, match=r"^/dev/i2c-251: cannot be opened: No such file or directory$"):
        open_bus(251)


def test_the_address_can_be_set(chip):
    rig = Rig(chip)
    rig.bus.address = 0x6B
    with pytest.raises(DeviceError, match="does not answer: Remote I/O error"):
        rig.open()
    rig.bus.closed = False
    assert "at 0x6B" in rig.open(**{"i2c.address": 0x6B}).name


def test_an_unplugged_chip_is_an_error_that_names_device_and_register(chip):
    rig = Rig(chip)
    source = rig.open()
    rig.read_for(source, 0.1)
    rig.bus.plugged = False
    with pytest.raises(
        DeviceError, match=r"at 0x6. on /dev/i2c-1, register 0x..: does not answer: Remote I/O error$"
    ) as error:
        source.read()
    assert error.value.device == source.name and error.value.register is not None


@pytest.mark.parametrize("transfer", [0, 1, 2])
def test_a_disturbed_transfer_costs_the_samples_of_that_read_alone(chip, transfer):
    rig = Rig(chip, turning())
    source = rig.open(self_test=False)
    rig.read_for(source, 0.2)
    block = rig.bus.read_i2c_block_data
    calls = []

    def disturbed(*arguments):
        calls.append(arguments)
        if len(calls) == transfer + 1:
            rig.bus.disturbed = 1
        return block(*arguments)

    rig.bus.read_i2c_block_data = disturbed
    rig.time.wait(0.05)
    assert source.read() == []
    taken = len(rig.chip.sampler.instants)
    samples = rig.read_for(source, 0.2)
    assert source.loss == "a read failed" and source.lost == pytest.approx(0.05 * source.rate, abs=1)
    error = np.subtract([sample.time for sample in samples], rig.chip.sampler.instants[taken:])
    assert np.abs(error).max() < 1 / source.rate
    assert len(samples) == pytest.approx(0.2 * source.rate, abs=1)
    assert np.degrees([sample.angular_velocity for sample in samples]) == pytest.approx(
        np.tile((100, -200, 1500), (len(samples), 1)), abs=0.6 * rig.lsb[0]
    )


@pytest.mark.parametrize("chip", ["mpu6050", "mpu9250", "icm20948"])
def test_a_chip_whose_actuators_hardly_move_it_fails_its_self_test(chip):
    rig = Rig(chip, response=0.4)
    with pytest.raises(DeviceError, match=r"self-test failed: gyroscope x responds by .* LSB, must be"):
        rig.open()
    rig.bus.closed = False
    assert rig.read_for(rig.open(self_test=False), 0.1)


@pytest.mark.parametrize("response", [0.87, 1.13])
def test_an_mpu6050_may_differ_from_the_factorys_measurement_by_14_percent(response):
    assert Rig("mpu6050", response=response).open()
    with pytest.raises(DeviceError, match="self-test failed"):
        Rig("mpu6050", response=1.0 + 1.2 * (response - 1.0)).open()


@pytest.mark.parametrize(
    ("response", "sentence"),
    [
        (((400, 350, 300), (500, 30, 900)), "accelerometer y responds by 30 mg, must be 50 to 1700"),
        (((400, 350, 900), (500, 400, 900)), "gyroscope z responds by 900 deg/s, must be 150 to 700"),
    ],
)
def test_an_lsm6dsox_whose_actuators_do_not_move_it_as_they_should_fails_its_self_test(response, sentence):
    with pytest.raises(DeviceError, match=f"self-test failed: {sentence}"):
        Rig("lsm6dsox", response=response).open()


def test_a_chip_that_moves_while_it_is_tested_fails_and_says_to_keep_it_still():
    shaken = Motion(acceleration=lambda time: (0.5 * math.sin(5 * time), 0.0, 1.0))
    with pytest.raises(DeviceError, match="keep it still"):
        Rig("mpu6050", shaken).open()


def test_a_register_that_does_not_take_its_value_is_an_error():
    rig = Rig("mpu6050")
    write, rig.chip.write = rig.chip.write, lambda register, value: register == 0x1B or write(register, value)
    with pytest.raises(DeviceError, match="register 0x1B: holds 0x00 after 0x18 was written"):
        rig.open(self_test=False)


def test_an_icm20948_left_in_another_bank_is_found():
    rig = Rig("icm20948")
    rig.chip.bank = 2
    assert rig.open().name.startswith("ICM-20948")


def test_after_a_broken_supply_a_chip_sends_nothing_and_reports_no_samples(chip):
    rig = Rig(chip)
    source = rig.open()
    rig.read_for(source, 0.1)
    rig.chip.reset()
    assert rig.read_for(source, 0.6) == []
