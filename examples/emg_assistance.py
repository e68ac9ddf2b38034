# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An outer loop: assists the right elbow in proportion to the wearer's muscle signals. Needs ROS.

Subscribes to /emg (std_msgs/Float32MultiArray, biceps and triceps in V, sample after sample, 1,000 a second) and
publishes /right/assist_efforts at 100 Hz. The compensator adds them once `assist.max_effort` is not 0.

Without electrodes: `python examples/emg_assistance.py --pretend` publishes a synthetic EMG on /emg as well, biceps and
triceps in turn, 2 s each.
"""

import random
import sys
from math import exp, pi, sqrt

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32MultiArray

NAMES = [f"right_{part}" for part in ("shoulder_rotation", "shoulder_abduction", "shoulder_flexion", "elbow_flexion")]
SAMPLE = 0.001  # s
CUT_OFF = 3.0  # Hz: the envelope then follows the force of a muscle
REST, STRONGEST = 0.02e-3, 0.4e-3  # V, envelopes of the resting and of the strongest contraction; measure them first
LEAST = 0.05  # share of the strongest contraction below which nothing happens
SILENCE = Duration(seconds=0.05)  # without EMG
FULL_EFFORT = 2.0  # Nm for the strongest contraction
WAITING = "waiting for /emg (std_msgs/Float32MultiArray: biceps, triceps in V, 1,000 samples a second), or --pretend"
UNHEARD = "no compensator subscribes to /right/assist_efforts: start the right arm, and set its assist.max_effort"
CONTRACTIONS = ((0.3e-3, REST), (REST, REST), (REST, 0.3e-3), (REST, REST))  # V, biceps and triceps, 2 s each


class Envelope:
    """One muscle: mean removed, rectified, low-passed twice, normalised to 0..1."""

    def __init__(self):
        self.mean = self.once = self.twice = 0.0

    def add(self, volt):
        """Take a sample."""
        self.mean += (1.0 - exp(-2.0 * pi * 0.5 * SAMPLE)) * (volt - self.mean)  # electrodes drift below 0.5 Hz
        share = 1.0 - exp(-2.0 * pi * CUT_OFF * SAMPLE)
        self.once += share * (abs(volt - self.mean) - self.once)
        self.twice += share * (self.once - self.twice)

    @property
    def activation(self):
        """How strongly the muscle contracts, 0..1."""
        share = (self.twice - REST) / (STRONGEST - REST)
        return 0.0 if share < LEAST else min(1.0, share)


class EmgAssistance(Node):
    """From EMG samples to efforts."""

    def __init__(self):
        super().__init__("emg_assistance")
        self.biceps, self.triceps = Envelope(), Envelope()
        self.heard = None
        self.publisher = self.create_publisher(JointState, "/right/assist_efforts", 1)
        self.create_subscription(Float32MultiArray, "/emg", self.on_emg, 10)
        self.create_timer(0.01, self.publish)
        self.create_timer(5.0, self.report)
        self.report()

    def is_silent(self):
        """Return whether no EMG arrives."""
        return self.heard is None or self.get_clock().now() - self.heard > SILENCE

    def report(self):
        """Say what the assistance waits for, or what it does."""
        if self.is_silent():
            self.get_logger().info(WAITING)
        elif not self.publisher.get_subscription_count():
            self.get_logger().info(UNHEARD)
        else:
            biceps, triceps = (100.0 * muscle.activation for muscle in (self.biceps, self.triceps))
            self.get_logger().info(f"sending efforts: biceps {biceps:.0f} %, triceps {triceps:.0f} %")

    def on_emg(self, message):
        """Take samples of both muscles, in turn."""
        for biceps, triceps in zip(message.data[::2], message.data[1::2], strict=True):
            self.biceps.add(biceps)
            self.triceps.add(triceps)
        self.heard = self.get_clock().now()

    def publish(self):
        """Send the elbow's effort while there is EMG."""
        if self.is_silent():  # no message: the compensator fades the assistance
            return
        elbow = FULL_EFFORT * (self.biceps.activation - self.triceps.activation)
        message = JointState(name=NAMES, effort=[0.0, 0.0, 0.0, elbow])
        message.header.stamp = self.get_clock().now().to_msg()
        self.publisher.publish(message)


def pretend(node):
    """Publish a synthetic EMG: noise on an electrode's offset, as strong as the present contraction."""
    publisher = node.create_publisher(Float32MultiArray, "/emg", 10)
    begin = node.get_clock().now()

    def send():
        now = (node.get_clock().now() - begin).nanoseconds / 1e9
        strengths = CONTRACTIONS[int(now / 2.0) % len(CONTRACTIONS)]  # rectified means
        samples = [random.gauss(1e-3, strength * sqrt(pi / 2.0)) for _ in range(10) for strength in strengths]
        publisher.publish(Float32MultiArray(data=samples))

    node.create_timer(0.01, send)


if __name__ == "__main__":
    rclpy.init()
    node = EmgAssistance()
    if "--pretend" in sys.argv:
        pretend(node)
    rclpy.spin(node)
