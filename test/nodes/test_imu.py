"""The node `imu` in virtual time, without middleware: a recording, impossible samples, silence and two drivers.

Over real DDS: test_imu_device.py, and every test of all nodes.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu

from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator
from exo_gravity.nodes.imu.node import ImuNode
from exo_gravity.nodes.ros.messages import to_nanoseconds, to_time
from exo_gravity.nodes.ros.sole_publisher import DISTRUST

from ..support.handheld_imu import read_recording
from ..support.virtual_ros import VirtualRos, start_ros

G = 9.80665
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
MOUNTING = Rotation.from_euler("xyz", (math.pi / 2, 0.0, math.pi / 2))  # trunk from IMU: its x points left, its y up
PERIOD = 0.01  # s


class Rig:
    """The node and its driver. tilts, data: the messages by stamp in ns. reports: (level, message) of each so far."""

    def __init__(self, ros, **parameters):
        start_ros("/", **parameters)
        self.ros, self.clock, self.sent = ros, ros.clock, 0
        self.node = ImuNode()
        self._driver = self.second_driver()

    def second_driver(self):
        return self.node.create_publisher(Imu, "/imu/data_raw", 1)

    @property
    def reports(self):
        reports = [status for array in self.ros.messages["/diagnostics"] for status in array.status]
        return [(status.level, status.message) for status in reports]

    @property
    def tilts(self):
        return self._by_stamp("/imu/pitch_yaw")

    @property
    def data(self):
        return self._by_stamp("/imu/data")

    def _by_stamp(self, topic):
        return {to_nanoseconds(message.header.stamp): message for message in self.ros.messages[topic]}

    def send(self, stamp, rate=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, G), orientation=None, noise=1e-9, driver=None):
        """Publish the sample of `stamp` s. driver: by default the same one for all."""
        message = Imu()
        message.header.stamp = to_time(round(stamp * 1e9))
        for vector, values in ((message.angular_velocity, rate), (message.linear_acceleration, acceleration)):
            vector.x, vector.y, vector.z = map(float, values)
        q = message.orientation
        q.x, q.y, q.z, q.w = map(float, UPRIGHT if orientation is None else orientation)
        message.orientation_covariance[0] = -1.0 if orientation is None else 0.0
        self.sent += 1
        message.linear_acceleration.x += noise * (-1) ** self.sent
        self.clock.sleep(PERIOD)
        (driver or self._driver).publish(message)

    def settle(self, start, **sample):
        """Send the same sample for 4 s and return the last stamp, of which there is a tilt."""
        for stamp in start + PERIOD * np.arange(400):
            self.send(stamp, **sample)
        assert round(stamp * 1e9) in self.tilts and self.reports[-1] == (DiagnosticStatus.OK, "publishing")
        return float(stamp)

    def reports_next(self):
        """Return what the node reports next."""
        before = len(self.reports)
        self.ros.wait_until(lambda: len(self.reports) > before)
        return self.reports[-1]


@pytest.fixture
def start(monkeypatch):
    """A function that starts the node with these parameters."""
    yield lambda **parameters: Rig(VirtualRos(monkeypatch), **parameters)
    rclpy.try_shutdown()


@pytest.fixture
def imu(start):
    """A node whose IMU is aligned with the trunk."""
    return start(rotation_trunk_from_imu=list(UPRIGHT))


def test_every_sample_of_a_recording_gives_the_tilt_of_the_estimator_with_its_covariance(imu):
    assert imu.reports_next() == (DiagnosticStatus.WARN, "waiting for /imu/data_raw")
    estimator, expected = TrunkEstimator(UPRIGHT), {}
    for moment, rate, acceleration in zip(*(column[:1000] for column in read_recording()), strict=True):
        stamp = round(moment * 1e9)
        imu.send(moment, np.radians(rate), G * acceleration, noise=0.0)
        answer = estimator.update(ImuSample(stamp * 1e-9, np.radians(rate).tolist(), (G * acceleration).tolist()))
        if answer is not None:
            expected[stamp] = answer
    assert imu.tilts.keys() == imu.data.keys() == expected.keys()
    data = imu.data
    for stamp, tilt in imu.tilts.items():
        answer = expected[stamp]
        assert (tilt.vector.y, tilt.vector.x) == pytest.approx((answer.pitch, answer.roll), abs=1e-9)
        variances = answer.uncertainty**2, answer.uncertainty**2, math.pi**2
        assert data[stamp].orientation_covariance == pytest.approx(np.diag(variances).ravel())


def test_silence_is_an_error_after_which_no_tilt_is_published_until_the_estimate_has_settled(imu):
    stamp = imu.settle(2000.0)
    imu.clock.sleep(0.5)
    assert imu.reports_next() == (DiagnosticStatus.ERROR, "no samples on /imu/data_raw")
    imu.send(stamp + 0.5)
    level, message = imu.reports_next()
    assert level == DiagnosticStatus.WARN and message.startswith("settling: ")
    assert max(imu.tilts) == round(stamp * 1e9)


def test_a_refusal_is_reported_with_its_reason_and_gives_no_tilt(imu):
    stamp = imu.settle(3000.0)
    for k in range(30):
        imu.send(stamp + PERIOD * (k + 1), noise=0.0)
    refusals = [message for level, message in imu.reports if level == DiagnosticStatus.ERROR]
    assert refusals and all("the IMU or its driver is frozen" in message for message in refusals)
    assert max(imu.tilts) in (round((stamp + late) * 1e9) for late in (0.09, 0.10))


def test_samples_of_a_second_driver_are_an_error_and_give_no_tilt(imu):
    stamp = imu.settle(4000.0)
    imu.send(stamp + 0.001, acceleration=(0.0, 1.0, 9.7), driver=imu.second_driver())
    for k in range(1, 15):
        imu.send(stamp + PERIOD * k)
    assert (DiagnosticStatus.ERROR, "more than one publisher of /imu/data_raw") in imu.reports
    assert max(imu.tilts) == round(stamp * 1e9)
    imu.clock.sleep(DISTRUST)
    imu.settle(stamp + 0.5)


def test_a_turned_imu_gives_tilt_rate_and_acceleration_in_the_trunks_axes(start):
    imu = start(rotation_trunk_from_imu=MOUNTING.as_quat().tolist())
    world_from_trunk = Rotation.from_euler("xyz", (0.2, 0.4, 1.0))
    world_from_imu = world_from_trunk * MOUNTING
    up = world_from_imu.inv().apply((0, 0, G))
    stamp = imu.settle(0.0, acceleration=up, rate=(0, 0, 1e-3), orientation=world_from_imu.as_quat())
    tilt, data = imu.tilts[round(stamp * 1e9)].vector, imu.data[round(stamp * 1e9)]
    assert (tilt.x, tilt.y, tilt.z) == pytest.approx((0.2, 0.4, 0.0), abs=1e-9)
    q, w, a = data.orientation, data.angular_velocity, data.linear_acceleration
    assert Rotation.from_quat((q.x, q.y, q.z, q.w)).approx_equal(world_from_trunk, 1e-9)
    assert (w.x, w.y, w.z) == pytest.approx(MOUNTING.apply((0, 0, 1e-3)))
    assert (a.x, a.y, a.z) == pytest.approx(world_from_trunk.inv().apply((0, 0, G)))


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({}, r"rotation_trunk_from_imu = \[0.0, 0.0, 0.0, 0.0\]: must be a unit quaternion"),
        ({"input_topic": "/imu/data"}, "input_topic = '/imu/data': must be a topic that this node does"),
    ],
)
def test_an_invalid_parameter_ends_the_start_with_one_sentence(start, parameters, sentence):
    with pytest.raises(ParameterError, match=sentence):
        start(**parameters)
