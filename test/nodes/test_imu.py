# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The node `imu` in this process, over real DDS: a trunk that moves, impossible samples, and a chip that it reads."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import EntryPoint

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3, Vector3Stamped
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trunk.checks import GROUP
from exo_gravity.hardware.imu_source import ImuSource
from exo_gravity.hardware.network import restrict_to_localhost
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator
from exo_gravity.nodes.imu import ImuNode
from exo_gravity.nodes.ros.messages import to_nanoseconds

from ..support.fake_chips import FAKES, FakeI2c
from ..support.imu_motion import bowing_and_walking
from ..support.node_thread import NodeRig
from ..support.waiting import each_closed

restrict_to_localhost()
G = 9.80665
TRUNK_FROM_IMU = Rotation.from_euler("xyz", (math.pi / 2, 0.0, math.pi / 2))  # its x points left, its y up
MOUNTING = tuple(TRUNK_FROM_IMU.as_quat().tolist())
MOUNTED = f"rotation_trunk_from_imu:={list(MOUNTING)}"
LEVEL = "rotation_trunk_from_imu:=[0.0, 0.0, 0.0, 1.0]"
AHEAD = 25  # samples in flight: fewer than the node queues, so that none is lost


class ImuRig(NodeRig):
    """The node with `parameters` in ROS's form, a driver that feeds it, and a listener.

    tilts, data: what it published, by stamp in ns. reported: its statuses so far; one lasts for a moment only.
    sent, received: the number of samples sent, and of those the node has received.
    """

    def __init__(self, *parameters: str) -> None:
        super().__init__(*(word for parameter in parameters for word in ("-p", parameter)))
        self.imu = self.add(ImuNode())
        self.tilts, self.data = dict[int, Vector3](), dict[int, Imu]()
        self.reported, self.sent, self.received = list[DiagnosticStatus](), 0, 0
        self.publisher = self.user.create_publisher(Imu, "/imu/data_raw", 50)
        subscribe = self.user.create_subscription
        subscribe(Vector3Stamped, "/imu/pitch_yaw", self._on_tilt, 1000)
        subscribe(Imu, "/imu/data", lambda m: self.data.update({to_nanoseconds(m.header.stamp): m}), 1000)
        self.wait_until(lambda: self.reported)

    def _on_tilt(self, message: Vector3Stamped) -> None:
        self.tilts[to_nanoseconds(message.header.stamp)] = message.vector

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        super().on_diagnostics(message)
        self.reported += message.status
        self.received = int(self.values["received"])

    @property
    def values(self) -> Mapping[str, str]:
        return self.values_of("imu")

    def reports(self, text: str, level: bytes = DiagnosticStatus.ERROR, since: int = 0) -> bool:
        return any(text in one.message and one.level == level for one in self.reported[since:])

    def send(self, stamp, rate=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, G), orientation=None, noise=1e-9, covariance=0):
        """Publish the sample of `stamp` s, which is given in the trunk's axes; wait while too many are in flight.

        covariance: of rate and acceleration, its first entry.
        """
        message = Imu()
        message.header.stamp = Time(nanoseconds=round(stamp * 1e9)).to_msg()
        for vector, values in ((message.angular_velocity, rate), (message.linear_acceleration, acceleration)):
            vector.x, vector.y, vector.z = TRUNK_FROM_IMU.inv().apply(values).tolist()
        q = message.orientation
        q.x, q.y, q.z, q.w = map(float, (0.0, 0.0, 0.0, 1.0) if orientation is None else orientation)
        message.orientation_covariance[0] = -1.0 if orientation is None else 0.0
        message.angular_velocity_covariance[0] = message.linear_acceleration_covariance[0] = covariance
        self.sent += 1
        message.linear_acceleration.x += noise * (-1) ** self.sent
        self.publisher.publish(message)
        self.wait_until(lambda: self.sent - max(self.received, len(self.tilts)) < AHEAD)

    def settle(self, start, *sample, **options) -> float:
        """Send the same sample for 2.5 s of stamps, wait for the last one's tilt, and return its stamp in s."""
        for stamp in start + 0.01 * np.arange(250):
            self.send(stamp, *sample, **options)
        self.wait_until(lambda: round(stamp * 1e9) in self.tilts)
        return float(stamp)

    def close(self) -> None:
        self.imu.close()
        super().close()


