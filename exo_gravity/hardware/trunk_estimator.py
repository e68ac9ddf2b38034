"""Samples of an inertial measurement unit (IMU) on the trunk -> the trunk's orientation, pitch and roll.

An orientation that the IMU reports is used as it is. Without one, imufusion (x-io Technologies' AHRS, the revised
algorithm of chapter 7 of S. Madgwick's thesis) fuses gyroscope and accelerometer. Without a magnetometer the heading
drifts, on which neither pitch nor roll depends.

Every sample is accepted, or refused with the reason. After a start, a gap or a jump there is no output until the
estimate has settled again, nor while the estimate contradicts the accelerometer at rest: the output never jumps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm import STANDARD_GRAVITY, Vector, one_float
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.tilt import gravity_from_orientation, pitch_roll, rotation_matrix
from exo_gravity.hardware.freeze_check import FreezeCheck

try:
    import imufusion
except ImportError:  # needed only for an IMU that reports no orientation
    imufusion = None  # type: ignore[assignment]  # the module's absence

MAX_GAP = 0.1  # s between two samples: at 6 rad/s the trunk turns by 34 degrees in it
SETTLE_TIME = 1.0  # s of continuous samples before a reported orientation is used
MAX_RATE = 15.0  # rad/s about any axis: no trunk turns faster; a gyroscope that reports deg/s exceeds it at once
# m/s^2. Below: free fall, a dead accelerometer or one that reports g. Above: more than a knock.
ACCELERATION_RANGE = (2.0, 80.0)
# Estimate and accelerometer differ while the trunk accelerates. If they differ for long while the accelerometer shows
# 1 g, the driver reports an orientation it does not have, its world z points down, or a unit or an axis is wrong.
MAX_CONTRADICTION = math.radians(20.0)
CONTRADICTION_TIME = 0.5  # s; less than SETTLE_TIME, so that a wrong orientation is never used
NEAR_GRAVITY = 0.1  # share of 1 g


class ImuSample(NamedTuple):
    """One sample in the IMU's own axes.

    time: s, when it was taken, not when it arrived. angular_velocity: (3,) rad/s; acceleration: (3,) m/s^2, +9.8
    upward at rest (REP-145). orientation: (x, y, z, w), world from IMU, world z up. None marks what the IMU does not
    report; without an orientation the other two are required.
    """

    time: float
    angular_velocity: Sequence[float] | None
    acceleration: Sequence[float] | None
    orientation: Sequence[float] | None = None


class TrunkOrientation(NamedTuple):
    """pitch, roll: rad (REP-103: pitch > 0 bows forward, roll > 0 leans right).

    orientation: (x, y, z, w), world from trunk; its heading is arbitrary.
    """

    pitch: float
    roll: float
    orientation: np.ndarray


class TrunkEstimator:
    """Follows one IMU.

    rotation: (3, 3), trunk from IMU. settling: why there is no orientation yet; empty once there is.
    """

    def __init__(self, rotation_trunk_from_imu: Sequence[float], rate: float = 100.0) -> None:
        """Create an estimator for an IMU mounted at `rotation_trunk_from_imu`, (x, y, z, w), known from a calibration.

        rate: approximate sample rate in Hz, from which the fusion derives how long it settles (3 s) and when it
        estimates the gyroscope's bias. Raises ParameterError.
        """
        self.rotation = rotation_matrix(rotation_trunk_from_imu, "rotation_trunk_from_imu")
        self.settling = "no sample yet"
        x, y, z, w = rotation_trunk_from_imu
        self._imu_from_trunk = (-x, -y, -z, w)
        rate = one_float("rate", rate, 2.0 / MAX_GAP, 10_000.0, "Hz")
        self._fused = _Fused(rate) if imufusion else None
        self._reported = _Reported()
        self._source: _Fused | _Reported | None = None
        self._freeze = FreezeCheck()
        self._time = -math.inf
        self._down: np.ndarray | None = None  # gravity's unit vector in the trunk's axes
        self._contradicted = 0.0  # s

    @property
    def gyroscope_bias(self) -> np.ndarray:
        """The gyroscope bias that the fusion estimates and subtracts, (3,) rad/s in the IMU's axes."""
        return self._fused.bias if self._fused else np.zeros(3)

    def update(self, sample: ImuSample) -> TrunkOrientation | None:
        """Process a sample; return the trunk's orientation, or None while settling.

        Raises ParameterError if the sample is impossible, frozen or not later than the last one (it is then ignored),
        or if the orientation has contradicted the accelerometer for CONTRADICTION_TIME.
        """
        source = self._fused if sample.orientation is None else self._reported
        if source is None:
            raise ParameterError("orientation", None, "reported by the IMU, or install imufusion to fuse it")
        acceleration = source.check(sample)
        dt = self._step(sample.time)
        self._freeze.check(sample.time, sample.angular_velocity, sample.acceleration)
        if source is not self._source or abs(dt) > MAX_GAP:
            self._restart(source, acceleration, f"gap of {dt:.2f} s" if source is self._source else "started")
            dt = 0.0
        quaternion = source.advance(sample, dt)
        down = gravity_from_orientation(quaternion, self.rotation)
        if self._down is not None and _angle(down, self._down) > MAX_RATE * dt + 0.01:
            self._restart(source, acceleration, "orientation jumped")
        self._time, self._down = sample.time, down
        self._compare(down, acceleration, dt)
        if not source.settled:
            return None
        self.settling = ""
        return TrunkOrientation(*pitch_roll(down), _product(quaternion, self._imu_from_trunk))

    def _step(self, time: float) -> float:
        """Return s since the last sample. A stamp far in the past comes from another clock, and counts as a gap."""
        dt = time - self._time
        if not math.isfinite(time) or -MAX_GAP <= dt <= 0.0:
            raise ParameterError("stamp", time, "a finite number, later than the last stamp")
        return dt

    def _restart(self, source: _Fused | _Reported, acceleration: np.ndarray | None, why: str) -> None:
        source.restart(acceleration)
        self.settling, self._source, self._down, self._contradicted = why, source, None, 0.0

    def _compare(self, down: np.ndarray, acceleration: np.ndarray | None, dt: float) -> None:
        """Raise ParameterError once `down` has contradicted an accelerometer that shows 1 g for too long."""
        if acceleration is not None and abs(np.linalg.norm(acceleration) / STANDARD_GRAVITY - 1.0) < NEAR_GRAVITY:
            contradicts = _angle(down, -self.rotation @ acceleration) > MAX_CONTRADICTION
            self._contradicted = self._contradicted + dt if contradicts else 0.0
        if self._contradicted > CONTRADICTION_TIME:
            limit = math.degrees(MAX_CONTRADICTION)
            expected = f"within {limit:g} degrees of the accelerometer at rest: check the IMU's axes, units and signs"
            raise ParameterError("gravity_in_trunk", down.round(2), expected)


