"""From a sensor's bytes to the trunk's tilt: the signs of registers, packets and estimator fit together."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exo_gravity.hardware.imu_sources import open_source
from exo_gravity.hardware.trunk_estimator import TrunkEstimator

from ..support.fake_imu.bus import FakeBus, FakeTime
from ..support.fake_imu.chip import Motion
from ..support.fake_imu.icm20948 import FakeIcm20948
from ..support.fake_imu.invensense import FakeMpu6050
from ..support.fake_imu.lsm6dsox import FakeLsm6dsox
from ..support.fake_imu.serial import FakeSerialSensor, rvc_packet, witmotion_packet

STILL, BOW, LEAN = 4.0, math.radians(30.0), math.radians(-20.0)
NOISE = np.random.default_rng(0).normal(size=(20_000, 6))
CHIPS = {
    "mpu6050": (FakeMpu6050, 0x68),
    "icm20948": (FakeIcm20948, 0x69),
    "lsm6dsox": (FakeLsm6dsox, 0x6A),
}


def share(time):
    """How far the trunk has moved: still for 4 s from 1000 s on, then there in 3 s."""
    return 0.5 - 0.5 * math.cos(math.pi * min(max((time - 1000.0 - STILL) / 3.0, 0.0), 1.0))


def trunk(time):
    """Bows forward by 30 degrees while it leans to the left by 20."""
    return Rotation.from_euler("xyz", (LEAN * share(time), BOW * share(time), 0.0))


def angular_velocity(time):
    step = (trunk(time - 1e-3).inv() * trunk(time + 1e-3)).as_rotvec() / 2e-3
    return tuple(np.degrees(step) + 0.05 * NOISE[int(time * 1e4) % len(NOISE), :3])


def acceleration(time):
    return tuple(trunk(time).inv().apply((0, 0, 1)) + 0.002 * NOISE[int(time * 1e4) % len(NOISE), 3:])


def tilts(samples):
    """Return time, pitch and roll of each tilt (n, 3)."""
    estimator = TrunkEstimator((0.0, 0.0, 0.0, 1.0), 100.0)
    estimates = [(sample.time, estimator.update(sample)) for sample in samples]
    return np.array([(time, tilt.pitch, tilt.roll) for time, tilt in estimates if tilt])


def check(found):
    moving = found[found[:, 0] > 1000.0 + STILL - 0.5]
    assert len(moving) > 300
    expected = np.array([trunk(time).as_euler("xyz")[[1, 0]] for time in moving[:, 0]])
    error = np.degrees(np.abs(moving[:, 1:] - expected))
    assert error.max() < 1.0, error.max(axis=0)
    assert moving[-1, 1:] == pytest.approx((BOW, LEAN), abs=math.radians(1.0))


@pytest.mark.parametrize("kind", CHIPS)
def test_a_bow_with_a_lean_measured_by_a_chip_gives_its_tilt(kind):
    time = FakeTime()
    model, address = CHIPS[kind]
    bus = FakeBus(model(time, Motion(angular_velocity, acceleration)), address)
    values = {"source": kind, "rate": 100.0, "i2c.bus": 1, "i2c.address": 0}
    source = open_source(values, time, False, wait=time.wait, open_i2c=lambda number: bus)
    samples = []
    while time() < 1000.0 + STILL + 4.0:
        time.wait(0.005)
        samples += source.read()
    check(tilts(samples))


@pytest.mark.parametrize("kind", ["witmotion", "bno085"])
def test_a_bow_with_a_lean_measured_by_a_sensor_on_a_serial_port_gives_its_tilt(kind, tmp_path):
    time, sensor, samples = FakeTime(), FakeSerialSensor(tmp_path / "imu"), []
    values = {"source": kind, "rate": 100.0, "serial.port": str(sensor.port), "serial.baud": 115200}
    source = open_source(values, time)
    while time() < 1000.0 + STILL + 4.0:
        time.wait(0.01)
        sensor.deliver(packets_of(kind, time()))
        samples += source.read()
    sensor.unplug()
    check(tilts(samples))


def packets_of(kind, time):
    a, rate = np.array(acceleration(time)), np.array(angular_velocity(time))
    if kind == "bno085":
        angles = tuple(trunk(time).as_euler("ZXY", degrees=True))
        return rvc_packet(round((time - 1000.0) * 100), angles, tuple(int(mg) for mg in np.round(1000 * a)))
    x, y, z, w = (int(number) for number in np.round(32767 * trunk(time).as_quat()))
    return (
        witmotion_packet(0x51, *(int(number) for number in np.round(2048 * a)), 2500)
        + witmotion_packet(0x52, *(int(number) for number in np.round(rate / 2000 * 32768)), 0)
        + witmotion_packet(0x53, 0, 0, 0, 0)
        + witmotion_packet(0x59, w, x, y, z)
    )
