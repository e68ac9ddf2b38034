# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""IMUs on serial ports, by real pyserial on a pseudo-terminal."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exo_gravity.core.errors import DeviceError, ParameterError
from exo_gravity.hardware.imu_sources import open_source

from ..support.fake_imu.chips import FakeTime, G
from ..support.fake_imu.serial import FakeSerialSensor, rvc_packet, witmotion_packet

# The example of the BNO080's data sheet, 1.3.5.2.
DATA_SHEET_EXAMPLE = bytes.fromhex("AA AA DE 01 00 92 FF 25 08 8D FE EC FF D1 03 00 00 00 E7")


class Rig:
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
        rigs.append(Rig(tmp_path / "imu", kind))
        return rigs[-1]

    yield make_rig
    for rig in rigs:
        rig.sensor.unplug()


def witmotion_cycle(acceleration=(0, 0, 2048), angular_velocity=(0, 0, 0), quaternion=(32767, 0, 0, 0), angles=None):
    """Return the packets of one sample, in the sensor's numbers; the quaternion is w, x, y, z; None leaves one out."""
    packets = witmotion_packet(0x51, *acceleration, 2515) + witmotion_packet(0x52, *angular_velocity, 0)
    packets += witmotion_packet(0x53, *(angles or (0, 0, 0)), 0) + witmotion_packet(0x54, 1, 2, 3, 0)
    return packets + (witmotion_packet(0x59, *quaternion) if quaternion else b"")


def settled(rig, source, **cycle):
    """Send the two samples after which the source knows which packets a sample has."""
    rig.read(source, witmotion_cycle(**cycle))
    assert rig.read(source, witmotion_cycle(**cycle)) != []


def test_a_witmotion_sensor_gets_its_content_and_rate(make_rig):
    rig = make_rig("witmotion")
    source = rig.open()
    assert rig.sensor.received() == bytes.fromhex("FF AA 69 88 B5  FF AA 02 0E 02  FF AA 03 09 00")
    assert source.name == f"WitMotion on {rig.sensor.port}"


def test_each_axis_of_a_witmotion_sensor_has_its_scale_and_sign(make_rig):
    rig = make_rig("witmotion")
    source = rig.open()
    turned = Rotation.from_euler("ZYX", (0.3, 0.2, -0.4))
    x, y, z, w = np.round(32768 * turned.as_quat()).astype(int)
    cycle = {"acceleration": (1024, -2048, 4096), "angular_velocity": (8192, -4096, 16384), "quaternion": (w, x, y, z)}
    settled(rig, source, **cycle)
    (sample,) = rig.read(source, witmotion_cycle(**cycle))
    assert np.divide(sample.acceleration, G) == pytest.approx((0.5, -1.0, 2.0))
    assert np.degrees(sample.angular_velocity) == pytest.approx((500, -250, 1000))
    assert Rotation.from_quat(sample.orientation).approx_equal(turned, 1e-4)
    assert source.temperature == 25.15


def test_a_witmotion_sensor_without_quaternions_gives_its_angles(make_rig):
    rig = make_rig("witmotion")
    source = rig.open()
    angles = tuple(round(degrees / 180 * 32768) for degrees in (30, -50, 110))  # roll, pitch, yaw
    settled(rig, source, quaternion=None, angles=angles)
    (sample,) = rig.read(source, witmotion_cycle(quaternion=None, angles=angles))
    expected = Rotation.from_euler("ZYX", (110, -50, 30), degrees=True)
    assert Rotation.from_quat(sample.orientation).approx_equal(expected, 1e-4)


def test_a_witmotion_packet_may_arrive_in_pieces(make_rig):
    rig = make_rig("witmotion")
    source = rig.open()
    settled(rig, source)
    stream = witmotion_cycle() * 3
    pieces = [stream[start : start + 7] for start in range(0, len(stream), 7)]
    samples = [sample for piece in pieces for sample in rig.read(source, piece, delay=0.03 / len(pieces))]
    assert len(samples) == 3 and source.lost == 0