class _Fused:
    """Orientation by imufusion, which uses deg/s, g and (w, x, y, z)."""

    # imufusion's defaults: 3 s to settle, and a gain of 0.5, with which an error decays in 2 s. Acceleration rejection
    # is off: on an IMU moved by hand it left up to 3 degrees at the end of a movement, against 0.6 without.

    def __init__(self, rate: float) -> None:
        self._ahrs = imufusion.Ahrs()
        self._ahrs.set_settings(imufusion.AhrsSettings(sample_rate=rate, convention=imufusion.CONVENTION_NWU, gain=0.5))
        self._bias = imufusion.Bias()
        self._bias.set_settings(imufusion.BiasSettings(sample_rate=rate))

    @property
    def bias(self) -> np.ndarray:
        return np.radians(self._bias.get_offset().astype(float))

    @property
    def settled(self) -> bool:
        return not self._ahrs.get_flags().startup

    def check(self, sample: ImuSample) -> np.ndarray:
        rate = _vector("angular_velocity", sample.angular_velocity)
        if np.any(np.abs(rate) > MAX_RATE):
            raise ParameterError("angular_velocity", rate, f"at most {MAX_RATE:g} rad/s about each axis")
        acceleration = _vector("linear_acceleration", sample.acceleration)
        low, high = ACCELERATION_RANGE
        if not low <= np.linalg.norm(acceleration) <= high:
            raise ParameterError("linear_acceleration", acceleration, f"from {low:g} to {high:g} m/s^2 in magnitude")
        return acceleration

    def restart(self, acceleration: np.ndarray | None) -> None:
        if acceleration is None:
            raise ParameterError("linear_acceleration", None, "reported by an IMU without an orientation")
        self._ahrs.restart()
        # Start from the accelerometer's tilt, not from level: an IMU mounted upside down is 180 degrees from level, has
        # no direction to turn in, and would stay there.
        x, y, z = acceleration / np.linalg.norm(acceleration)
        quaternion = np.array((1.0 + z, y, -x, 0.0)) if z > -0.999 else np.array((0.0, 1.0, 0.0, 0.0))
        self._ahrs.set_quaternion(quaternion / np.linalg.norm(quaternion))

    def advance(self, sample: ImuSample, dt: float) -> np.ndarray:
        rate = self._bias.update(np.degrees(sample.angular_velocity))
        self._ahrs.set_sample_period(dt)
        self._ahrs.update_no_magnetometer(rate, np.divide(sample.acceleration, STANDARD_GRAVITY))
        w, x, y, z = self._ahrs.get_quaternion().tolist()
        return np.array((x, y, z, w))


class _Reported:
    """The orientation that the IMU reports."""

    def __init__(self) -> None:
        self._since_restart = 0.0  # s

    @property
    def settled(self) -> bool:
        return self._since_restart >= SETTLE_TIME

    def check(self, sample: ImuSample) -> np.ndarray | None:
        rotation_matrix(sample.orientation, "orientation")
        return None if sample.acceleration is None else _vector("linear_acceleration", sample.acceleration)

    def restart(self, acceleration: np.ndarray | None) -> None:
        self._since_restart = 0.0

    def advance(self, sample: ImuSample, dt: float) -> np.ndarray:
        self._since_restart += dt
        return np.asarray(sample.orientation, dtype=float)


def _vector(name: str, values: Sequence[float] | None) -> np.ndarray:
    vector = np.asarray(values, dtype=float)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise ParameterError(name, values, "3 finite numbers")
    return vector


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a / math.hypot(*a), b / math.hypot(*b)
    return 2.0 * math.atan2(math.hypot(*(a - b)), math.hypot(*(a + b)))  # accurate for small angles, too


def _product(p: Vector, q: Vector) -> np.ndarray:
    """Hamilton product of two quaternions (x, y, z, w), made a unit one."""
    (px, py, pz, pw), (qx, qy, qz, qw) = p, q
    product = np.array(
        (
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
            pw * qw - px * qx - py * qy - pz * qz,
        )
    )
    return product / np.linalg.norm(product)
