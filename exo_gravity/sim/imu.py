# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A trunk IMU: the motion of the trunk -> gyroscope and accelerometer in the IMU's axes, with sensor errors.

The trunk's orientation in the world is Ry(pitch) Rx(roll) (`core.arm.tilt`; heading is irrelevant). The accelerometer
measures specific force, the acceleration of its location less gravity: at rest +g upward (REP-145).
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.arm.interface import MAX_GRAVITY, STANDARD_GRAVITY
from exo_gravity.core.arm.tilt import gravity_in_trunk, pitch_roll, rotation_matrix
from exo_gravity.core.numbers import one_float
from exo_gravity.core.params import check_owned, owned
from exo_gravity.sim.trunk_motion import TrunkState

AVERAGED_SAMPLES = 100  # of one measured tilt
Sample = tuple[np.ndarray, np.ndarray]  # angular velocity (3,) rad/s and acceleration (3,) m/s^2, in the IMU's axes


@dataclass(frozen=True)
class ImuConfig:
    """A small MEMS IMU. Raises ParameterError that names the offending value."""

    rotation_trunk_from_imu: Sequence[float] = owned(
        (0.0, 0.0, 0.0, 1.0), "mounting of the IMU, unit quaternion x, y, z, w", (-1.0, 1.0), vector=True
    )
    rate: float = owned(100.0, "sample rate of the IMU", (10.0, 1000.0), "Hz")
    #: rad/s/sqrt(Hz) and m/s^2/sqrt(Hz): BMI160 data sheet, 0.007 deg/s and 180 ug.
    gyroscope_noise: float = math.radians(0.007)
    accelerometer_noise: float = 180e-6 * STANDARD_GRAVITY
    #: rad/s and m/s^2, standard deviation per axis of the offset at the start, as after a calibration at rest.
    #: Uncalibrated, the BMI160 has 3 deg/s and 40 mg.
    gyroscope_bias: float = math.radians(0.1)
    accelerometer_bias: float = 5e-3 * STANDARD_GRAVITY
    #: rad/s/sqrt(s) and m/s^2/sqrt(s), random walk of the offsets: Kalibr's example, an ADIS16448.
    gyroscope_walk: float = 4e-6
    accelerometer_walk: float = 2e-4
    #: rad/s and m/s^2, beyond which readings are cut off: the widest of most chips.
    gyroscope_range: float = math.radians(2000.0)
    accelerometer_range: float = 16.0 * STANDARD_GRAVITY
    #: Of the sensor's filters: MPU-6050 register map, low-pass of 94 Hz.
    delay: float = owned(0.003, "delay of the IMU's readings behind their stamps", (0.0, 0.1), "s")
    position: Sequence[float] = (0.0, 0.0, 0.0)  #: (3,) m from the shoulder, in the trunk's axes
    gravity: float = STANDARD_GRAVITY  #: m/s^2
    seed: int = 0

    def __post_init__(self) -> None:
        rotation_matrix(self.rotation_trunk_from_imu, "rotation_trunk_from_imu")
        check_owned(self)
        one_float("gravity", self.gravity, 0.0, MAX_GRAVITY, "m/s^2")


class SimulatedImu:
    """Samples of one IMU on one trunk, `rate` of them per s; the same seed gives the same errors."""

    def __init__(self, config: ImuConfig | None = None) -> None:
        self.config = config = config or ImuConfig()
        self._imu_from_trunk = rotation_matrix(config.rotation_trunk_from_imu).T
        self._random = np.random.default_rng(config.seed)
        self._bias = self._errors(config.gyroscope_bias, config.accelerometer_bias)
        bandwidth, root = math.sqrt(config.rate / 2), math.sqrt(config.rate)
        self._noise = config.gyroscope_noise * bandwidth, config.accelerometer_noise * bandwidth
        self._walk = config.gyroscope_walk / root, config.accelerometer_walk / root
        self._range = np.array(((config.gyroscope_range,), (config.accelerometer_range,)))
        self._place = np.array(config.position)
        # True readings, the newest last: as many as the delay spans.
        self._past: deque[np.ndarray] = deque(maxlen=math.ceil(config.delay * config.rate) + 1)

    def sample(self, state: TrunkState) -> Sample:
        """Return angular velocity (3,) in rad/s and acceleration (3,) in m/s^2, both in the IMU's axes."""
        self._past.append(self._readings(state))
        # Those `delay` s ago, interpolated; the oldest until that time has passed.
        back = min(self.config.delay * self.config.rate, len(self._past) - 1.0)
        whole = int(back)
        seen = self._past[-1 - whole]
        if whole < back:
            seen = seen + (back - whole) * (self._past[-2 - whole] - seen)
        self._bias += self._errors(*self._walk)
        readings = seen + self._bias + self._errors(*self._noise)
        angular_velocity, acceleration = np.clip(readings, -self._range, self._range)
        return angular_velocity, acceleration

    def _readings(self, state: TrunkState) -> np.ndarray:
        """Return the true readings, (2, 3)."""
        turning, spin_up = np.array(state.angular_velocity), np.array(state.angular_acceleration)
        force = np.array(state.acceleration) - self.config.gravity * gravity_in_trunk(state.pitch, state.roll)
        if self._place.any():
            force += np.cross(spin_up, self._place) + np.cross(turning, np.cross(turning, self._place))
        return np.array((self._imu_from_trunk @ turning, self._imu_from_trunk @ force))

    def _errors(self, gyroscope: float, accelerometer: float) -> np.ndarray:
        return self._random.normal(size=(2, 3)) * ((gyroscope,), (accelerometer,))


def measured_tilt(
    pitch: float, roll: float, imu: SimulatedImu, rotation_trunk_from_imu: Sequence[float]
) -> tuple[float, float]:
    """Return pitch and roll (rad) of a trunk at rest, as averaged IMU samples measure them.

    pitch, roll: the true ones, rad. rotation_trunk_from_imu: the mounting that the controller assumes.
    """
    rotation = rotation_matrix(rotation_trunk_from_imu, "rotation_trunk_from_imu")
    force = np.mean([imu.sample(TrunkState(pitch, roll))[1] for _ in range(AVERAGED_SAMPLES)], axis=0)
    return pitch_roll(-rotation @ force)