def test_garbage_before_between_and_inside_witmotion_packets_costs_only_the_samples_it_hits(make_rig):
    rig = make_rig("witmotion")
    source = rig.open()
    rig.read(source, b"\x55\x51" + bytes(range(40)))
    settled(rig, source)
    assert source.lost == 0
    damaged = bytearray(witmotion_cycle(acceleration=(7, 7, 7)))
    damaged[4] ^= 0x10  # in the acceleration
    cut = witmotion_cycle()[:-5]
    sent = witmotion_cycle() + b"\x00\x55\x55" + witmotion_cycle() + bytes(damaged) + witmotion_cycle() + cut
    samples = rig.read(source, sent + witmotion_cycle())
    assert [sample.acceleration[2] for sample in samples] == pytest.approx([G] * 4)
    assert source.lost == 2 and source.loss == "damaged packets"


def test_a_baud_rate_that_cannot_carry_the_samples_is_refused(make_rig):
    with pytest.raises(ParameterError, match=r"serial\.baud = 9600: must be 44000 or more for 100 samples a second"):
        make_rig("witmotion").open(**{"serial.baud": 9600})


def test_the_data_sheets_example_of_a_bno085_is_read_as_it_says_and_agrees_with_its_own_acceleration(make_rig):
    rig = make_rig("bno085")
    (sample,) = rig.read(rig.open(), DATA_SHEET_EXAMPLE)
    assert sample.acceleration == pytest.approx((-3.638, -0.196, 9.581), abs=1e-3)
    assert sample.angular_velocity is None
    up = Rotation.from_quat(sample.orientation).inv().apply((0, 0, 1))
    measured = np.divide(sample.acceleration, np.linalg.norm(sample.acceleration))
    assert math.degrees(math.acos(up @ measured)) < 0.1


@pytest.mark.parametrize("angles", [(0, 0, 0), (40, 30, 0), (-170, 0, -60), (10, -80, 150)])
def test_a_bno085_turns_by_yaw_about_z_then_pitch_about_x_then_roll_about_y(make_rig, angles):
    rig = make_rig("bno085")
    (sample,) = rig.read(rig.open(), rvc_packet(1, angles, (0, 0, 1000)))
    assert Rotation.from_quat(sample.orientation).approx_equal(Rotation.from_euler("ZXY", angles, degrees=True), 1e-4)


def test_lost_packets_of_a_bno085_are_counted_and_leave_their_gap_in_the_stamps(make_rig):
    rig = make_rig("bno085")
    source = rig.open()
    for counter in range(200, 300):  # the counter is a byte
        (last,) = rig.read(source, rvc_packet(counter, (0, 0, 0), (0, 0, 1000)))
    bad = bytearray(rvc_packet(300, (0, 0, 0), (0, 0, 1000)))
    bad[7] ^= 1
    assert rig.read(source, bytes(bad)) == []
    (sample,) = rig.read(source, rvc_packet(301, (0, 0, 0), (0, 0, 1000)))
    assert source.lost == 1 and source.loss == "damaged packets"
    assert sample.time - last.time == pytest.approx(0.02, abs=1e-3)


def test_a_bno085_is_found_in_a_stream_that_begins_in_the_middle_and_has_headers_in_its_data(make_rig):
    rig = make_rig("bno085")
    source = rig.open()
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


def test_bytes_without_a_packet_hint_at_the_baud_rate(make_rig):
    rig = make_rig("bno085")
    source = rig.open()
    assert source.silence == "not one byte"
    assert rig.read(source, bytes(range(100))) == [] and "is serial.baud the sensor's?" in source.silence


def test_a_port_must_be_given(make_rig):
    with pytest.raises(ParameterError, match=r"serial\.port = '': must be the sensor's port"):
        make_rig("bno085").open(**{"serial.port": ""})
