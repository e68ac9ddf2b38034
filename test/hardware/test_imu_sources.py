# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""IMUs that `imu` reads itself: chips on I2C behind Adafruit's drivers, sensors on serial ports by real pyserial.

And how each is opened again after it was unplugged, and how samples that arrive in batches are stamped.
"""

import math
import sys

import adafruit_icm20x
import adafruit_lsm6ds
import adafruit_mpu6050
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exo_gravity.core.errors import DeviceError, ParameterError
from exo_gravity.hardware.imu_sources import Reopening, open_source
from exo_gravity.hardware.imu_sources.sample_clock import SampleClock

from ..support.fake_imu.chips import FAKES, FakeI2c, FakeTime, G
from ..support.fake_imu.serial import FakeSerialSensor, rvc_packet, witmotion_packet

# Chips on I2C, which answer byte by byte.

LSB = {"mpu6050": (1 / 16.4, 1 / 2048), "icm20948": (1 / 16.4, 1 / 2048), "lsm6dsox": (0.070, 0.488e-3)}  # deg/s, g


class ChipRig:
    """A chip on a bus, and the source that reads it."""

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
        return open_source(self.values | values, self.time)

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


def test_a_chip_that_is_missing_at_the_start_is_opened_when_it_appears(rig):
    reopening, rig.bus.plugged = Reopening(rig.open), False
    assert rig.read_for(1.0, lambda: reopening.read(rig.time())) == [] and reopening.openings == 0
    rig.bus.plugged = True
    assert rig.read_for(1.5, lambda: reopening.read(rig.time())) and reopening.openings == 1


def test_the_time_that_opening_takes_is_not_silence(rig):
    reopening, rig.opening_time = Reopening(rig.open), 1.0
    reopening.read(rig.time())
    rig.chip.reset()
    assert len(rig.read_for(0.3, lambda: reopening.read(rig.time()))) <= 1
    assert reopening.openings == 1 and reopening.problem == ""


def test_closing_closes_the_device(rig):
    rig.reopening.close()
    assert not rig.bus.is_open and rig.reopening.source is None


def test_an_unplugged_chip_is_noticed_at_the_second_failed_reading(rig):
    source = rig.open()
    rig.read_for(0.1, source.read)
    rig.bus.plugged = False
    with pytest.raises(DeviceError, match="does not answer: Remote I/O error") as error:
        rig.read_for(0.025, source.read)
    assert error.value.device == source.name


def test_a_chip_whose_values_are_stuck_is_closed_after_half_a_second_and_set_up_again(rig):
    rig.read_for(0.1)
    rig.chip.reset()  # a broken supply: it answers, but sleeps
    assert len(rig.read_for(0.45)) <= 1 and rig.reopening.problem == ""
    rig.read_for(0.1)
    assert "no sample for 0.5 s (its values do not change" in rig.reopening.problem and not rig.bus.is_open
    rig.read_for(0.5)
    assert rig.read_for(0.2)[-1].acceleration[2] == pytest.approx(G, rel=1e-2)
    assert rig.reopening.problem == "" and rig.reopening.openings == 2


def test_another_chip_is_refused_with_what_to_use(rig):
    who_am_i = {"mpu6050": 0x75, "icm20948": 0x000, "lsm6dsox": 0x0F}[rig.values["source"]]
    rig.chip.registers[who_am_i] = 0x71
    with pytest.raises(DeviceError, match=r"Failed to find .* \(a chip of another kind is read by its ROS driver"):
        rig.open()
    assert not rig.bus.is_open


def test_the_address_can_be_set(rig):
    rig.chip.address = 0x6B
    with pytest.raises(DeviceError, match="No I2C device at address"):
        rig.open()
    assert "at 0x6B" in rig.open(**{"i2c.address": 0x6B}).name


def test_the_temperature_is_read_where_the_driver_reports_it(rig):
    source = rig.open()
    rig.read_for(0.1, source.read)
    expected = {"mpu6050": 26.03, "icm20948": None, "lsm6dsox": 26.0}[rig.values["source"]]
    assert source.temperature == (None if expected is None else pytest.approx(expected, abs=0.01))


def test_a_wrong_parameter_is_not_retried(rig):
    rig.values["rate"] = 500.0
    with pytest.raises(ParameterError, match=r"rate = 500\.0: must be 250 or less"):
        Reopening(rig.open).read(rig.time())


def test_a_missing_bus_is_named():
    with pytest.raises(DeviceError, match=r"^mpu6050 at 0x68 on /dev/i2c-251: cannot be opened: No device found"):
        open_source({"source": "mpu6050", "rate": 100.0, "i2c.bus": 251, "i2c.address": 0}, FakeTime())


def test_a_missing_library_is_a_parameter_error_that_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "adafruit_mpu6050", None)
    monkeypatch.setattr("adafruit_extended_bus.ExtendedI2C", lambda number, frequency: None)
    with pytest.raises(ParameterError, match=r"topic, or install the extra imu \(adafruit_mpu6050 is missing\)"):
        open_source({"source": "mpu6050", "rate": 100.0, "i2c.bus": 1, "i2c.address": 0}, FakeTime())


# Sensors on serial ports.

# The example of the BNO080's data sheet, 1.3.5.2.
DATA_SHEET_EXAMPLE = bytes.fromhex("AA AA DE 01 00 92 FF 25 08 8D FE EC FF D1 03 00 00 00 E7")


class SerialRig:
    """A sensor on a pseudo-terminal, and the source that reads it."""

    def __init__(self, port, kind):
        self.time = FakeTime()
        self.sensor = FakeSerialSensor(port)
        self.values = {"source": kind, "rate": 100.0, "serial.port": str(port), "serial.baud": 115200}

    def open(self, **values):
        return open_source(self.values | values, self.time)

    def read(self, source, data, delay=0.01):
        """Send `data` `delay` s after the last time, and return the samples."""
        self.time.wait(delay)
        self.sensor.deliver(data)
        return source.read()


@pytest.fixture
def make_rig(tmp_path):
    """A function that makes a rig of a kind."""
    rigs = []

    def make_rig(kind):
        rigs.append(SerialRig(tmp_path / "imu", kind))
        return rigs[-1]

    yield make_rig
    for rig in rigs:
        rig.sensor.unplug()


def witmotion_cycle(acceleration=(0, 0, 2048), angular_velocity=(0, 0, 0), quaternion=(32767, 0, 0, 0), angles=None):
    """Return the packets of one sample, in the sensor's numbers; the quaternion is w, x, y, z; None leaves one out."""
    packets = witmotion_packet(0x51, *acceleration, 2515) + witmotion_packet(0x52, *angular_velocity, 0)
    packets += witmotion_packet(0x53, *(angles or (0, 0, 0)), 0) + witmotion_packet(0x54, 1, 2, 3, 0)
    return packets + (witmotion_packet(0x59, *quaternion) if quaternion else b"")


