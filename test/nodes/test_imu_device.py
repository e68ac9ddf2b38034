# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An IMU on a serial port that the node reads itself: the device in virtual time, and the node over real DDS.

How a device is opened again: hardware/test_imu_reopening.py.
"""

import itertools
import math
import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.time import Time

from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.nodes.imu import ImuDevice, ImuNode
from exo_gravity.nodes.ros.messages import to_nanoseconds
from exo_gravity.sim.virtual_time import VirtualClock

from ..support.fake_imu.chips import G
from ..support.fake_imu.serial import FakeSerialSensor, rvc_packet
from ..support.waiting import wait_until

keep_to_this_machine()
PERIOD = 0.01  # s


class Rig:
    """A BNO085 on a pseudo-terminal, and the node that reads it."""

    def __init__(self, port):
        self.sensor = FakeSerialSensor(port)
        self.values = {"source": "bno085", "rate": 100.0, "serial.port": str(port), "serial.baud": 115200}
        self.time = VirtualClock()
        self.received, self.published = [], []

    def read(self, count):
        """Open the device and read `count` samples."""
        device = ImuDevice(self, self.values, "/imu/data_raw", self._on_imu, self.time)
        for _ in range(count):
            self.time.sleep(PERIOD)
            self.sensor.deliver(rvc_packet(len(self.received) + 1, (90, 0, 0), (0, 0, 1000)))
            device.poll()

    def _on_imu(self, message, info):
        self.received.append((message, info["publication_sequence_number"]))

    # of the node
    def create_publisher(self, msgtype, topic, depth):
        return self

    def publish(self, message):
        self.published.append(message)

    def get_clock(self):
        return self

    def now(self):
        return Time(nanoseconds=round(self.time.monotonic() * 1e9))


@pytest.fixture
def rig(tmp_path):
    """A BNO085 that is plugged in."""
    rig = Rig(tmp_path / "imu")
    yield rig
    rig.sensor.unplug()


def test_each_sample_goes_to_the_callback_and_to_the_topic_once_and_in_order(rig):
    rig.read(20)
    messages, numbers = zip(*rig.received, strict=True)
    assert numbers == tuple(range(1, 21)) and rig.published == list(messages)


def test_a_message_is_stamped_when_it_was_taken_and_states_what_is_not_measured(rig):
    rig.read(1)
    message, _ = rig.received[-1]
    age = rig.now().nanoseconds - to_nanoseconds(message.header.stamp)
    assert age == pytest.approx(0.5e9 * PERIOD, rel=0.01)
    assert message.angular_velocity_covariance[0] == -1.0 and message.orientation_covariance[0] == 0.0
    assert message.linear_acceleration.z == pytest.approx(G) and message.orientation.z == pytest.approx(0.5**0.5)


def test_the_node_publishes_the_tilt_of_a_sensor_that_it_reads_itself_and_reports_its_absence(rig):
    arguments = ("source:=bno085", f"serial.port:={rig.sensor.port}", "rotation_trunk_from_imu:=[0.0, 0.0, 0.0, 1.0]")
    rclpy.init(args=["--ros-args", *(part for argument in arguments for part in ("-p", argument))])
    node, listener = ImuNode(), rclpy.create_node("imu_listener")
    executor = SingleThreadedExecutor()
    tilts, reports = [], [DiagnosticStatus()]
    executor.add_node(node)
    executor.add_node(listener)
    listener.create_subscription(Vector3Stamped, "/imu/pitch_yaw", tilts.append, 50)
    listener.create_subscription(DiagnosticArray, "/diagnostics", lambda message: reports.extend(message.status), 50)

    times = itertools.count(time.monotonic(), PERIOD)
    counters, due = itertools.count(), [next(times)]

    def spin():
        executor.spin_once(timeout_sec=0.002)

    def send_and_spin():
        if time.monotonic() >= due[0]:
            due[0] = next(times)
            # with noise, as every real one has
            rig.sensor.send(rvc_packet(next(counters), (0, 20, 0), (0, 342, 940 + round(due[0] / PERIOD) % 3)))
        spin()

    def wait(condition, meanwhile=send_and_spin):
        wait_until(condition, meanwhile, seen=lambda: reports[-1])

    try:
        wait(lambda: tilts)
        assert (tilts[-1].vector.x, tilts[-1].vector.y) == pytest.approx((math.radians(20), 0.0), abs=1e-3)
        wait(lambda: reports[-1].message == "publishing")
        rig.sensor.unplug()
        wait(lambda: f"BNO085 on {rig.sensor.port}: cannot be" in reports[-1].message, spin)
        assert reports[-1].level == DiagnosticStatus.ERROR
        rig.sensor.plug()
        wait(lambda: reports[-1].message == "publishing")
        assert int({pair.key: pair.value for pair in reports[-1].values}["opened"]) >= 2
    finally:
        node.close()
        executor.shutdown()
        node.destroy_node()
        listener.destroy_node()
        rclpy.try_shutdown()
