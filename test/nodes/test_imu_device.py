"""An IMU on a serial port that the node reads itself, over real DDS in this process."""

import math
import threading
import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Imu

from exo_gravity.core.errors import ParameterError
from exo_gravity.nodes.imu.device import ImuDevice
from exo_gravity.nodes.imu.node import ImuNode
from exo_gravity.nodes.ros.messages import to_nanoseconds
from exo_gravity.nodes.ros.run import keep_to_this_machine

from ..support.fake_imu.chip import G
from ..support.fake_imu.serial import FakeSerialSensor, rvc_packet

keep_to_this_machine()
TOPIC = "/imu/data_raw"


class Rig:
    """A BNO085 that sends on a pseudo-terminal, the device that reads it, and a listener on the topic."""

    def __init__(self, port, **values):
        self.sensor = FakeSerialSensor(port)
        self.values = {"source": "bno085", "rate": 100.0, "serial.port": str(port), "serial.baud": 115200} | values
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("imu_device_test", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.received, self.published = [], []
        self.node.create_subscription(Imu, TOPIC, self.published.append, 50)
        self.counter = 0
        self.device = None

    def start(self):
        self.device = ImuDevice(self.node, self.values, TOPIC, self._on_imu)
        self.device.start()
        self.wait_until(lambda: self.device._publisher.get_subscription_count() == 1)

    def _on_imu(self, message, info):
        self.received.append((message, info["publication_sequence_number"], threading.current_thread().name))

    def send(self):
        self.counter += 1
        self.sensor.send(rvc_packet(self.counter, (90, 0, 0), (0, 0, 1000)))

    def wait_until(self, condition, action=lambda: None):
        end = time.monotonic() + 20.0
        while not condition():
            action()
            assert time.monotonic() < end, self.device.problem
            self.executor.spin_once(timeout_sec=0.01)

    def close(self):
        if self.device:
            self.device.stop()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)
        self.sensor.unplug()


@pytest.fixture
def rig(tmp_path):
    """A BNO085 that is plugged in."""
    rig = Rig(tmp_path / "imu")
    yield rig
    rig.close()


def test_each_sample_goes_to_the_callback_and_to_the_topic_once_and_in_order(rig):
    rig.start()
    rig.wait_until(lambda: len(rig.received) >= 20, rig.send)
    rig.wait_until(lambda: len(rig.published) == len(rig.received))
    assert [number for _, number, _ in rig.received] == list(range(1, len(rig.received) + 1))
    assert {thread for _, _, thread in rig.received[1:]} == {"bno085"}
    assert [message.header.stamp for message in rig.published] == [
        message.header.stamp for message, _, _ in rig.received
    ]


def test_a_message_is_stamped_when_it_was_taken_and_says_what_is_not_measured(rig):
    rig.start()
    rig.wait_until(lambda: rig.received, rig.send)
    message = rig.received[-1][0]
    age = rig.node.get_clock().now().nanoseconds - to_nanoseconds(message.header.stamp)
    assert 0 <= age < 1e9
    assert message.angular_velocity_covariance[0] == -1.0 and message.orientation_covariance[0] == 0.0
    assert message.linear_acceleration.z == pytest.approx(G) and message.orientation.z == pytest.approx(0.5**0.5)


def test_a_sensor_that_is_unplugged_is_named_and_comes_back_by_itself(rig):
    rig.start()
    rig.wait_until(lambda: rig.received, rig.send)
    rig.wait_until(lambda: rig.device.problem == "")
    assert rig.device.values["device"] == f"BNO085 on {rig.sensor.port}"
    rig.sensor.unplug()
    rig.wait_until(lambda: f"BNO085 on {rig.sensor.port}: cannot be" in rig.device.problem)
    rig.sensor.plug()
    before = len(rig.received)
    rig.wait_until(lambda: len(rig.received) > before, rig.send)
    assert rig.device.problem == "" and rig.device.failure is None and rig.device.values["opened"] >= 2


def test_a_sensor_that_is_missing_at_the_start_is_waited_for(rig):
    rig.sensor.unplug()
    rig.start()
    assert "cannot be opened" in rig.device.problem
    rig.sensor.plug()
    rig.wait_until(lambda: rig.received, rig.send)


def test_a_parameter_that_does_not_suit_the_device_is_an_error_at_the_start(rig):
    rig.values["source"], rig.values["serial.baud"] = "witmotion", 9600
    with pytest.raises(ParameterError, match=r"serial\.baud = 9600"):
        rig.start()


class NodeRig:
    """The node `imu` in this process, which reads a BNO085 itself, and a listener."""

    def __init__(self, port):
        self.sensor = FakeSerialSensor(port)
        arguments = ("source:=bno085", f"serial.port:={port}", "rotation_trunk_from_imu:=[0.0, 0.0, 0.0, 1.0]")
        rclpy.init(args=["--ros-args", *(part for argument in arguments for part in ("-p", argument))])
        self.node, self.listener = ImuNode(), rclpy.create_node("imu_listener")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.executor.add_node(self.listener)
        self.tilts, self.status = [], DiagnosticStatus()
        self.listener.create_subscription(Vector3Stamped, "/imu/pitch_yaw", self.tilts.append, 50)
        self.listener.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self.counter = 0

    def _on_diagnostics(self, message):
        (self.status,) = message.status

    def send(self):
        """Send a level sensor's packet with noise, as every real one has."""
        self.counter += 1
        self.sensor.send(rvc_packet(self.counter, (0, 20, 0), (0, 342, 940 + self.counter % 3)))

    def wait_until(self, condition, action=lambda: None):
        end, due = time.monotonic() + 20.0, time.monotonic()
        while not condition():
            assert time.monotonic() < end, self.status
            if time.monotonic() >= due:
                due += 0.01
                action()
            self.executor.spin_once(timeout_sec=0.002)

    def close(self):
        self.node.close()
        self.executor.shutdown()
        self.node.destroy_node()
        self.listener.destroy_node()
        rclpy.try_shutdown()
        self.sensor.unplug()


@pytest.fixture
def node_rig(tmp_path):
    """The node `imu` with a BNO085."""
    rig = NodeRig(tmp_path / "imu")
    yield rig
    rig.close()


def test_the_node_publishes_the_tilt_of_a_sensor_that_it_reads_itself_and_reports_its_absence(node_rig):
    node_rig.wait_until(lambda: node_rig.tilts, node_rig.send)
    tilt = node_rig.tilts[-1].vector
    assert (tilt.x, tilt.y) == pytest.approx((math.radians(20), 0.0), abs=1e-3)
    node_rig.wait_until(lambda: node_rig.status.message == "publishing", node_rig.send)
    node_rig.sensor.unplug()
    node_rig.wait_until(lambda: f"BNO085 on {node_rig.sensor.port}: cannot be" in node_rig.status.message)
    assert node_rig.status.level == DiagnosticStatus.ERROR
    node_rig.sensor.plug()
    node_rig.wait_until(lambda: node_rig.status.message == "publishing", node_rig.send)
    assert int({pair.key: pair.value for pair in node_rig.status.values}["opened"]) >= 2
