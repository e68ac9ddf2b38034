# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The node `imu` over real DDS: a trunk that moves, impossible samples, and sensors that it reads itself."""

from __future__ import annotations

import math
import subprocess
import sys
import time

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3, Vector3Stamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trunk.params import IMU_SOURCES
from exo_gravity.hardware.imu_sources import SOURCES, ImuSource
from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator
from exo_gravity.nodes.imu import ImuDevice
from exo_gravity.nodes.imu import ImuNode as ImuShell
from exo_gravity.nodes.ros.messages import to_nanoseconds
from exo_gravity.sim.virtual_time import VirtualClock

from ..support.fake_chips import FAKES, FakeI2c
from ..support.imu_motion import bowing_and_walking
from ..support.node_thread import own_node
from ..support.waiting import PATIENCE, wait_until

keep_to_this_machine()
G = 9.80665
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
TRUNK_FROM_IMU = Rotation.from_euler("xyz", (math.pi / 2, 0.0, math.pi / 2))  # its x points left, its y up
MOUNTING = tuple(TRUNK_FROM_IMU.as_quat().tolist())
AHEAD = 25  # samples in flight: fewer than the node queues, so that none is lost
NODE = [sys.executable, "-c", "from exo_gravity.nodes.imu import main; main()", "--ros-args"]


# An IMU that the node reads itself. How a device is opened again: hardware/test_imu_sources.py


def test_the_node_publishes_the_tilt_of_a_chip_that_it_reads_itself_and_reports_its_absence(monkeypatch):
    chip = FAKES["mpu6050"](time.time)
    bus, roll = FakeI2c(chip), math.radians(20.0)
    chip.acceleration = lambda _: (0.0, math.sin(roll), math.cos(roll))
    monkeypatch.setattr("adafruit_extended_bus.ExtendedI2C", lambda number, frequency: bus)
    arguments = ("source:=mpu6050", "rotation_trunk_from_imu:=[0.0, 0.0, 0.0, 1.0]")
    rclpy.init(args=["--ros-args", *(part for argument in arguments for part in ("-p", argument))])
    node, listener, executor = ImuShell(), rclpy.create_node("imu_listener"), SingleThreadedExecutor()
    tilts, reports = [], [DiagnosticStatus()]
    for each in (node, listener):
        executor.add_node(each)
    listener.create_subscription(Vector3Stamped, "/imu/pitch_yaw", tilts.append, 50)
    listener.create_subscription(DiagnosticArray, "/diagnostics", lambda message: reports.extend(message.status), 50)

    def wait(condition):
        wait_until(condition, lambda: executor.spin_once(timeout_sec=0.002), seen=lambda: reports[-1])

    try:
        wait(lambda: tilts)
        assert (tilts[-1].vector.x, tilts[-1].vector.y) == pytest.approx((roll, 0.0), abs=2e-3)
        wait(lambda: reports[-1].message == "publishing")
        bus.plugged = False
        wait(lambda: "mpu6050 at 0x68 on /dev/i2c-1: cannot be opened" in reports[-1].message)
        assert reports[-1].level == DiagnosticStatus.ERROR
        chip.reset()
        bus.plugged = bus.is_open = True
        seen = len(reports)
        wait(
            lambda: any(
                pair.key == "opened" and int(pair.value) >= 2 for each in reports[seen:] for pair in each.values
            )
        )
    finally:
        node.close()
        executor.shutdown()
        for each in (node, listener):
            each.destroy_node()
        rclpy.try_shutdown()


# CONTRIBUTING, "Add an IMU", followed literally: a class with `read` and `close`, and its name in two places


class LevelImu(ImuSource):
    """A sensor that always lies level."""

    def __init__(self, values, clock):
        super().__init__(f"level IMU at {values['rate']:g} Hz")
        self.clock, self.is_open = clock, True

    def read(self):
        return [ImuSample(self.clock(), (0.0, 0.0, 0.01), (0.0, 0.0, 9.81))]

    def close(self):
        self.is_open = False


def test_a_new_source_is_opened_by_its_name_and_its_samples_reach_the_node(monkeypatch):
    assert set(IMU_SOURCES) == {"topic", *SOURCES}
    monkeypatch.setitem(SOURCES, "level", LevelImu)
    clock, received = VirtualClock(), []
    with own_node("listener") as (node, _):
        values = {"source": "level", "rate": 100.0}
        device = ImuDevice(node, values, "/imu/data_raw", lambda *sample: received.append(sample), clock)
        for _ in range(3):
            clock.sleep(0.01)
            device.poll()
    messages, numbers = zip(*received, strict=True)
    assert [info["publication_sequence_number"] for info in numbers] == [1, 2, 3]
    assert [message.linear_acceleration.z for message in messages] == pytest.approx([9.81] * 3)
    assert messages[0].orientation_covariance[0] == -1.0  # not reported
    assert device.values["device"] == "level IMU at 100 Hz"
    source = device.reopening.source
    device.reopening.close()
    assert not source.is_open


