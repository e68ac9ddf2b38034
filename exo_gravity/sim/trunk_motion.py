# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How the trunk of a wearer moves: bowing, leaning, walking and sitting down hard; and what an IMU on it measures.

Each motion gives the trunk's tilt and the acceleration of the shoulder at any time. Trunk axes and the signs of pitch
and roll as in model/tilt.py; the heading stays constant. Bowing and leaning turn the trunk about the hips. Walking is
modelled as sines at the frequencies of steps and strides, fading in and out over a second.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.interface import MAX_GRAVITY, STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import ZERO, Floats3, acceleration_of
from exo_gravity.core.arm.tilt import gravity_in_trunk, pitch_roll, rotation_matrix
from exo_gravity.core.numbers import one_float
from exo_gravity.core.params import check_owned, owned
from exo_gravity.sim.script import Step

# Hip to shoulder: 0.288 of the stature (0.818 - 0.530, Drillis and Contini 1966, in Winter, Biomechanics and Motor
# Control of Human Movement) of 1.75 m. The shoulder's distance from the spine is neglected.
HIP_TO_SHOULDER: Floats3 = (0.0, 0.0, 0.5)  # m
FADE = 1.0  # s in which walking starts, and stops
SEAT_SPEED = 0.8  # m/s, of a free fall over the last 3 cm
# s. The impact is half a period of 5 Hz, at which a seated trunk resonates (Griffin, Handbook of Human Vibration); its
# peak is 1.3 g.
DESCENT, IMPACT = 0.5, 0.1


class TrunkState(NamedTuple):
    """The trunk at one moment, in rad, rad/s and rad/s^2."""

    pitch: float = 0.0
    roll: float = 0.0
    pitch_rate: float = 0.0
    roll_rate: float = 0.0
    pitch_acceleration: float = 0.0
    roll_acceleration: float = 0.0
    acceleration: Floats3 = ZERO  #: of the shoulder without gravity, (3,) m/s^2 in the trunk's axes

    @property
    def angular_velocity(self) -> Floats3:
        """(3,) rad/s in the trunk's axes: (roll', pitch' cos roll, -pitch' sin roll)."""
        return self.roll_rate, self.pitch_rate * math.cos(self.roll), -self.pitch_rate * math.sin(self.roll)

    @property
    def angular_acceleration(self) -> Floats3:
        """(3,) rad/s^2 in the trunk's axes, the derivative of `angular_velocity`."""
        cosine, sine, both = math.cos(self.roll), math.sin(self.roll), self.pitch_rate * self.roll_rate
        bow = self.pitch_acceleration
        return self.roll_acceleration, bow * cosine - both * sine, -bow * sine - both * cosine


@dataclass(frozen=True)
class Turn:
    """The trunk turns about the hips from one pitch and roll (rad) to another in `duration` s, with minimum jerk."""

    start: tuple[float, float]
    end: tuple[float, float]
    duration: float

    def at(self, elapsed: float) -> TrunkState:
        """Return the trunk's state `elapsed` s after the motion began."""
        way, pace, change = minimum_jerk(elapsed / self.duration)
        by = np.subtract(self.end, self.start)
        parts = self.start + way * by, by * pace / self.duration, by * change / self.duration**2
        state = TrunkState(*np.concatenate(parts).tolist())
        turning, spin_up = state.angular_velocity, state.angular_acceleration
        return state._replace(acceleration=acceleration_of(HIP_TO_SHOULDER, turning, spin_up))


@dataclass(frozen=True)
class Walk:
    """Walking at a comfortable speed, around the tilt at which it starts; a stride is two steps.

    The RMS of the accelerations, 0.17, 0.10 and 0.10 g, are of the order measured on trunks (Menz, Lord and Fitzpatrick
    2003; Kavanagh and Menz 2008). The ranges of the sway, 2 and 4 degrees, are of the order measured on the thorax
    (Crosbie et al. 1997). The thorax's rotation about the vertical is neglected.
    """

    start: tuple[float, float]
    duration: float
    stride: float = 0.95  #: per s
    #: Amplitudes in m/s^2 at the frequency of the steps, for the heel strike (vertical) at twice that.
    vertical: float = 0.23 * STANDARD_GRAVITY
    heel_strike: float = 0.06 * STANDARD_GRAVITY
    forward: float = 0.14 * STANDARD_GRAVITY
    lateral: float = 0.14 * STANDARD_GRAVITY  #: m/s^2, at the frequency of the strides
    pitch_sway: float = math.radians(1.0)  #: rad, at the frequency of the steps
    roll_sway: float = math.radians(2.0)  #: rad, at the frequency of the strides

    def at(self, elapsed: float) -> TrunkState:
        """Return the trunk's state `elapsed` s after the motion began."""
        fade = min(FADE, self.duration / 2.0)
        direction = 1.0 if elapsed < self.duration / 2.0 else -1.0
        share, slope, bend = minimum_jerk(min(elapsed, self.duration - elapsed) / fade)
        envelope = share, direction * slope / fade, bend / fade**2
        strides = 2.0 * math.pi * self.stride
        phase = strides * elapsed
        pitch = _swing(self.pitch_sway, 2.0 * strides, elapsed, envelope)
        roll = _swing(self.roll_sway, strides, elapsed, envelope)
        ahead = share * self.forward * math.sin(2.0 * phase)
        left = share * self.lateral * math.cos(phase)
        up = share * (self.vertical * math.cos(2.0 * phase) + self.heel_strike * math.cos(4.0 * phase))
        rates = pitch[1], roll[1], pitch[2], roll[2]
        tilt = self.start[0] + pitch[0], self.start[1] + roll[0]
        return TrunkState(*tilt, *rates, _in_trunk((ahead, left, up), *tilt))