@pytest.fixture
def make_imu() -> Iterator[Callable[..., ImuRig]]:
    yield from each_closed(ImuRig)


@pytest.fixture
def imu(make_imu) -> ImuRig:
    imu = make_imu(MOUNTED)
    imu.wait_until(imu.publisher.get_subscription_count)
    return imu


def test_the_node_publishes_the_tilt_of_a_chip_that_it_reads_itself_and_reports_its_absence(make_imu, monkeypatch):
    """How a device is opened again: lab/test_imu_chips.py."""
    chip, roll = FAKES["mpu6050"](time.time), math.radians(20.0)
    bus = FakeI2c(chip)
    chip.acceleration = lambda _: (0.0, math.sin(roll), math.cos(roll))
    monkeypatch.setattr("adafruit_extended_bus.ExtendedI2C", lambda number, frequency: bus)
    imu = make_imu("source:=mpu6050", LEVEL)
    imu.wait_until(lambda: imu.reports("publishing", DiagnosticStatus.OK))
    newest = list(imu.tilts.values())[-1]
    assert (newest.x, newest.y) == pytest.approx((roll, 0.0), abs=2e-3)
    bus.plugged = False
    imu.wait_until(lambda: imu.reports("mpu6050 at 0x68 on /dev/i2c-1: cannot be opened"))
    chip.reset()
    bus.plugged = bus.is_open = True
    imu.wait_until(lambda: int(imu.values["opened"]) >= 2)


class LevelImu(ImuSource):
    """A sensor that always lies level: a class with `read` and `close`, as CONTRIBUTING says."""

    closed = False

    def __init__(self, values, clock):
        super().__init__(f"level IMU at {values['rate']:g} Hz")
        self._clock = clock

    def read(self):
        return [ImuSample(self._clock(), (0.0, 0.0, 0.01), (0.0, 0.0, 9.81))]

    def close(self):
        LevelImu.closed = True


def test_a_new_source_is_opened_by_its_name_and_its_samples_reach_the_node_and_its_topic(make_imu, monkeypatch):
    entry = EntryPoint("level", f"{__name__}:LevelImu", GROUP)
    monkeypatch.setattr("exo_gravity.core.params.installed", lambda _group: {"level": entry})
    imu, raw = make_imu("source:=level", "rate:=100.0", LEVEL), []
    imu.user.create_subscription(Imu, "/imu/data_raw", raw.append, 50)
    imu.wait_until(lambda: raw and imu.received > 2)
    assert raw[-1].linear_acceleration.z == pytest.approx(9.81)
    assert raw[-1].orientation_covariance[0] == -1.0  # not reported
    assert (imu.values["device"], imu.values["missed"]) == ("level IMU at 100 Hz", "0")
    imu.imu.close()
    assert LevelImu.closed


