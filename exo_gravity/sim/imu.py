"""A trunk IMU: pitch and roll of the trunk -> gyroscope and accelerometer in the IMU's axes, with sensor errors.

The trunk's orientation in the world is Ry(pitch) Rx(roll) (`core.tilt`; heading is irrelevant), so its angular velocity
in its own axes is (roll', pitch' cos roll, -pitch' sin roll). The accelerometer measures specific force: at rest +g
upward (REP-145). The trunk's own acceleration is neglected, as in the simulated arm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.arm import MAX_GRAVITY, STANDARD_GRAVITY, one_float
from exo_gravity.core.param_table import check_owned, owned
from exo_gravity.core.tilt import gravity_in_trunk, pitch_roll, rotation_matrix

AVERAGED_SAMPLES = 100  # of one measured tilt


@dataclass(frozen=True)
class ImuConfig:
    """A small MEMS IMU.

    gyroscope_noise rad/s/sqrt(Hz), accelerometer_noise m/s^2/sqrt(Hz): BMI160 data sheet, 0.007 deg/s and 180 ug.
    gyroscope_bias rad/s, accelerometer_bias m/s^2: standard deviation per axis of a constant offset; by default
    0.1 deg/s and 5 mg, what remains after a calibration at rest (uncalibrated, the BMI160 has 3 deg/s and 40 mg).
    gravity: m/s^2. Raises ParameterError that names the offending value.
    """

    rotation_trunk_from_imu: Sequence[float] = owned(
        (0.0, 0.0, 0.0, 1.0), "mounting of the IMU, unit quaternion x, y, z, w", (-1.0, 1.0)
    )
    rate: float = owned(100.0, "sample rate of the IMU", (10.0, 1000.0), "Hz")
    gyroscope_noise: float = math.radians(0.007)
    accelerometer_noise: float = 180e-6 * STANDARD_GRAVITY
    gyroscope_bias: float = math.radians(0.1)
    accelerometer_bias: float = 5e-3 * STANDARD_GRAVITY
    gravity: float = STANDARD_GRAVITY
    seed: int = 0

    def __post_init__(self) -> None:
        rotation_matrix(self.rotation_trunk_from_imu, "rotation_trunk_from_imu")
        check_owned(self)
        one_float("gravity", self.gravity, 0.0, MAX_GRAVITY, "m/s^2")
        for name in ("gyroscope_noise", "accelerometer_noise", "gyroscope_bias", "accelerometer_bias"):
            one_float(name, getattr(self, name), 0.0, 10.0)


class SimulatedImu:
    """Samples of one IMU on one trunk; the same seed gives the same errors."""

    def __init__(self, config: ImuConfig | None = None) -> None:
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

        pitch, roll: of the trunk, rad (REP-103). pitch_rate, roll_rate: rad/s.
        """
        angular_velocity = np.array((roll_rate, pitch_rate * math.cos(roll), -pitch_rate * math.sin(roll)))
        force = -self.config.gravity * gravity_in_trunk(pitch, roll)
        gyroscope_error, accelerometer_error = self._bias + self._errors(*self._noise)
        return (
            self._imu_from_trunk @ angular_velocity + gyroscope_error,
            self._imu_from_trunk @ force + accelerometer_error,
        )

    def _errors(self, gyroscope: float, accelerometer: float) -> np.ndarray:
        return self._random.normal(size=(2, 3)) * ((gyroscope,), (accelerometer,))


def measured_tilt(
    pitch: float, roll: float, imu: SimulatedImu, rotation_trunk_from_imu: Sequence[float]
) -> tuple[float, float]:
    """Return pitch and roll (rad) of a trunk at rest, as averaged IMU samples measure them.

    pitch, roll: the true ones, rad. rotation_trunk_from_imu: the mounting that the controller assumes.
    """
    rotation = rotation_matrix(rotation_trunk_from_imu, "rotation_trunk_from_imu")
    force = np.mean([imu.sample(pitch, roll)[1] for _ in range(AVERAGED_SAMPLES)], axis=0)
    return pitch_roll(-rotation @ force)
