"""The node `imu` in a process of its own, over real DDS, fed with a recording and with what an IMU must not say."""

import math
import os
import subprocess
import sys
import time
from pathlib import Path

import imufusion
import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from rclpy.executors import SingleThreadedExecutor
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu

from exo_gravity.core.tilt import gravity_in_trunk
from exo_gravity.nodes.conversions import to_nanoseconds, to_time

RECORDING = Path(__file__).parents[3] / "shared" / "data" / "imu_handheld.csv"
G = 9.80665
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
MOUNTING = Rotation.from_euler("xyz", (math.pi / 2, 0.0, math.pi / 2))  # trunk from IMU: its x points left, its y up
AHEAD = 25  # samples sent before the node has taken them: fewer than it queues, so that none is lost
NODE = [sys.executable, "-c", "from exo_gravity.nodes.imu import main; main()", "--ros-args"]


class Bench:
    """One node, a driver that feeds it, and a listener."""

    def __init__(self, rotation):
        arguments = ("-p", f"rotation_trunk_from_imu:={[float(part) for part in rotation]}")
        self.process = subprocess.Popen([*NODE, *arguments], stdin=subprocess.PIPE)  # ends with us, should we crash
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("bench", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.publisher = self.node.create_publisher(Imu, "/imu/data_raw", 50)
        self.node.create_subscription(Vector3Stamped, "/imu/pitch_yaw", self._on_tilt, 1000)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self.status = DiagnosticStatus()
        self.tilts = {}  # stamp in ns -> vector
        self.sent, self.received, self.order = 0, 0, {}

    def close(self):
        self.process.terminate()
        self.process.wait(10)
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def _on_tilt(self, message):
        stamp = to_nanoseconds(message.header.stamp)
        self.tilts[stamp] = message.vector
        self.received = max(self.received, self.order[stamp])

    def _on_diagnostics(self, message):
        (self.status,) = message.status
        values = {pair.key: pair.value for pair in self.status.values}
        self.received = max(self.received, int(values["received"]))

    def until(self, condition, timeout=20.0):
        end = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < end, f"{self.status.message!r}, {self.received} of {self.sent} samples taken"
            self.executor.spin_once(timeout_sec=0.05)

    def said(self, text):
        return text in self.status.message

    def send(self, stamp, rate=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, G), orientation=None):
        """Publish the sample of `stamp` s; wait while the node is far behind."""
        message = Imu()
        message.header.stamp = to_time(round(stamp * 1e9))
        for vector, values in ((message.angular_velocity, rate), (message.linear_acceleration, acceleration)):
            vector.x, vector.y, vector.z = map(float, values)
        q = message.orientation
        q.x, q.y, q.z, q.w = map(float, UPRIGHT if orientation is None else orientation)
        message.orientation_covariance[0] = -1.0 if orientation is None else 0.0
        self.publisher.publish(message)
        self.sent += 1
        self.order[round(stamp * 1e9)] = self.sent
        self.until(lambda: self.sent - self.received < AHEAD)

    def settle(self, start, **sample):
        """Send the same sample every 10 ms of stamps for 4 s, until the node has taken all; return the last stamp."""
        for stamp in start + 0.01 * np.arange(400):
            self.send(stamp, **sample)
        self.until(lambda: self.received == self.sent and round(stamp * 1e9) in self.tilts)
        return float(stamp)


@pytest.fixture
def bench(request, monkeypatch):
    """A node whose IMU is aligned with the trunk, or mounted as the test's parameter says."""
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("EXO_GRAVITY_SUPERVISED", "1")
    bench = Bench(getattr(request, "param", UPRIGHT))
    try:
        bench.until(lambda: bench.publisher.get_subscription_count() and bench.said("waiting"))
        yield bench
    finally:
        bench.close()