def test_every_sample_gives_tilt_rate_and_acceleration_in_the_trunks_axes_with_the_covariance(imu):
    expected, in_trunk, estimator, motion = {}, {}, TrunkEstimator(MOUNTING), bowing_and_walking(5.0)
    for moment, *values in zip(1000.0 + motion.times, motion.gyroscope, motion.accelerometer, strict=True):
        stamp = round(moment * 1e9)
        in_imu = (TRUNK_FROM_IMU.inv().apply(value).tolist() for value in values)
        answer = estimator.update(ImuSample(stamp * 1e-9, *in_imu))
        if answer is not None:
            expected[stamp], in_trunk[stamp] = answer, np.concatenate(values)
        imu.send(moment, *values, noise=0.0)
    imu.wait_until(lambda: max(expected) in imu.tilts and max(expected) in imu.data)
    assert imu.tilts.keys() == imu.data.keys() == expected.keys()
    for stamp, message in imu.data.items():
        tilt, answer = imu.tilts[stamp], expected[stamp]
        assert (tilt.y, tilt.x, tilt.z) == pytest.approx((answer.pitch, answer.roll, 0.0), abs=1e-9)
        variance, w, a = answer.uncertainty**2, message.angular_velocity, message.linear_acceleration
        assert message.orientation_covariance == pytest.approx(np.diag((variance, variance, math.pi**2)).ravel())
        q = message.orientation
        assert (q.x, q.y, q.z, q.w) == pytest.approx(answer.orientation)
        assert (w.x, w.y, w.z, a.x, a.y, a.z) == pytest.approx(in_trunk[stamp], abs=1e-9)


def test_a_refusal_and_silence_are_errors_without_a_tilt_until_the_estimate_has_settled_again(imu):
    stamp = imu.settle(2000.0)
    for k in range(30):
        imu.send(stamp + 0.01 * (k + 1), noise=0.0)
    imu.wait_until(lambda: imu.reports("the IMU or its driver is frozen"))
    imu.wait_until(lambda: round((stamp + 0.09) * 1e9) in imu.tilts and imu.received == imu.sent)
    assert max(imu.tilts) <= round((stamp + 0.11) * 1e9)
    imu.wait_until(lambda: imu.reports("no samples on /imu/data_raw") and imu.received == imu.sent)
    imu.send(stamp + 0.8)
    imu.wait_until(lambda: imu.received == imu.sent)
    before = len(imu.reported)
    imu.wait_until(lambda: imu.reports("no samples", since=before))
    assert round((stamp + 0.8) * 1e9) not in imu.tilts


@pytest.mark.parametrize("orientation", [(0.0,) * 4, pytest.param((math.nan,) * 4, marks=pytest.mark.thorough)])
def test_an_orientation_that_the_driver_does_not_have_is_fused_and_values_without_covariance_are_passed_on(
    imu, orientation
):
    tilted = (0.0, G * math.sin(0.2), G * math.cos(0.2))
    stamp = round(imu.settle(6000.0, (0.0, 0.0, 1e-3), tilted, orientation, covariance=-1.0) * 1e9)
    imu.wait_until(lambda: stamp in imu.data)
    assert imu.tilts[stamp].x == pytest.approx(0.2, abs=1e-3)
    assert imu.data[stamp].angular_velocity.z == pytest.approx(1e-3)
    covariances = imu.data[stamp].angular_velocity_covariance, imu.data[stamp].linear_acceleration_covariance
    assert [covariance[0] for covariance in covariances] == [0.0, 0.0]


def test_samples_of_a_second_driver_are_an_error_and_give_no_tilt(imu):
    stamp = stamp_of_second = imu.settle(4000.0)
    imu.publisher = imu.user.create_publisher(Imu, "/imu/data_raw", 50)
    imu.wait_until(lambda: imu.publisher.get_subscription_count())
    before = imu.received
    while imu.received == before:  # samples are lost until the node has matched the new publisher too
        stamp_of_second += 1.0  # after such a gap one sample is not enough, however long this process was not run
        imu.send(stamp_of_second, acceleration=(0.0, 1.0, 9.7))
        imu.executor.spin_once(timeout_sec=0.05)
    imu.wait_until(lambda: imu.reports("more than one publisher of /imu/data_raw"))
    assert max(imu.tilts) == round(stamp * 1e9)


def test_a_topic_that_it_publishes_itself_is_no_input():
    with pytest.raises(ParameterError, match="input_topic = '/imu/data': must be a topic that this node does"):
        ImuRig(MOUNTED, "input_topic:=/imu/data")
    rclpy.try_shutdown()
