"""Subscribes to the trunk's tilt: `/imu/data`, and `/imu/pitch_yaw` for senders of that alone."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3Stamped
from rclpy.node import Node
from sensor_msgs.msg import Imu

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.rotation import unit_quaternion, up_in_body
from exo_gravity.core.trunk.tilt_input import STILL, Tilted, TiltInput
from exo_gravity.nodes.ros.hot_path import NEWEST, SolePublisher
from exo_gravity.nodes.ros.messages import to_nanoseconds

DATA, PITCH_YAW = "/imu/data", "/imu/pitch_yaw"
NOT_REPORTED = -1.0  # first entry of a covariance (REP-145)


class TiltSubscription:
    """Passes each message on to `target`, under `lock`.

    on_refusal(topic, error): a message is impossible; the last tilt then grows old. on_intruder(topic): a second
    publisher sends on it. on_motion(now, specific force (3,) m/s^2, angular velocity (3,) rad/s, age in s): a sample
    of the trunk's motion, in its axes, under `lock` too.
    """

    def __init__(
        self,
        node: Node,
        target: TiltInput | Tilted,
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
        q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
        rate = STILL if message.angular_velocity_covariance[0] == NOT_REPORTED else (w.x, w.y, w.z)

        def set_gravity(now: float, age: float) -> None:
            x, y, z = up_in_body(unit_quaternion("orientation", (q.x, q.y, q.z, q.w)))
            self._target.set_gravity(now, (-x, -y, -z), rate, age)
            if self._on_motion and message.linear_acceleration_covariance[0] != NOT_REPORTED:
                self._on_motion(now, (a.x, a.y, a.z), rate, age)

        self._pass_on(DATA, message.header.stamp, info, set_gravity)

    def _on_pitch_yaw(self, message: Vector3Stamped, info: dict[str, Any]) -> None:
        pitch, roll = message.vector.y, message.vector.x
        self._pass_on(
            PITCH_YAW, message.header.stamp, info, lambda now, age: self._target.set_tilt(now, pitch, roll, age)
        )

    def _pass_on(self, topic: str, stamp: Time, info: dict[str, Any], use: Callable[[float, float], None]) -> None:
        """Call `use` with the present monotonic time in s, and the age of the stamp in s by the node's clock."""
        if self._senders[topic].is_another(info):
            self._on_intruder(topic)
        age = (self._node.get_clock().now().nanoseconds - to_nanoseconds(stamp)) * 1e-9
        try:
            with self._lock:
                use(time.monotonic(), age)
        except ParameterError as error:
            self._on_refusal(topic, error)
