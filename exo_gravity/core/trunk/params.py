# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The parameters of `imu`."""

from exo_gravity.core.params import OpenChoices, Param
from exo_gravity.core.trunk import checks

GROUP = "exo_gravity.imu_sources"


class ImuSources(OpenChoices):
    """A driver's topic, and what the node `imu` reads itself."""

    group = GROUP


# fmt: off
IMU = (
    Param("source", "topic", "a driver's topic, or a chip on I2C", fixed=True,
          choices=ImuSources(("topic", "mpu6050", "icm20948", "lsm6dsox"))),
    Param("input_topic", "/imu/data_raw", "the driver's topic, a sensor_msgs/Imu", fixed=True),
    Param("i2c.bus", 1, "number n of the bus /dev/i2c-n", (0, 255), fixed=True),
    Param("i2c.address", 0, "address of the chip; 0: the usual one of its boards", (0, 0x77), fixed=True),
    # No rotation would be a safe default. Four zeros are not a rotation, so the node rejects them.
    Param("rotation_trunk_from_imu", [0.0] * 4, "its mounting, unit quaternion x, y, z, w; required",
          (-1.0, 1.0), fixed=True, vector=True),
    Param("rate", 100.0, "nominal sample rate", (checks.RateCheck.least, 2000.0), "Hz", fixed=True),
    Param("gyroscope_range", checks.GYROSCOPE_RANGE, "rate at which it saturates",
          checks.GYROSCOPE_RANGES, "rad/s", fixed=True),
    Param("accelerometer_range", checks.ACCELEROMETER_RANGE, "where it saturates",
          checks.ACCELEROMETER_RANGES, "m/s^2", fixed=True),
    Param("timeout", 0.1, "time without IMU data that is an error", (0.02, 1.0), "s", fixed=True),
)
# fmt: on