@dataclass(frozen=True)
class SitDown:
    """Sitting down hard: the trunk gains `SEAT_SPEED` downwards and loses it on the seat; both are half sines."""

    start: tuple[float, float]

    def at(self, elapsed: float) -> TrunkState:
        """Return the trunk's state `elapsed` s after the motion began."""
        falls = elapsed < DESCENT
        since, duration = (elapsed, DESCENT) if falls else (elapsed - DESCENT, IMPACT)
        peak = math.pi * SEAT_SPEED / (2.0 * duration) * (-1.0 if falls else 1.0)
        up = peak * math.sin(math.pi * since / duration) if 0.0 <= since < duration else 0.0
        return TrunkState(*self.start, acceleration=_in_trunk((0.0, 0.0, up), *self.start))


TrunkMotion = Turn | Walk | SitDown


def motion_of(step: Step, pitch: float, roll: float) -> TrunkMotion | None:
    """Return what the trunk, now at `pitch` and `roll` in rad, does in a step of a script; None if it stays."""
    here = pitch, roll
    if step.action == "bow":
        return Turn(here, (step.value[0], roll), step.duration)
    if step.action == "lean":
        return Turn(here, (pitch, step.value[0]), step.duration)
    if step.action == "walk":
        return Walk(here, step.duration)
    return SitDown(here) if step.action == "sit" else None


def minimum_jerk(share: float) -> Floats3:
    """Return the way from 0 to 1 at a share of its duration, and its first and second derivatives by the share."""
    s = max(0.0, min(1.0, share))
    way = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    return way, 30.0 * s * s * (1.0 - s) ** 2, 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)


def _swing(amplitude: float, frequency: float, elapsed: float, envelope: Floats3) -> Floats3:
    """Return a sine times its envelope, and the first and second derivatives; frequency: rad/s."""
    size, slope, bend = envelope
    sine, cosine = amplitude * math.sin(frequency * elapsed), amplitude * math.cos(frequency * elapsed)
    rate = slope * sine + size * frequency * cosine
    return size * sine, rate, bend * sine + 2.0 * slope * frequency * cosine - size * frequency**2 * sine


def _in_trunk(level: Floats3, pitch: float, roll: float) -> Floats3:
    """Return a vector in the axes of an upright trunk (forward, left, up) in those of one at `pitch` and `roll`."""
    ahead, left, up = level
    x, z = ahead * math.cos(pitch) - up * math.sin(pitch), ahead * math.sin(pitch) + up * math.cos(pitch)
    return x, left * math.cos(roll) + z * math.sin(roll), z * math.cos(roll) - left * math.sin(roll)


AVERAGED_SAMPLES = 100  # of one measured tilt


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
    """Samples of one IMU on one trunk, `rate` of them per s; the same seed gives the same errors.

    The trunk's orientation in the world is Ry(pitch) Rx(roll) (`core.arm.tilt`; heading is irrelevant). The
    accelerometer measures specific force, the acceleration of its location less gravity: at rest +g upward (REP-145).
    """

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

    def sample(self, state: TrunkState) -> np.ndarray:
        """Return angular velocity in rad/s and acceleration in m/s^2, (2, 3), both in the IMU's axes."""
        self._past.append(self._readings(state))
        # Those `delay` s ago, interpolated; the oldest until that time has passed.
        back = min(self.config.delay * self.config.rate, len(self._past) - 1.0)
        whole = int(back)
        seen = self._past[-1 - whole]
        if whole < back:
            seen = seen + (back - whole) * (self._past[-2 - whole] - seen)
        self._bias += self._errors(*self._walk)
        readings = seen + self._bias + self._errors(*self._noise)
        return np.clip(readings, -self._range, self._range)

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