# The node as a process, fed by a driver


class ImuNode:
    """One node as a process, a driver that feeds it, and a listener.

    tilts: vector by stamp in ns. sent, received: the number of samples sent, and of those the node has received.
    reported: the statuses so far; one lasts for a moment only.
    """

    def __init__(self, node, executor):
        arguments = ("-p", f"rotation_trunk_from_imu:={list(MOUNTING)}")
        self.process = subprocess.Popen([*NODE, *arguments], stdin=subprocess.PIPE)  # it ends with its stdin
        self.node, self.executor = node, executor
        self.publisher = self.node.create_publisher(Imu, "/imu/data_raw", 50)
        self.node.create_subscription(Vector3Stamped, "/imu/pitch_yaw", self._on_tilt, 1000)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self.reported: list[DiagnosticStatus] = []
        self.tilts: dict[int, Vector3] = {}
        self.sent, self.received = 0, 0
        self._number: dict[int, int] = {}  # of each sample by stamp in ns

    def close(self):
        self.process.terminate()
        self.process.wait(PATIENCE)

    def _on_tilt(self, message):
        stamp = to_nanoseconds(message.header.stamp)
        self.tilts[stamp] = message.vector
        self.received = max(self.received, self._number[stamp])

    def forget(self):
        """Forget what came before; the next sample starts the estimate anew after a gap."""
        self.tilts.clear()
        self.reported.clear()

    def _on_diagnostics(self, message):
        self.reported += message.status
        values = {pair.key: pair.value for pair in self.reported[-1].values}
        self.received = max(self.received, int(values["received"]))

    def wait_until(self, condition):
        seen = lambda: f"{self.reported[-3:]}, {self.received} of {self.sent} samples received"  # noqa: E731
        wait_until(condition, lambda: self.executor.spin_once(timeout_sec=0.05), seen=seen)

    def reports(self, text, level=None, since=0):
        """Whether a status with `text` has come, not counting the first `since`."""
        return any(text in one.message and level in (None, one.level) for one in self.reported[since:])

    def send(
        self, stamp, rate=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, G), orientation=None, noise=1e-9, covariance=0.0
    ):
        """Publish the sample of `stamp` s, which is given in the trunk's axes; wait while too many are in flight.

        covariance: of rate and acceleration, its first entry.
        """
        message = Imu()
        message.header.stamp = Time(nanoseconds=round(stamp * 1e9)).to_msg()
        for vector, values in ((message.angular_velocity, rate), (message.linear_acceleration, acceleration)):
            vector.x, vector.y, vector.z = TRUNK_FROM_IMU.inv().apply(values).tolist()
        q = message.orientation
        q.x, q.y, q.z, q.w = map(float, UPRIGHT if orientation is None else orientation)
        message.orientation_covariance[0] = -1.0 if orientation is None else 0.0
        message.angular_velocity_covariance[0] = message.linear_acceleration_covariance[0] = covariance
        self.sent += 1
        message.linear_acceleration.x += noise * (-1) ** self.sent
        self.publisher.publish(message)
        self._number[round(stamp * 1e9)] = self.sent
        self.wait_until(lambda: self.sent - self.received < AHEAD)

    def settle(self, start, *sample, **options):
        """Send the same sample for 4 s of stamps, wait until the node has received all, and return the last stamp."""
        for stamp in start + 0.01 * np.arange(400):
            self.send(stamp, *sample, **options)
        self.wait_until(lambda: self.received == self.sent and round(stamp * 1e9) in self.tilts)
        return float(stamp)


@pytest.fixture(scope="module")
def node():
    """A node whose IMU is mounted as MOUNTING says."""
    with own_node("imu_driver") as own:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("EXO_GRAVITY_SUPERVISED", "1")
            imu = ImuNode(*own)
        imu.wait_until(lambda: imu.publisher.get_subscription_count() and imu.reports("waiting"))
        yield imu
        imu.close()


@pytest.fixture
def imu(node):
    """The same with no tilts and reports yet."""
    node.forget()
    return node


