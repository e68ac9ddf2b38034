"""The two ways to an IMU's orientation: fused from gyroscope and accelerometer, or reported by the IMU.

Both check a sample first, which changes nothing, and then advance by it.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from exo_gravity.core.quaternion import Floats3, Quaternion, rotated, unit_quaternion, up_in_body
from exo_gravity.core.tilt import angle_between
from exo_gravity.hardware.imu_sample import ImuSample, Ranges, three_floats
from exo_gravity.hardware.orientation_filter import OrientationFilter
from exo_gravity.hardware.tilt_uncertainty import TiltUncertainty

REPORTED_SIGMA = math.radians(1.0)  # rad; data sheets of fused sensors state 1 to 2 degrees
REPORTED_SETTLE_TIME = 1.0  # s of continuous samples before a reported orientation is used
MAX_REPORTED_RATE = 15.0  # rad/s; a reported orientation that turns faster has jumped: no trunk turns so fast
MAX_JUMP = 0.01  # rad by which rounding may turn a reported orientation


class Measured(NamedTuple):
    """A checked sample. rate, acceleration: None if not reported, or if the accelerometer is saturated."""

    rate: Floats3 | None
    acceleration: Floats3 | None
    orientation: Quaternion | None = None
    is_saturated: bool = False  # the gyroscope


class OrientationSource(Protocol):
    """sigma: standard deviation of the tilt, rad. settling: why the orientation cannot be used yet, '' if it can."""

    bias: np.ndarray  # of the gyroscope, (3,) rad/s in the IMU's axes

    @property
    def sigma(self) -> float: ...

    @property
    def settling(self) -> str: ...

    def check(self, sample: ImuSample) -> Measured:
        """Return the checked sample; raises ParameterError if it is impossible."""

    def restart(self, why: str) -> None:
        """Begin anew with the next sample."""

    def advance(self, measured: Measured, dt: float) -> Quaternion:
        """Return the orientation, world from IMU, `dt` s after the last sample; 0 for the first one."""


class Fused:
    """Orientation by VQF."""

    def __init__(self, rate: float, ranges: Ranges) -> None:
        self._filter = OrientationFilter(rate)
        self._ranges = ranges
        self._uncertainty = TiltUncertainty(rate, ranges.gyroscope)
        self._last: Measured | None = None
        self._why = ""

    @property
    def bias(self) -> np.ndarray:
        return self._filter.bias

    @property
    def sigma(self) -> float:
        return self._uncertainty.sigma

    @property
    def settling(self) -> str:
        return "" if self._uncertainty.is_settled else self._why

    def check(self, sample: ImuSample) -> Measured:
        rate, is_saturated = self._ranges.angular_velocity(sample.angular_velocity)
        last = self._last.acceleration if self._last else None
        acceleration, is_clipped = self._ranges.acceleration(sample.acceleration, last)
        return Measured(rate, None if is_clipped else acceleration, None, is_saturated)

    def restart(self, why: str) -> None:
        self._filter.restart()
        self._uncertainty.restart()
        self._last, self._why = None, why

    def advance(self, measured: Measured, dt: float) -> Quaternion:
        rate = measured.rate
        last_rate = self._last.rate if self._last else rate
        self._uncertainty.advance(dt, rate, last_rate, measured.is_saturated)
        if self._uncertainty.is_lost:
            self.restart("too much rotation was not measured")
        quaternion = self._filter.advance(dt, rate, last_rate, measured.acceleration)
        in_world = rotated(quaternion, measured.acceleration) if measured.acceleration else None
        self._uncertainty.combine(self._filter.bias_sigma, in_world)
        self._last = measured
        return quaternion


class Reported:
    """The orientation that the IMU reports."""

    bias = np.zeros(3)
    sigma = REPORTED_SIGMA

    def __init__(self) -> None:
        self._age = 0.0  # s since the restart
        self._up: Floats3 | None = None
        self._why = ""

    @property
    def settling(self) -> str:
        return "" if self._age >= REPORTED_SETTLE_TIME else self._why

    def check(self, sample: ImuSample) -> Measured:
        rate, acceleration = (
            None if values is None else three_floats(name, values)
            for name, values in (
                ("angular_velocity", sample.angular_velocity),
                ("linear_acceleration", sample.acceleration),
            )
        )
        return Measured(rate, acceleration, unit_quaternion("orientation", sample.orientation))

    def restart(self, why: str) -> None:
        self._age, self._up, self._why = 0.0, None, why

    def advance(self, measured: Measured, dt: float) -> Quaternion:
        self._age += dt
        quaternion = measured.orientation
        up = up_in_body(quaternion)
        if self._up is not None and angle_between(up, self._up) > MAX_REPORTED_RATE * dt + MAX_JUMP:
            self.restart("orientation jumped")
        self._up = up
        return quaternion
