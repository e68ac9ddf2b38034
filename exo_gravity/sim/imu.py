"""A trunk IMU: pitch and roll of the trunk -> gyroscope and accelerometer, in the IMU's own axes, with its errors.

The trunk's orientation in the world is Ry(pitch) Rx(roll) (`core.tilt`; heading does not matter), so its angular
velocity in its own axes is (roll', pitch' cos roll, -pitch' sin roll). The accelerometer reads specific force: at rest
+g upward (REP-145). The trunk's own acceleration is left out, as in the simulated arm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.arm import MAX_GRAVITY, STANDARD_GRAVITY, one_float
from exo_gravity.core.tilt import gravity_in_trunk, rotation_matrix


@dataclass(frozen=True)
class ImuConfig:
    """A small MEMS IMU. Raises ParameterError that names what is impossible.

    rotation_trunk_from_imu: unit quaternion (x, y, z, w), how the IMU sits on the trunk. rate: Hz, samples per second.
    gyroscope_noise rad/s/sqrt(Hz), accelerometer_noise m/s^2/sqrt(Hz): BMI160 data sheet, 0.007 deg/s and 180 ug.
    gyroscope_bias rad/s, accelerometer_bias m/s^2: standard deviation per axis of an offset that stays; by default
    0.1 deg/s and 5 mg, what is left after a calibration at rest (uncalibrated, the BMI160 has 3 deg/s and 40 mg).
    """

    rotation_trunk_from_imu: Sequence[float] = (0.0, 0.0, 0.0, 1.0)
    rate: float = 100.0
    gyroscope_noise: float = math.radians(0.007)
    accelerometer_noise: float = 180e-6 * STANDARD_GRAVITY
    gyroscope_bias: float = math.radians(0.1)
    accelerometer_bias: float = 5e-3 * STANDARD_GRAVITY
    gravity: float = STANDARD_GRAVITY
    seed: int = 0

    def __post_init__(self):
        rotation_matrix(self.rotation_trunk_from_imu, "rotation_trunk_from_imu")
        one_float("rate", self.rate, 1.0, 10_000.0, "Hz")
        one_float("gravity", self.gravity, 0.0, MAX_GRAVITY, "m/s^2")
        for name in ("gyroscope_noise", "accelerometer_noise", "gyroscope_bias", "accelerometer_bias"):
            one_float(name, getattr(self, name), 0.0, 10.0)


class SimulatedImu:
    """Samples of one IMU on one trunk; the same seed gives the same errors."""

    def __init__(self, config: ImuConfig | None = None):
        self.config = config = config or ImuConfig()
        self._imu_from_trunk = rotation_matrix(config.rotation_trunk_from_imu).T
        self._random = np.random.default_rng(config.seed)
        self._bias = self._errors(config.gyroscope_bias, config.accelerometer_bias)
        bandwidth = config.rate / 2
        self._noise = (
            config.gyroscope_noise * math.sqrt(bandwidth),
            config.accelerometer_noise * math.sqrt(bandwidth),
        )

    def sample(
        self, pitch: float, roll: float, pitch_rate: float = 0.0, roll_rate: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return angular velocity (3,) in rad/s and acceleration (3,) in m/s^2, both in the IMU's axes.

        pitch, roll: the trunk's, rad (REP-103); pitch_rate, roll_rate: rad/s.
        """
        turning = np.array((roll_rate, pitch_rate * math.cos(roll), -pitch_rate * math.sin(roll)))
        force = -self.config.gravity * gravity_in_trunk(pitch, roll)
        gyroscope_error, accelerometer_error = self._bias + self._errors(*self._noise)
        return self._imu_from_trunk @ turning + gyroscope_error, self._imu_from_trunk @ force + accelerometer_error

    def _errors(self, gyroscope: float, accelerometer: float) -> np.ndarray:
        return self._random.normal(size=(2, 3)) * ((gyroscope,), (accelerometer,))
