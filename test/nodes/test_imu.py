# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The node `imu` as a process, over real DDS, with a trunk that moves and with impossible samples."""

from __future__ import annotations

import math
import subprocess
import sys

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
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator
from exo_gravity.nodes.imu import ImuNode as ImuShell
from exo_gravity.nodes.ros.messages import to_nanoseconds

from ..support.imu_faults import bowing_and_walking
from ..support.waiting import PATIENCE, wait_until

G = 9.80665
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
MOUNTING = Rotation.from_euler("xyz", (math.pi / 2, 0.0, math.pi / 2))  # trunk from IMU: its x points left, its y up
AHEAD = 25  # samples in flight: fewer than the node queues, so that none is lost
NODE = [sys.executable, "-c", "from exo_gravity.nodes.imu import main; main()", "--ros-args"]


class ImuNode:
    """One node as a process, a driver that feeds it, and a listener.

    tilts: vector by stamp in ns. sent, received: the number of samples sent, and of those the node has received.
    reported: the statuses so far; one lasts for a moment only.
    """

    def __init__(self, rotation):
        arguments = ("-p", f"rotation_trunk_from_imu:={[float(part) for part in rotation]}")
        self.process = subprocess.Popen([*NODE, *arguments], stdin=subprocess.PIPE)  # it ends with its stdin
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("imu_driver", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
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
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

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
        """Publish the sample of `stamp` s; wait while too many are in flight.

        covariance: of rate and acceleration, its first entry.
        """
        message = Imu()
        message.header.stamp = Time(nanoseconds=round(stamp * 1e9)).to_msg()
        for vector, values in ((message.angular_velocity, rate), (message.linear_acceleration, acceleration)):
            vector.x, vector.y, vector.z = map(float, values)
        q = message.orientation
        q.x, q.y, q.z, q.w = map(float, UPRIGHT if orientation is None else orientation)
        message.orientation_covariance[0] = -1.0 if orientation is None else 0.0
        message.angular_velocity_covariance[0] = message.linear_acceleration_covariance[0] = covariance
        self.sent += 1
        message.linear_acceleration.x += noise * (-1) ** self.sent
        self.publisher.publish(message)
        self._number[round(stamp * 1e9)] = self.sent
        self.wait_until(lambda: self.sent - self.received < AHEAD)

    def settle(self, start, **sample):
        """Send the same sample for 4 s of stamps, wait until the node has received all, and return the last stamp."""
        for stamp in start + 0.01 * np.arange(400):
            self.send(stamp, **sample)
        self.wait_until(lambda: self.received == self.sent and round(stamp * 1e9) in self.tilts)
        return float(stamp)


@pytest.fixture(scope="module")
def node(request):
    """A node whose IMU is aligned with the trunk, or mounted as the module's parameter states."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EXO_GRAVITY_SUPERVISED", "1")
        imu = ImuNode(getattr(request, "param", UPRIGHT))
    try:
        imu.wait_until(lambda: imu.publisher.get_subscription_count() and imu.reports("waiting"))
        yield imu
    finally:
        imu.close()


@pytest.fixture
def imu(node):
    """The same with no tilts and reports yet."""
    node.forget()
    return node


def test_every_sample_gives_the_tilt_of_the_estimator_with_its_covariance(imu):
    messages = {}
    imu.node.create_subscription(Imu, "/imu/data", lambda m: messages.update({to_nanoseconds(m.header.stamp): m}), 1000)
    estimator, expected, motion = TrunkEstimator(UPRIGHT), {}, bowing_and_walking(10.0)
    for moment, *values in zip(1000.0 + motion.times, motion.gyroscope, motion.accelerometer, strict=True):
        stamp = round(moment * 1e9)
        answer = estimator.update(ImuSample(stamp * 1e-9, *(value.tolist() for value in values)))
        if answer is not None:
            expected[stamp] = answer
        imu.send(moment, *values, noise=0.0)
    imu.wait_until(lambda: max(expected) in imu.tilts and max(expected) in messages)
    assert imu.tilts.keys() == expected.keys()
    for stamp, tilt in imu.tilts.items():
        assert (tilt.y, tilt.x) == pytest.approx((expected[stamp].pitch, expected[stamp].roll), abs=1e-9)
    for stamp, message in messages.items():
        variance = expected[stamp].uncertainty ** 2
        assert message.orientation_covariance == pytest.approx(np.diag((variance, variance, math.pi**2)).ravel())


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


def test_values_with_a_covariance_of_minus_1_are_used_and_passed_on_as_measured(imu):
    messages = []
    imu.node.create_subscription(Imu, "/imu/data", messages.append, 50)
    imu.settle(5000.0, rate=(0.0, 0.0, 1e-3), covariance=-1.0)
    imu.wait_until(lambda: messages)
    assert messages[-1].angular_velocity.z == pytest.approx(1e-3)
    assert messages[-1].angular_velocity_covariance[0] == messages[-1].linear_acceleration_covariance[0] == 0.0


@pytest.mark.parametrize("orientation", [(0.0,) * 4, (math.nan,) * 4], ids=["0 0 0 0", "NaN"])
def test_an_orientation_that_the_driver_does_not_have_is_fused(imu, orientation):
    for start in (6000.0, 6004.0):  # 8 s of stamps: what was learnt in the tests before is forgotten
        stamp = imu.settle(start, acceleration=(0.0, G * math.sin(0.2), G * math.cos(0.2)), orientation=orientation)
    assert imu.tilts[round(stamp * 1e9)].x == pytest.approx(0.2, abs=1e-3)


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


@pytest.mark.thorough
@pytest.mark.parametrize("node", [MOUNTING.as_quat()], indirect=True, ids=["turned"])
def test_a_turned_imu_gives_tilt_rate_and_acceleration_in_the_trunks_axes(imu):
    messages = []
    imu.node.create_subscription(Imu, "/imu/data", messages.append, 50)
    world_from_trunk = Rotation.from_euler("xyz", (0.2, 0.4, 1.0))
    world_from_imu = world_from_trunk * MOUNTING
    up = world_from_imu.inv().apply((0, 0, G))
    stamp = imu.settle(0.0, acceleration=up, rate=(0, 0, 1e-3), orientation=world_from_imu.as_quat())
    imu.wait_until(lambda: messages)
    tilt, data = imu.tilts[round(stamp * 1e9)], messages[-1]
    assert (tilt.x, tilt.y, tilt.z) == pytest.approx((0.2, 0.4, 0.0), abs=1e-9)
    q, w, a = data.orientation, data.angular_velocity, data.linear_acceleration
    assert Rotation.from_quat((q.x, q.y, q.z, q.w)).approx_equal(world_from_trunk, 1e-9)
    assert (w.x, w.y, w.z) == pytest.approx(MOUNTING.apply((0, 0, 1e-3)))
    assert (a.x, a.y, a.z) == pytest.approx(world_from_trunk.inv().apply((0, 0, G)))


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