@pytest.fixture
def witmotion(make_rig):
    """A WitMotion sensor, and its source that knows which packets a sample has: after two samples."""
    rig = make_rig("witmotion")
    source = rig.open()
    rig.read(source, b"\x55\x51" + bytes(range(40)))  # garbage before
    for _ in range(2):
        rig.read(source, witmotion_cycle())
    assert source.lost == 0
    return rig, source


@pytest.fixture
def bno085(make_rig):
    """A BNO085 and its source."""
    rig = make_rig("bno085")
    return rig, rig.open()


def test_a_witmotion_sensor_gets_its_content_and_rate(make_rig):
    rig = make_rig("witmotion")
    source = rig.open()
    assert rig.sensor.received() == bytes.fromhex("FF AA 69 88 B5  FF AA 02 0E 02  FF AA 03 09 00")
    assert source.name == f"WitMotion on {rig.sensor.port}"


def test_each_axis_of_a_witmotion_sensor_has_its_scale_and_sign(witmotion):
    rig, source = witmotion
    turned = Rotation.from_euler("ZYX", (0.3, 0.2, -0.4))
    x, y, z, w = np.round(32768 * turned.as_quat()).astype(int)
    (sample,) = rig.read(source, witmotion_cycle((1024, -2048, 4096), (8192, -4096, 16384), (w, x, y, z)))
    assert np.divide(sample.acceleration, G) == pytest.approx((0.5, -1.0, 2.0))
    assert np.degrees(sample.angular_velocity) == pytest.approx((500, -250, 1000))
    assert Rotation.from_quat(sample.orientation).approx_equal(turned, 1e-4)
    assert source.temperature == 25.15


def test_a_witmotion_sensor_without_quaternions_gives_its_angles(make_rig):
    rig = make_rig("witmotion")
    source = rig.open()
    angles = tuple(round(degrees / 180 * 32768) for degrees in (30, -50, 110))  # roll, pitch, yaw
    for _ in range(3):
        samples = rig.read(source, witmotion_cycle(quaternion=None, angles=angles))
    expected = Rotation.from_euler("ZYX", (110, -50, 30), degrees=True)
    assert Rotation.from_quat(samples[0].orientation).approx_equal(expected, 1e-4)


def test_a_witmotion_packet_may_arrive_in_pieces(witmotion):
    rig, source = witmotion
    stream = witmotion_cycle() * 3
    pieces = [stream[start : start + 7] for start in range(0, len(stream), 7)]
    samples = [sample for piece in pieces for sample in rig.read(source, piece, delay=0.03 / len(pieces))]
    assert len(samples) == 3 and source.lost == 0


