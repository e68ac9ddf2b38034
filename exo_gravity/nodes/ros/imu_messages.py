# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/Imu <-> samples of an IMU. What a driver does not measure has a covariance of -1 (REP-145)."""

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3
from sensor_msgs.msg import Imu

from exo_gravity.core.trunk.checks import ImuSample, reported_orientation, reported_vector
from exo_gravity.core.trunk.inputs import NOT_REPORTED
from exo_gravity.nodes.ros.messages import to_nanoseconds


def sample_of(message: Imu) -> ImuSample:
    """Return the message's sample; a quantity that the driver does not measure is None."""
    q = message.orientation
    return ImuSample(
        to_nanoseconds(message.header.stamp) * 1e-9,
        reported_vector(_vector(message.angular_velocity), message.angular_velocity_covariance[0]),
        reported_vector(_vector(message.linear_acceleration), message.linear_acceleration_covariance[0]),
        reported_orientation((q.x, q.y, q.z, q.w), message.orientation_covariance[0]),
    )


def message_of(sample: ImuSample) -> Imu:
    """Return the sample's message, in the IMU's axes."""
    message = Imu()
    seconds, nanoseconds = divmod(round(sample.time * 1e9), 1_000_000_000)
    message.header.stamp, message.header.frame_id = Time(sec=seconds, nanosec=nanoseconds), "imu"
    for vector, covariance, values in (
        (message.orientation, message.orientation_covariance, sample.orientation),
        (message.angular_velocity, message.angular_velocity_covariance, sample.angular_velocity),
        (message.linear_acceleration, message.linear_acceleration_covariance, sample.acceleration),
    ):
        if values is None:
            covariance[0] = NOT_REPORTED
        for axis, value in zip("xyzw", values or (), strict=False):
            setattr(vector, axis, value)
    return message


def _vector(message: Vector3) -> tuple[float, float, float]:
    return message.x, message.y, message.z
