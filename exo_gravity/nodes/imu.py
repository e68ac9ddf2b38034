# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""imu: samples of an IMU in, from a driver's topic or a device, the trunk's pitch and roll out, one for each sample.

While samples are missing, impossible, frozen, not yet settled or from two publishers, it publishes nothing: the tilt
grows old, the compensator withdraws, and `can_bridge` latches the fault. The reason is logged once, and stays on
/diagnostics while it lasts. Samples of a device also go out on the topic that a driver would use, so that recordings
and `calibrate imu` have them.
"""

import math
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import Vector3Stamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Rate
from exo_gravity.core.params import loaded
from exo_gravity.core.trunk.checks import GROUP, IMU
from exo_gravity.core.trunk.inputs import NOT_REPORTED, check_trunk
from exo_gravity.core.vocabulary import NONE, UNKNOWN, ImuState
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.imu_source import Reopening
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator, TrunkOrientation
from exo_gravity.nodes.ros.imu_messages import message_of, sample_of
from exo_gravity.nodes.ros.messages import ERROR, OK, WARN, Diagnostics, milliseconds, row
from exo_gravity.nodes.ros.parameters import declare
from exo_gravity.nodes.ros.run import run
from exo_gravity.nodes.ros.subscriptions import (
    DATA,
    PITCH_YAW,
    Callback,
    PeriodicThread,
    PolledSubscription,
    Publishers,
    ThreadedNode,
)

# The fusion integrates every sample. A queue of depth 1 would lose samples whenever the node is delayed.
DEPTH = 50
WATCH_PERIOD = 0.1  # s
POLLS_A_SAMPLE = 2.0  # of a device
MIN_POLL_PERIOD = 0.002  # s
REFUSAL_TIME = 0.25  # s for which a refusal is reported: slow samples, each of which is refused, are 0.1 s apart
LOG_PERIOD = 1.0  # s between two warnings of lost samples
SAME_CLOCK = 5.0  # s between stamp and arrival
UNKNOWN_HEADING = math.pi**2  # rad^2, its variance


class ImuNode(ThreadedNode):
    """The ROS shell around `hardware.trunk_estimator.TrunkEstimator`."""

    def __init__(self) -> None:
        super().__init__("imu", automatically_declare_parameters_from_overrides=True)
        values = declare(self, IMU)
        self._topic = self.resolve_topic_name(values["input_topic"])
        if self._topic in (PITCH_YAW, DATA):
            raise ParameterError("input_topic", values["input_topic"], "a topic that this node does not publish")
        settings = ("rotation_trunk_from_imu", "rate", "gyroscope_range", "accelerometer_range")
        self._estimator = TrunkEstimator(*(values[name] for name in settings))
        self._timeout = values["timeout"]
        self._arrived = time.monotonic()
        self._driver = Publishers()
        self._received = self._published = self._refused = 0
        self._rate = Rate()
        self._refusal: ParameterError | None = None  # the last one,
        self._refused_at = -math.inf  # monotonic s
        self._diagnostics = Diagnostics(self)
        self._pitch_yaw = self.create_publisher(Vector3Stamped, PITCH_YAW, DEPTH)
        self._data = self.create_publisher(Imu, DATA, DEPTH)
        self._device = None if values["source"] == "topic" else ImuDevice(self, values, self._topic, self._on_imu)
        samples = self._device or PolledSubscription(
            self, Imu, self._topic, self._on_imu, QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        )
        self.create_timer(WATCH_PERIOD, self._report)
        self.threads.append(samples)
        samples.start()

    def _on_imu(self, message: Imu, info: dict[str, Any]) -> None:
        self._arrived = time.monotonic()
        self._received += 1
        self._driver.note(info)
        if self._driver.are_several:  # the estimator starts anew after the gap
            self._refused += 1
            return
        sample, now = sample_of(message), self.get_clock().now().nanoseconds * 1e-9
        if message.angular_velocity_covariance[0] == NOT_REPORTED and sample.angular_velocity is not None:
            sentence = "angular_velocity_covariance[0] = -1 says that it is not measured, but it is there: it is used"
            self.get_logger().warning(sentence, once=True)
        try:
            # The stamps of a record that is played back are not this computer's: the compensator refuses their age.
            orientation = self._estimator.update(sample, now if abs(now - sample.time) < SAME_CLOCK else None)
            if orientation is not None:
                check_trunk(Tilt.of_gravity(SIDES[0], orientation.gravity))
        except ParameterError as error:
            self._refused += 1
            self._refusal, self._refused_at = error, self._arrived
            return
        if orientation is not None:
            self._published += 1
            self._publish(message, sample, orientation)

    def _publish(self, message: Imu, sample: ImuSample, orientation: TrunkOrientation) -> None:
        tilt = Vector3Stamped()
        tilt.header.stamp, tilt.header.frame_id = message.header.stamp, "trunk"
        tilt.vector.x, tilt.vector.y = orientation.roll, orientation.pitch
        self._pitch_yaw.publish(tilt)
        data = Imu(header=tilt.header)
        q, rate, acceleration = data.orientation, data.angular_velocity, data.linear_acceleration
        q.x, q.y, q.z, q.w = orientation.orientation
        variance = orientation.uncertainty**2
        data.orientation_covariance = np.diag((variance, variance, UNKNOWN_HEADING)).ravel()
        # In the trunk's axes. A covariance of zeros means unknown, one of -1 means not reported (REP-145).
        for vector, covariance, values in (
            (rate, data.angular_velocity_covariance, sample.angular_velocity),
            (acceleration, data.linear_acceleration_covariance, sample.acceleration),
        ):
            covariance[0] = NOT_REPORTED if values is None else 0.0
            if values is not None:
                vector.x, vector.y, vector.z = (self._estimator.rotation @ values).tolist()
        self._data.publish(data)

    def _report(self) -> None:
        now = time.monotonic()
        age, refusal = now - self._arrived, self._refusal
        values: dict[str, object] = {
            "rate (Hz)": f"{self._rate.update(now, self._received):.0f}",
            "age of samples (ms)": milliseconds(age),
            "received": self._received,
            "missed": self._driver.missed,
            "published": self._published,
            "refused": self._refused,
            "refusal text": refusal or NONE,
            "gyroscope bias (rad/s)": row(self._estimator.gyroscope_bias, 4),
        }
        if self._device:
            values |= self._device.values
        if self._device and self._device.reopening.problem:
            level, state, message = ERROR, ImuState.NO_DEVICE, self._device.reopening.problem
        elif not self._received:
            level, state, message = WARN, ImuState.WAITING, f"waiting for {self._topic}"
        elif refusal and now - self._refused_at < REFUSAL_TIME:
            level, state, message = ERROR, ImuState.REFUSING, f"refused: {refusal.name} must be {refusal.expected}"
        elif age > self._timeout:
            level, state, message = ERROR, ImuState.STOPPED, f"no samples on {self._topic}"
        elif self._driver.are_several:
            level, state, message = ERROR, ImuState.SECOND_PUBLISHER, f"more than one publisher of {self._topic}"
        elif self._estimator.settling:
            level, state, message = WARN, ImuState.SETTLING, f"settling: {self._estimator.settling}"
        else:
            level, state, message = OK, ImuState.PUBLISHING, "publishing"
        self._diagnostics.report(level, message, {"state": state, **values})


class ImuDevice(PeriodicThread):
    """Calls `callback(message, info)` for each sample of a device: on a thread after `start`, or in each `poll`."""

    def __init__(
        self, node: Node, values: Mapping[str, Any], topic: str, callback: Callback, clock: Clock = COMPUTER_CLOCK
    ) -> None:
        """Open the device that the parameter values name; if it is missing, it is looked for again and again.

        topic: gets the messages too. clock: of the pauses between attempts; the stamps are by the node's. Raises
        ParameterError if a parameter does not suit the device.
        """
        period = max(MIN_POLL_PERIOD, 1.0 / (POLLS_A_SAMPLE * values["rate"]))
        super().__init__(values["source"], self.poll, period)
        self._node, self._callback, self._clock = node, callback, clock
        self._publisher = node.create_publisher(Imu, topic, DEPTH)
        stamps, opened = node.get_clock(), loaded(GROUP, values["source"], "source")
        self.reopening = Reopening(lambda: opened(values, lambda: stamps.now().nanoseconds * 1e-9))
        self._number = 0  # of the last message
        self._lost = 0  # samples, at the last poll
        self.poll()

    @property
    def values(self) -> dict[str, object]:
        """What is known of the device, for /diagnostics."""
        source, opened = self.reopening.source, self.reopening.openings
        if source is None:
            return {"device": NONE, "opened": opened}
        return {
            "device": source.name,
            "opened": opened,
            "lost samples": source.lost,
            "loss text": source.loss,
            "temperature (degC)": UNKNOWN if source.temperature is None else f"{source.temperature:.1f}",
        }

    def stop(self) -> None:
        """End the thread and close the device."""
        super().stop()
        self.reopening.close()

    def poll(self) -> None:
        """Pass on the samples since the last call; raises ParameterError as the constructor does."""
        for sample in self.reopening.read(self._clock.monotonic()):
            message = message_of(sample)
            self._publisher.publish(message)
            self._number += 1
            self._callback(message, {"publication_sequence_number": self._number})
        source = self.reopening.source
        if source and source.lost > self._lost:
            sentence = f"{source.name}: {source.lost} samples lost since it was opened, the last because: {source.loss}"
            self._node.get_logger().warning(sentence, throttle_duration_sec=LOG_PERIOD)
        self._lost = source.lost if source else 0


def main() -> None:
    """Entry point of the executable `imu`."""
    raise SystemExit(run(ImuNode, priority=15))
