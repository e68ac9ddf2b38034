"""Subscribes to the trunk's tilt: `/imu/data`, and `/imu/pitch_yaw` for senders of that alone."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3Stamped
from rclpy.node import Node
from sensor_msgs.msg import Imu

from exo_gravity.core.compensation.tilt_input import STILL
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.quaternion import unit_quaternion, up_in_body
from exo_gravity.nodes.ros.hot_path import NEWEST
from exo_gravity.nodes.ros.messages import to_nanoseconds
from exo_gravity.nodes.ros.sole_publisher import SolePublisher

DATA, PITCH_YAW = "/imu/data", "/imu/pitch_yaw"
NOT_REPORTED = -1.0  # first entry of a covariance (REP-145)


class TiltTarget(Protocol):
    """What is told the tilt: a `core.compensation.tilt_input.TiltInput`, or a compensator."""

    def set_tilt(self, now: float, pitch: float, roll: float, age: float = 0.0) -> None:
        """Set pitch and roll."""

    def set_gravity(
        self, now: float, gravity: Sequence[float], angular_velocity: Sequence[float] = STILL, age: float = 0.0
    ) -> None:
        """Set gravity's direction."""


class TiltSubscription:
    """Passes each message on to `target`, under `lock`.

    on_refusal(topic, error): a message is impossible; the last tilt then grows old. on_intruder(topic): a second
    publisher sends on it. on_motion(now, specific force (3,) m/s^2, angular velocity (3,) rad/s, age in s): a sample
    of the trunk's motion, in its axes, under `lock` too.
    """

    def __init__(
        self,
        node: Node,
        target: TiltTarget,
        lock: threading.Lock,
        on_refusal: Callable[[str, ParameterError], object],
        on_intruder: Callable[[str], object],
        on_motion: Callable[..., object] | None = None,
    ) -> None:
        self._node, self._target, self._lock = node, target, lock
        self._on_refusal, self._on_intruder, self._on_motion = on_refusal, on_intruder, on_motion
        self._senders = {topic: SolePublisher(node, topic) for topic in (DATA, PITCH_YAW)}
        node.create_subscription(Imu, DATA, self._on_data, NEWEST)
        node.create_subscription(Vector3Stamped, PITCH_YAW, self._on_pitch_yaw, NEWEST)

    def _on_data(self, message: Imu, info: dict[str, Any]) -> None:
        if message.orientation_covariance[0] == NOT_REPORTED:
            return  # another driver's raw data
        now, age = self._received(DATA, message.header.stamp, info)
        q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
        rate = STILL if message.angular_velocity_covariance[0] == NOT_REPORTED else (w.x, w.y, w.z)
        try:
            x, y, z = up_in_body(unit_quaternion("orientation", (q.x, q.y, q.z, q.w)))
            with self._lock:
                self._target.set_gravity(now, (-x, -y, -z), rate, age)
                if self._on_motion and message.linear_acceleration_covariance[0] != NOT_REPORTED:
                    self._on_motion(now, (a.x, a.y, a.z), rate, age)
        except ParameterError as error:
            self._on_refusal(DATA, error)

    def _on_pitch_yaw(self, message: Vector3Stamped, info: dict[str, Any]) -> None:
        now, age = self._received(PITCH_YAW, message.header.stamp, info)
        try:
            with self._lock:
                self._target.set_tilt(now, message.vector.y, message.vector.x, age)
        except ParameterError as error:
            self._on_refusal(PITCH_YAW, error)

    def _received(self, topic: str, stamp: Time, info: dict[str, Any]) -> tuple[float, float]:
        """Return the present monotonic time in s, and the age of the stamp in s by the node's clock."""
        if self._senders[topic].is_another(info):
            self._on_intruder(topic)
        return time.monotonic(), (self._node.get_clock().now().nanoseconds - to_nanoseconds(stamp)) * 1e-9
