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
from exo_gravity.hardware import ImuSample, TrunkEstimator
from exo_gravity.nodes.imu import node as imu_node
from exo_gravity.nodes.imu.node import WATCH_PERIOD, ImuNode
from exo_gravity.nodes.ros.messages import to_nanoseconds, to_time
from exo_gravity.nodes.ros.sole_publisher import DISTRUST

from ..hardware.virtual_time import VirtualClock
from ..support.handheld_imu import read_recording

G = 9.80665
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
MOUNTING = Rotation.from_euler("xyz", (math.pi / 2, 0.0, math.pi / 2))  # trunk from IMU: its x points left, its y up
PERIOD = 0.01  # s


class Rig:
    """The node, its driver and who listens to it.

    tilts, data: the messages by stamp in ns. reports: (level, message) of each report so far.
    """

    def __init__(self, monkeypatch, *parameters):
        self.clock, self.reports, self.sent = VirtualClock(), [], 0
        self.tilts, self.data = {}, {}
        monkeypatch.setattr(imu_node, "time", self.clock)
        monkeypatch.setattr(imu_node, "HotPath", self._subscribe)
        monkeypatch.setattr(imu_node, "Diagnostics", lambda node: self)
        monkeypatch.setattr(ImuNode, "create_publisher", self._publisher)
        monkeypatch.setattr(ImuNode, "create_timer", lambda node, period, callback: self.clock.every(period, callback))
        rclpy.init(args=["--ros-args", *(word for text in parameters for word in ("-p", text))])
        self.node = ImuNode()

    def _publisher(self, msgtype, topic, *rest, **options):
        kept = {"/imu/pitch_yaw": self.tilts, "/imu/data": self.data}
        return Topic(kept.get(topic))

    def _subscribe(self, node, msgtype, topic, callback, qos):
        self._on_imu = callback
        return self

    def start(self):
        """As a subscription."""

    def report(self, level, message, values):
        """As the node's diagnostics."""
        self.reports.append((level, message))

    def send(self, stamp, rate=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, G), orientation=None, noise=1e-9, number=None):
        """Give the sample of `stamp` s to the node. number: of the message, by default the next one."""
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
        self._on_imu(message, {"publication_sequence_number": number or self.sent})

    def settle(self, start, **sample):
        """Send the same sample for 4 s and return the last stamp, of which there is a tilt."""
        for stamp in start + PERIOD * np.arange(400):
            self.send(stamp, **sample)
        assert round(stamp * 1e9) in self.tilts and self.reports[-1] == (DiagnosticStatus.OK, "publishing")
        return float(stamp)

    def reports_next(self):
        """Return what the node reports next."""
        self.clock.sleep(1.1 * WATCH_PERIOD)
        return self.reports[-1]


class Topic:
    """Keeps what is published by stamp; None: nothing."""

    def __init__(self, messages):
        self.messages = messages

    def publish(self, message):
        if self.messages is not None:
            self.messages[to_nanoseconds(message.header.stamp)] = message


@pytest.fixture
def start(monkeypatch):
    """A function that starts the node with these parameters."""
    yield lambda *parameters: Rig(monkeypatch, *parameters)
    rclpy.try_shutdown()


@pytest.fixture
def imu(start):
    """A node whose IMU is aligned with the trunk."""
    return start(f"rotation_trunk_from_imu:={list(UPRIGHT)}")


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
    for stamp, answer in expected.items():
        tilt, variance = imu.tilts[stamp].vector, answer.uncertainty**2
        assert (tilt.y, tilt.x) == pytest.approx((answer.pitch, answer.roll), abs=1e-9)
        covariance = np.diag((variance, variance, math.pi**2)).ravel()
        assert imu.data[stamp].orientation_covariance == pytest.approx(covariance)


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
    assert len(refusals) >= 2 and all("the IMU or its driver is frozen" in message for message in refusals)
    assert max(imu.tilts) in (round((stamp + late) * 1e9) for late in (0.09, 0.10))


def test_samples_of_a_second_driver_are_an_error_and_give_no_tilt(imu):
    stamp = imu.settle(4000.0)
    imu.send(stamp + 0.001, acceleration=(0.0, 1.0, 9.7), number=1)
    for k in range(1, 15):
        imu.send(stamp + PERIOD * k)
    assert (DiagnosticStatus.ERROR, "more than one publisher of /imu/data_raw") in imu.reports
    assert max(imu.tilts) == round(stamp * 1e9)
    imu.clock.sleep(DISTRUST)
    imu.settle(stamp + 0.5)


def test_a_turned_imu_gives_tilt_rate_and_acceleration_in_the_trunks_axes(start):
    imu = start(f"rotation_trunk_from_imu:={MOUNTING.as_quat().tolist()}")
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
        ([], r"rotation_trunk_from_imu = \[0.0, 0.0, 0.0, 0.0\]: must be a unit quaternion"),
        (["input_topic:=/imu/data"], "input_topic = '/imu/data': must be a topic that this node does"),
    ],
)
def test_an_invalid_parameter_ends_the_start_with_one_sentence(start, parameters, sentence):
    with pytest.raises(ParameterError, match=sentence):
        start(*parameters)