def test_every_sample_gives_tilt_rate_and_acceleration_in_the_trunks_axes_with_the_covariance(imu):
    messages, expected, in_trunk = {}, {}, {}
    imu.node.create_subscription(Imu, "/imu/data", lambda m: messages.update({to_nanoseconds(m.header.stamp): m}), 1000)
    estimator, motion = TrunkEstimator(MOUNTING), bowing_and_walking(10.0)
    for moment, *values in zip(1000.0 + motion.times, motion.gyroscope, motion.accelerometer, strict=True):
        stamp = round(moment * 1e9)
        in_imu = (TRUNK_FROM_IMU.inv().apply(value).tolist() for value in values)
        answer = estimator.update(ImuSample(stamp * 1e-9, *in_imu))
        if answer is not None:
            expected[stamp], in_trunk[stamp] = answer, np.concatenate(values)
        imu.send(moment, *values, noise=0.0)
    imu.wait_until(lambda: max(expected) in imu.tilts and max(expected) in messages)
    assert imu.tilts.keys() == expected.keys()
    for stamp, tilt in imu.tilts.items():
        assert (tilt.y, tilt.x, tilt.z) == pytest.approx((expected[stamp].pitch, expected[stamp].roll, 0.0), abs=1e-9)
    for stamp, message in messages.items():
        variance, w, a = expected[stamp].uncertainty ** 2, message.angular_velocity, message.linear_acceleration
        assert message.orientation_covariance == pytest.approx(np.diag((variance, variance, math.pi**2)).ravel())
        q = message.orientation
        assert (q.x, q.y, q.z, q.w) == pytest.approx(expected[stamp].orientation)
        assert (w.x, w.y, w.z, a.x, a.y, a.z) == pytest.approx(in_trunk[stamp], abs=1e-9)


def test_silence_is_an_error_after_which_no_tilt_is_published_until_the_estimate_has_settled(imu):
    stamp = imu.settle(2000.0)
    imu.wait_until(lambda: imu.reports("no samples on /imu/data_raw", DiagnosticStatus.ERROR))
    imu.send(stamp + 0.5)
    imu.wait_until(lambda: imu.received == imu.sent)
    before = len(imu.reported)
    imu.wait_until(lambda: imu.reports("no samples", since=before))
    assert round((stamp + 0.5) * 1e9) not in imu.tilts


def test_a_refusal_is_reported_with_its_reason_and_gives_no_tilt(imu):
    stamp = imu.settle(3000.0)
    for k in range(30):
        imu.send(stamp + 0.01 * (k + 1), noise=0.0)
    imu.wait_until(lambda: imu.reports("the IMU or its driver is frozen") and imu.received == imu.sent)
    imu.wait_until(lambda: round((stamp + 0.09) * 1e9) in imu.tilts)
    assert not [number for number in imu.tilts if number > round((stamp + 0.11) * 1e9)]


def test_an_orientation_that_the_driver_does_not_have_is_fused_and_values_without_covariance_are_passed_on(imu):
    messages, tilted, missing = [], (0.0, G * math.sin(0.2), G * math.cos(0.2)), ((0.0,) * 4, (math.nan,) * 4)
    imu.node.create_subscription(Imu, "/imu/data", messages.append, 50)
    # 8 s of stamps each: what was learnt before is forgotten
    for start, orientation in zip((6000.0, 6004.0, 6008.0, 6012.0), np.repeat(missing, 2, axis=0), strict=True):
        stamp = imu.settle(start, (0.0, 0.0, 1e-3), tilted, orientation, covariance=-1.0)
        imu.wait_until(lambda: messages)
    assert imu.tilts[round(stamp * 1e9)].x == pytest.approx(0.2, abs=1e-3)
    assert messages[-1].angular_velocity.z == pytest.approx(1e-3)
    assert messages[-1].angular_velocity_covariance[0] == messages[-1].linear_acceleration_covariance[0] == 0.0


def test_samples_of_a_second_driver_are_an_error_and_give_no_tilt(imu):
    stamp = stamp_of_second = imu.settle(4000.0)
    first, imu.publisher = imu.publisher, imu.node.create_publisher(Imu, "/imu/data_raw", 50)
    imu.wait_until(lambda: imu.publisher.get_subscription_count())
    before = imu.received
    while imu.received == before:  # samples are lost until the node has matched the new publisher too
        stamp_of_second += 1.0  # after such a gap one sample is not enough, however long this process was not run
        imu.send(stamp_of_second, acceleration=(0.0, 1.0, 9.7))
        imu.executor.spin_once(timeout_sec=0.05)
    imu.wait_until(lambda: imu.reports("more than one publisher of /imu/data_raw", DiagnosticStatus.ERROR))
    assert max(imu.tilts) == round(stamp * 1e9)
    imu.publisher, imu.sent = first, imu.received


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], r"rotation_trunk_from_imu = \[0.0, 0.0, 0.0, 0.0\]: must be a unit quaternion"),
        (["-p", "input_topic:=/imu/data"], "input_topic = '/imu/data': must be a topic that this node does"),
    ],
)
def test_an_invalid_parameter_ends_the_start_with_one_sentence(arguments, sentence):
    rclpy.init(args=["--ros-args", *arguments])
    try:
        with pytest.raises(ParameterError, match=sentence):
            ImuShell()
    finally:
        rclpy.try_shutdown()
