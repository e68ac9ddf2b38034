"""The two ways to an IMU's orientation: fused from gyroscope and accelerometer, or reported by the IMU.

Both check a sample first, which changes nothing, and then advance by it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.quaternion import Floats3, Quaternion, rotated, unit_quaternion, up_in_body
from exo_gravity.core.model.tilt import angle_between
from exo_gravity.hardware.trunk.gravity_check import GravityCheck
from exo_gravity.hardware.trunk.imu_consistency import ImuConsistency
from exo_gravity.hardware.trunk.imu_sample import ImuSample, Ranges, three_floats
from exo_gravity.hardware.trunk.mean_acceleration import MEAN, MeanAcceleration
from exo_gravity.hardware.trunk.orientation_filter import OrientationFilter
from exo_gravity.hardware.trunk.stuck_axis import StuckAxis
from exo_gravity.hardware.trunk.tilt_uncertainty import TiltUncertainty

REPORTED_SIGMA = math.radians(1.0)  # rad; data sheets of fused sensors state 1 to 2 degrees
REPORTED_SETTLE_TIME = 1.0  # s of continuous samples before a reported orientation is used
CHECK_PERIOD = 0.0055  # s between two comparisons of gyroscope and accelerometer
LEVEL: Quaternion = (0.0, 0.0, 0.0, 1.0)
MAX_REPORTED_RATE = 15.0  # rad/s; a reported orientation that turns faster has jumped: no trunk turns so fast
MAX_JUMP = 0.01  # rad by which rounding may turn a reported orientation


class Measured(NamedTuple):
    """A checked sample. acceleration: None if not reported or saturated. is_saturated: the gyroscope is."""

    rate: Floats3
    acceleration: Floats3 | None
    orientation: Quaternion = LEVEL
    is_saturated: bool = False


class Fused:
    """Orientation by VQF."""

    def __init__(self, rate: float, ranges: Ranges) -> None:
        self._filter = OrientationFilter(rate)
        self._ranges = ranges
        self._uncertainty = TiltUncertainty(rate, ranges.gyroscope)
        self._consistency = ImuConsistency()
        self._stuck = StuckAxis()
        self._mean = MeanAcceleration()
        self._gravity = GravityCheck()
        self._last: Measured | None = None
        self._repeated = 0.0  # s for which the samples have been equal
        self._contradiction: ParameterError | None = None  # by the last check
        self._unchecked = CHECK_PERIOD  # s since then
        self._why = ""

    @property
    def bias(self) -> Floats3:
        """The gyroscope's bias, rad/s in the IMU's axes."""
        return self._filter.bias

    @property
    def sigma(self) -> float:
        """Standard deviation of the tilt, rad."""
        return self._uncertainty.sigma

    @property
    def settling(self) -> str:
        """Why the orientation cannot be used yet; '' if it can."""
        if self._consistency.is_suspect:
            return f"until gyroscope and accelerometer agree on a turn of the trunk; {self._why}"
        return "" if self._uncertainty.is_settled else self._why

    def check(self, sample: ImuSample) -> Measured:
        """Return the checked sample; raises ParameterError if it is impossible."""
        rate, is_saturated = self._ranges.angular_velocity(sample.angular_velocity)
        last = self._last.acceleration if self._last else None
        acceleration, is_clipped = self._ranges.acceleration(sample.acceleration, last)
        return Measured(rate, None if is_clipped else acceleration, LEVEL, is_saturated)

    def restart(self, why: str) -> None:
        """Begin anew with the next sample."""
        self._filter.restart()
        self._uncertainty.restart()
        self._consistency.restart()
        self._mean.restart()
        self._gravity.restart()
        self._last, self._why, self._repeated = None, why, 0.0
        self._contradiction, self._unchecked = None, CHECK_PERIOD

    def advance(self, measured: Measured, dt: float) -> Quaternion:
        """Return the orientation, world from IMU, `dt` s after the last sample; 0 for the first one.

        Raises ParameterError if the sample contradicts itself or those before it.
        """
        self._count_losses(measured, dt)
        if self._uncertainty.is_lost:
            self.restart("too much rotation was not measured")
        last = self._last or measured
        quaternion = self._filter.advance(dt, measured.rate, last.rate, measured.acceleration)
        self._last = measured
        in_world = rotated(quaternion, measured.acceleration) if measured.acceleration else None
        self._uncertainty.combine(self._filter.bias_sigma, in_world)
        up = up_in_body(quaternion)
        self._gravity.update(dt, up, measured.acceleration)
        if measured.acceleration and in_world:
            self._check(measured, dt, up, in_world)
        return quaternion

    def _count_losses(self, measured: Measured, dt: float) -> None:
        last = self._last or measured
        self._uncertainty.advance(dt, measured.rate, last.rate)
        self._repeated = self._repeated + dt if measured == last else 0.0
        if self._repeated:
            self._uncertainty.repeat(dt, self._repeated)
        elif measured.is_saturated:
            self._uncertainty.saturate(dt)

    def _check(self, measured: Measured, dt: float, up: Floats3, in_world: Floats3) -> None:
        """Raise ParameterError if an axis is stuck, or if gyroscope and accelerometer contradict each other."""
        assert measured.acceleration is not None
        if not measured.is_saturated:
            try:
                self._stuck.update(dt, up, measured.rate, measured.acceleration)
            except ParameterError as error:
                self._uncertainty.distrust(dt, measured.rate)
                if self._stuck.is_sure:
                    self._doubt(error)
                raise
        self._unchecked += dt
        if self._unchecked >= CHECK_PERIOD:
            self._contradiction, dt, self._unchecked = None, self._unchecked, 0.0
            try:
                self._consistency.update(dt, up, measured.acceleration, self._gravity.deviation)
                self._mean.update(dt, in_world)
            except ParameterError as error:
                self._contradiction = error
                if self._consistency.is_broken:
                    self._doubt(error)
                elif error.name == MEAN:
                    self._consistency.suspect()
                    self._why = f"{error.name} must be {error.expected}"
        if self._contradiction:
            raise self._contradiction

    def _doubt(self, error: ParameterError) -> None:
        """Begin anew, and wait for gyroscope and accelerometer to agree."""
        self._consistency.suspect()
        self.restart(f"{error.name} must be {error.expected}")


class Reported:
    """The orientation that the IMU reports."""

    bias = (0.0, 0.0, 0.0)
    sigma = REPORTED_SIGMA

    def __init__(self) -> None:
        self._gravity = GravityCheck()
        self._age = 0.0  # s since the restart
        self._up: Floats3 | None = None
        self._why = ""

    @property
    def settling(self) -> str:
        """Why the orientation cannot be used yet; '' if it can."""
        return "" if self._age >= REPORTED_SETTLE_TIME else self._why

    def check(self, sample: ImuSample) -> Measured:
        """Return the checked sample; raises ParameterError if it is impossible."""
        rate, acceleration = sample.angular_velocity, sample.acceleration
        rate = (0.0, 0.0, 0.0) if rate is None else three_floats("angular_velocity", rate)
        acceleration = None if acceleration is None else three_floats("linear_acceleration", acceleration)
        return Measured(rate, acceleration, unit_quaternion("orientation", sample.orientation))

    def restart(self, why: str) -> None:
        """Begin anew with the next sample."""
        self._age, self._up, self._why = 0.0, None, why
        self._gravity.restart()

    def advance(self, measured: Measured, dt: float) -> Quaternion:
        """Return the orientation, world from IMU, `dt` s after the last sample; 0 for the first one.

        Raises ParameterError if the sample contradicts itself or those before it.
        """
        self._age += dt
        quaternion = measured.orientation
        up = up_in_body(quaternion)
        if self._up is not None and angle_between(up, self._up) > MAX_REPORTED_RATE * dt + MAX_JUMP:
            self.restart("orientation jumped")
        self._up = up
        self._gravity.update(dt, up, measured.acceleration)
        return quaternion
