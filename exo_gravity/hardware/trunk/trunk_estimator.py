"""Samples of an inertial measurement unit (IMU) on the trunk -> gravity in the trunk's axes, and how sure that is.

An orientation that the IMU reports is used as it is. Without one, VQF fuses gyroscope and accelerometer
(`orientation_filter`). Without a magnetometer the heading drifts, on which gravity does not depend.

A sample that no working IMU gives is refused with the reason, and the estimate goes on over it. What was not measured,
in a gap or in saturation, makes the estimate less certain (`tilt_uncertainty`). While it may be off by more than 3
degrees, and while it contradicts the accelerometer, there is no output: the output never jumps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.quaternion import product, up_in_body
from exo_gravity.core.model.tilt import pitch_roll, rotation_matrix
from exo_gravity.core.numbers import one_float
from exo_gravity.hardware.trunk.freeze_check import FreezeCheck
from exo_gravity.hardware.trunk.imu_sample import ACCELEROMETER_RANGE, GYROSCOPE_RANGE, ImuSample, Ranges
from exo_gravity.hardware.trunk.orientation_filter import VQF
from exo_gravity.hardware.trunk.orientation_sources import Fused, Reported
from exo_gravity.hardware.trunk.stamp_check import StampCheck

__all__ = ["ImuSample", "TrunkEstimator", "TrunkOrientation"]

MAX_GAP = 0.1  # s between two samples, after which the estimate begins anew


class TrunkOrientation(NamedTuple):
    """pitch, roll: rad (REP-103: pitch > 0 bows forward, roll > 0 leans right).

    orientation: (x, y, z, w), world from trunk; its heading is arbitrary. gravity: its unit vector (3,) in the trunk's
    axes (x forward, y left, z up). uncertainty: one standard deviation of the tilt, rad.
    """

    pitch: float
    roll: float
    orientation: np.ndarray
    gravity: np.ndarray
    uncertainty: float


class TrunkEstimator:
    """Follows one IMU.

    rotation: (3, 3), trunk from IMU. settling: why there is no orientation yet; empty once there is.
    """

    def __init__(
        self,
        rotation_trunk_from_imu: Sequence[float],
        rate: float = 100.0,
        gyroscope_range: float = GYROSCOPE_RANGE,
        accelerometer_range: float = ACCELEROMETER_RANGE,
    ) -> None:
        """Create an estimator for an IMU mounted at `rotation_trunk_from_imu`, (x, y, z, w), known from a calibration.

        rate: approximate sample rate in Hz. gyroscope_range rad/s, accelerometer_range m/s^2: of the sensor, at which
        it saturates. Raises ParameterError.
        """
        self.rotation = rotation_matrix(rotation_trunk_from_imu, "rotation_trunk_from_imu")
        self._rows = self.rotation.tolist()
        self.settling = "no sample yet"
        x, y, z, w = map(float, rotation_trunk_from_imu)
        self._imu_from_trunk = (-x, -y, -z, w)
        rate = one_float("rate", rate, 2.0 / MAX_GAP, 10_000.0, "Hz")
        ranges = Ranges.of(gyroscope_range, accelerometer_range)
        self._fused = Fused(rate, ranges) if VQF else None
        self._reported = Reported()
        self._source: Fused | Reported | None = None
        self._freeze = FreezeCheck()
        self._stamps = StampCheck(rate)
        self._time = -math.inf

    @property
    def gyroscope_bias(self) -> np.ndarray:
        """The gyroscope bias that the fusion estimates and subtracts, (3,) rad/s in the IMU's axes."""
        return np.array(self._fused.bias if self._fused else (0.0, 0.0, 0.0))

    def update(self, sample: ImuSample) -> TrunkOrientation | None:
        """Process a sample; return the trunk's orientation, or None while it is not sure enough.

        Raises ParameterError if the sample is impossible, frozen or not later than the last one (it is then ignored),
        or if what it measures contradicts itself or the samples before it.
        """
        source: Fused | Reported | None = self._fused if sample.orientation is None else self._reported
        if source is None:
            raise ParameterError("orientation", None, "reported by the IMU, or install vqf to fuse it")
        measured = source.check(sample)
        time = float(sample.time)
        dt = self._step(time)
        self._freeze.check(time, measured.rate, measured.acceleration)
        if source is not self._source or abs(dt) > MAX_GAP:
            source.restart(f"gap of {dt:.2f} s" if source is self._source else "started")
            self._source, dt = source, 0.0
            self._stamps.restart()
        self._time = time
        self._stamps.check(time, dt)
        quaternion = source.advance(measured, dt)
        self.settling = source.settling
        up = up_in_body(quaternion)
        if self.settling:
            return None
        x, y, z = up
        gravity = [-a * x - b * y - c * z for a, b, c in self._rows]
        orientation = np.array(product(quaternion, self._imu_from_trunk))
        return TrunkOrientation(*pitch_roll(gravity), orientation, np.array(gravity), source.sigma)

    def _step(self, time: float) -> float:
        """Return s since the last sample. A stamp far in the past comes from another clock, and counts as a gap."""
        dt = time - self._time
        if not math.isfinite(time) or -MAX_GAP <= dt <= 0.0:
            raise ParameterError("stamp", time, "a finite number, later than the last stamp")
        return dt