def test_every_sample_of_the_recording_is_answered_with_what_imufusion_says_by_itself(bench):
    if not RECORDING.exists():
        pytest.skip(f"the recording is not here: {RECORDING}")
    columns = np.loadtxt(RECORDING, delimiter=",", skiprows=1)
    ahrs, expected = imufusion.Ahrs(), {}
    for row, dt in zip(columns, np.diff(columns[:, 0], prepend=-0.01), strict=True):
        stamp, rate, acceleration = row[0], row[1:4], row[4:7]
        ahrs.set_sample_period(dt)
        ahrs.update_no_magnetometer(rate, acceleration)
        if not ahrs.get_flags().startup:
            expected[round(stamp * 1e9)] = -ahrs.get_gravity().astype(float)
        bench.send(stamp, np.radians(rate), G * acceleration)
    bench.until(lambda: max(expected) in bench.tilts)
    assert bench.tilts.keys() == expected.keys()
    given = np.array([gravity_in_trunk(tilt.y, tilt.x) for tilt in bench.tilts.values()])
    error = np.linalg.norm(given - list(expected.values()), axis=1)
    assert np.degrees(error.max()) < 0.1


def test_nothing_is_published_for_a_sample_that_is_not_a_number_and_the_reason_is_told(bench):
    stamp = bench.settle(1000.0)
    bench.send(stamp + 0.01, acceleration=(0, math.nan, G))
    bench.until(lambda: bench.said("refused: linear_acceleration must be 3 finite numbers"))
    bench.send(stamp + 0.02)
    bench.until(lambda: round((stamp + 0.02) * 1e9) in bench.tilts)
    assert round((stamp + 0.01) * 1e9) not in bench.tilts


def test_silence_is_an_error_and_after_it_nothing_is_published_until_it_has_settled(bench):
    stamp = bench.settle(2000.0)
    bench.until(lambda: bench.said("no samples on /imu/data_raw") and bench.status.level == DiagnosticStatus.ERROR)
    bench.send(stamp + 0.5)
    bench.until(lambda: bench.received == bench.sent)
    bench.until(lambda: bench.said("no samples"))
    assert round((stamp + 0.5) * 1e9) not in bench.tilts


@pytest.mark.parametrize("bench", [MOUNTING.as_quat()], indirect=True, ids=["turned"])
def test_a_turned_imu_gives_the_trunks_tilt_rate_and_acceleration(bench):
    everything = []
    bench.node.create_subscription(Imu, "/imu/data", everything.append, 50)
    world_from_trunk = Rotation.from_euler("xyz", (0.2, 0.4, 1.0))
    world_from_imu = world_from_trunk * MOUNTING
    up = world_from_imu.inv().apply((0, 0, G))
    stamp = bench.settle(0.0, acceleration=up, rate=(0, 0, 1e-3), orientation=world_from_imu.as_quat())
    bench.until(lambda: everything)
    tilt, data = bench.tilts[round(stamp * 1e9)], everything[-1]
    assert (tilt.x, tilt.y, tilt.z) == pytest.approx((0.2, 0.4, 0.0), abs=1e-9)
    q, w, a = data.orientation, data.angular_velocity, data.linear_acceleration
    assert Rotation.from_quat((q.x, q.y, q.z, q.w)).approx_equal(world_from_trunk, 1e-9)
    assert (w.x, w.y, w.z) == pytest.approx(MOUNTING.apply((0, 0, 1e-3)))
    assert (a.x, a.y, a.z) == pytest.approx(world_from_trunk.inv().apply((0, 0, G)))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "rotation_trunk_from_imu = [0.0, 0.0, 0.0, 0.0]: must be a unit quaternion"),
        (["-p", "rotation_trunk_from_imu:=[0.0, 0.0, 1.0]"], "rotation_trunk_from_imu = [0.0, 0.0, 1.0]: must be 4"),
        (
            ["-p", "input_topic:=/imu/data"],
            "input_topic = '/imu/data': must be a topic that this node does",
        ),
        (["-p", "timeot:=0.2"], "timeot = 0.2: must be one of"),
    ],
)
def test_wrong_parameters_end_the_node_with_one_sentence(arguments, sentence):
    environment = dict(os.environ, ROS_DOMAIN_ID="42", ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    ended = subprocess.run([*NODE, *arguments], env=environment, capture_output=True, text=True, timeout=30)
    assert ended.returncode == 2 and sentence in ended.stderr