def test_garbage_between_and_inside_witmotion_packets_costs_only_the_samples_it_hits(witmotion):
    rig, source = witmotion
    damaged = bytearray(witmotion_cycle(acceleration=(7, 7, 7)))
    damaged[4] ^= 0x10  # in the acceleration
    cut = witmotion_cycle()[:-5]
    sent = witmotion_cycle() + b"\x00\x55\x55" + witmotion_cycle() + bytes(damaged) + witmotion_cycle() + cut
    samples = rig.read(source, sent + witmotion_cycle())
    assert [sample.acceleration[2] for sample in samples] == pytest.approx([G] * 4)
    assert source.lost == 2 and source.loss == "damaged packets"


def test_the_data_sheets_example_of_a_bno085_is_read_as_it_says_and_agrees_with_its_own_acceleration(bno085):
    rig, source = bno085
    (sample,) = rig.read(source, DATA_SHEET_EXAMPLE)
    assert sample.acceleration == pytest.approx((-3.638, -0.196, 9.581), abs=1e-3)
    assert sample.angular_velocity is None
    up = Rotation.from_quat(sample.orientation).inv().apply((0, 0, 1))
    measured = np.divide(sample.acceleration, np.linalg.norm(sample.acceleration))
    assert math.degrees(math.acos(up @ measured)) < 0.1


@pytest.mark.parametrize("angles", [(0, 0, 0), (40, 30, 0), (-170, 0, -60), (10, -80, 150)])
def test_a_bno085_turns_by_yaw_about_z_then_pitch_about_x_then_roll_about_y(bno085, angles):
    rig, source = bno085
    (sample,) = rig.read(source, rvc_packet(1, angles, (0, 0, 1000)))
    assert Rotation.from_quat(sample.orientation).approx_equal(Rotation.from_euler("ZXY", angles, degrees=True), 1e-4)


def test_lost_packets_of_a_bno085_are_counted_and_leave_their_gap_in_the_stamps(bno085):
    rig, source = bno085
    for counter in range(200, 300):  # the counter is a byte
        (last,) = rig.read(source, rvc_packet(counter, (0, 0, 0), (0, 0, 1000)))
    bad = bytearray(rvc_packet(300, (0, 0, 0), (0, 0, 1000)))
    bad[7] ^= 1
    assert rig.read(source, bytes(bad)) == []
    (sample,) = rig.read(source, rvc_packet(301, (0, 0, 0), (0, 0, 1000)))
    assert source.lost == 1 and source.loss == "damaged packets"
    assert sample.time - last.time == pytest.approx(0.02, abs=1e-3)


def test_a_bno085_is_found_in_a_stream_that_begins_in_the_middle_and_has_headers_in_its_data(bno085):
    rig, source = bno085
    packets = [rvc_packet(counter, (-218.46, -0.86, 0.0), (-21846, 0, 1000)) for counter in range(4)]  # 0xAAAA inside
    samples = rig.read(source, packets[0][5:] + b"".join(packets[1:]))
    assert len(samples) == 3 and source.lost == 0


@pytest.mark.parametrize("kind", ["witmotion", "bno085"])
def test_an_unplugged_sensor_is_an_error_that_names_the_port(make_rig, kind):
    rig = make_rig(kind)
    source = rig.open()
    rig.sensor.unplug()
    with pytest.raises(DeviceError, match=f"on {rig.sensor.port}: cannot be read"):
        source.read()
    source.close()
    with pytest.raises(DeviceError, match=f"on {rig.sensor.port}: cannot be opened: .*No such file"):
        rig.open()


def test_bytes_without_a_packet_hint_at_the_baud_rate(bno085):
    rig, source = bno085
    assert source.silence == "not one byte"
    assert rig.read(source, bytes(range(100))) == [] and "is serial.baud the sensor's?" in source.silence


@pytest.mark.parametrize(
    ("kind", "name", "value", "problem"),
    [
        ("witmotion", "serial.baud", 9600, "= 9600: must be 44000 or more for 100 samples a second"),
        ("bno085", "serial.port", "", "= '': must be the sensor's port"),
    ],
)
def test_a_line_that_cannot_carry_the_samples_and_a_missing_port_are_refused(make_rig, kind, name, value, problem):
    with pytest.raises(ParameterError, match=f"{name} {problem}"):
        make_rig(kind).open(**{name: value})


# The stamps of samples that arrive in batches.


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


@pytest.mark.parametrize(
    ("arrivals", "lost", "at", "stamp"),
    [((1.0, 1.01, 1.02, 2.02), 99, 3, 2.015), ((1000.0, 1000.01, 500.0, 500.01), 0, 2, 499.995)],
    ids=["a gap is counted", "a clock that is set back"],
)
def test_after_a_gap_or_a_step_of_the_clock_the_stamps_are_those_of_the_present(arrivals, lost, at, stamp):
    clock, stamps = stamped(arrivals, [1, 1, 1, 1])
    assert clock.lost == lost and stamps[at][0] == pytest.approx(stamp)
