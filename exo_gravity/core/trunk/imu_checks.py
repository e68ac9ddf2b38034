# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What an IMU reports, and what no working one does: exceed its ranges, repeat values, run slowly or by a wrong clock.

A value at the end of the sensor's range is saturated: only its sign is known. One beyond the range cannot come from
the sensor: a unit or a parameter is wrong. The limits were set on the trials of docs/imu.md; `agreement` has the checks
against gravity.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import ZERO, Floats3, Quaternion, plus, three_floats, up_in_body
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trunk.inputs import NOT_REPORTED

# The usual widest ranges of a MEMS sensor, and those that any sensor may have.
GYROSCOPE_RANGE, GYROSCOPE_RANGES = 34.9, (1.0, 200.0)  # rad/s; 2000 deg/s
ACCELEROMETER_RANGE, ACCELEROMETER_RANGES = 156.9, (15.0, 4000.0)  # m/s^2; 16 g
RANGES = {"angular_velocity": "gyroscope_range", "linear_acceleration": "accelerometer_range"}


class ImuSample(NamedTuple):
    """One sample in the IMU's own axes; None marks what it does not report: the orientation, or one of the others."""

    time: float  #: s, when it was taken, not when it arrived
    angular_velocity: Sequence[float] | None  #: (3,) rad/s
    acceleration: Sequence[float] | None  #: (3,) m/s^2, +9.8 upward at rest (REP-145)
    orientation: Sequence[float] | None = None  #: (x, y, z, w), world from IMU, world z up


def reported_vector(values: Sequence[float], covariance: float) -> Sequence[float] | None:
    """Return the vector (3,) of a message, None if the IMU does not measure it.

    covariance: its first entry. By REP-145 -1 says so; but many drivers set -1 for values that they measure and whose
    covariance they do not know (0 would say that). So the values decide: what is not measured is 0 or NaN.
    """
    is_there = any(values) and not any(map(math.isnan, values))
    return None if covariance == NOT_REPORTED and not is_there else values


def reported_orientation(values: Sequence[float], covariance: float) -> Sequence[float] | None:
    """Return the quaternion (4,) of a message, None if the IMU has none: by its covariance, or 0 0 0 0 or all NaN."""
    is_there = any(values) and not all(map(math.isnan, values))
    return None if covariance == NOT_REPORTED or not is_there else values


class Contradiction(ParameterError):
    """The samples contradict each other: the estimate begins anew, and is used once they agree on a turn."""


@dataclass(frozen=True)
class SampleLimits:
    """What a single sample may show."""

    saturated: float = 0.995  #: share of the range from which on a value is cut off
    beyond: float = 1.03  #: share of the range that no value exceeds: scale factors are wrong by up to 3 %
    dead: float = 0.02  #: m/s^2, of an accelerometer that measures nothing
    smallest: float = 1.5  #: m/s^2, of one that works: even in free fall noise and bias make more
    same: float = 0.15  #: share of 1 g by which an acceleration in g, converted, may differ from the last one


SAMPLE = SampleLimits()


def in_range(name: str, values: Sequence[float] | None, limit: float) -> tuple[Floats3, bool]:
    """Return `values` as 3 floats, and whether one is saturated; raise ParameterError if one is beyond `limit`."""
    vector = x, y, z = three_floats(name, values)
    end = SAMPLE.saturated * limit
    if -end < x < end and -end < y < end and -end < z < end:
        return vector, False
    if max(map(abs, vector)) > SAMPLE.beyond * limit:
        raise ParameterError(name, vector, f"at most {RANGES[name]} = {limit:.4g} (is its unit right?)")
    return vector, True


def check_unit(acceleration: Floats3, last: Floats3 | None) -> None:
    """Raise ParameterError for an accelerometer that is dead, or in g; last: the acceleration before, None at first."""
    if math.dist(acceleration, ZERO) < SAMPLE.smallest:
        if max(map(abs, acceleration)) < SAMPLE.dead:
            expected = "9.8 m/s^2 upward at rest: the accelerometer is dead, or its driver removes gravity"
            raise ParameterError("linear_acceleration", acceleration, expected)
        converted = plus(ZERO, acceleration, STANDARD_GRAVITY)
        if last and math.dist(last, converted) < SAMPLE.same * STANDARD_GRAVITY < math.dist(last, acceleration):
            raise ParameterError("linear_acceleration", acceleration, "in m/s^2, not in g")


@dataclass(frozen=True)
class RateLimits:
    """How seldom samples may come."""

    least: float = 20.0  #: Hz, what is promised, and the smallest value of the parameter `rate`
    interval: float = 0.06  #: s between two samples that are too slow: some jitter of 20 Hz is permitted
    longest: float = 1.0  #: s; beyond, the driver paused or was started again
    samples: int = 5  #: in a row


class RateCheck:
    """Samples that come too seldom: between two of them a trunk turns unseen."""

    limits = RateLimits()
    _slow = 0  # intervals in a row
    _time = 0.0  # s, their sum

    def check(self, dt: float) -> None:
        """Take the s between two samples; raise ParameterError once they come too seldom."""
        limits = self.limits
        if not limits.interval < dt <= limits.longest:
            self._slow, self._time = 0, 0.0
            return
        self._slow, self._time = self._slow + 1, self._time + dt
        if self._slow >= limits.samples:
            rate = self._slow / self._time
            expected = f"{limits.least:g} or more; they come at {rate:.0f} Hz: set a higher rate in the IMU's driver"
            raise ParameterError("samples a second", round(rate, 1), expected)


@dataclass(frozen=True)
class RepetitionLimits:
    """How often values may repeat."""

    frozen_time: float = 0.1  #: s of equal samples from which on the IMU is frozen,
    frozen_samples: int = 10  #: if they are at least this many
    stuck_samples: int = 5  #: that repeat the value of one axis
    near_gravity: float = 0.15  #: share of 1 g within which the acceleration shows gravity's direction
    turn: float = math.radians(3.0)  #: between gravity by the accelerometer and by the estimate: the trunk has turned
    stuck_turn: float = 0.09  #: the same along a stuck axis of the accelerometer, of a unit vector


class EqualValues:
    """Values that an IMU repeats with new stamps: all from a frozen one, one axis from a broken one.

    A MEMS IMU has noise: of 13,514 samples no two in a row were equal. Zeros alone are not judged: some drivers fill
    them in for what the IMU does not measure. Coarse steps can hide the noise of one axis at rest; so an axis is stuck
    only if the trunk turned: if the accelerometer shows another direction of gravity than the estimate.
    """

    limits = RepetitionLimits()
    duration = 0.0  #: s for which whole samples have been equal
    _since = 0.0  # s, of the first of them
    _values: tuple[float, ...] = (math.nan,) * 6  # gyroscope and accelerometer
    _repeats: tuple[int, ...] = (0,) * 6  # of each value

    def check(self, time: float, values: tuple[float, ...], quaternion: Quaternion | None) -> None:
        """Raise ParameterError once the IMU is frozen, Contradiction once an axis is stuck, at the sample of `time` s.

        quaternion: the estimate at the last sample, world from IMU; None if an axis cannot be judged by it.
        """
        limits, last, self._values = self.limits, self._values, values
        u, v, w, x, y, z = values
        if u != last[0] and v != last[1] and w != last[2] and x != last[3] and y != last[4] and z != last[5]:
            self._since, self.duration, self._repeats = time, 0.0, (0,) * 6
            return
        counts = zip(values, last, self._repeats, strict=True)
        repeats = self._repeats = tuple([count + 1 if value == before else 0 for value, before, count in counts])
        if all(repeats):
            self.duration = time - self._since
            is_long = min(repeats) + 1 >= limits.frozen_samples and self.duration >= limits.frozen_time
            if is_long and any(values):
                expected = "different from sample to sample, as noise makes them: the IMU or its driver is frozen"
                raise ParameterError("angular_velocity and linear_acceleration", list(values), expected)
            return
        self._since, self.duration, axis = time, 0.0, repeats.index(max(repeats))
        if repeats[axis] >= limits.stuck_samples and quaternion and self._has_turned(axis, quaternion, (x, y, z)):
            name, shown = ("angular_velocity", values[:3]) if axis < 3 else ("linear_acceleration", values[3:])
            expected = f"different from sample to sample while the trunk turns: the {'xyz'[axis % 3]} axis is stuck"
            raise Contradiction(name, shown, expected)

    def _has_turned(self, axis: int, quaternion: Quaternion, acceleration: Floats3) -> bool:
        """Return whether gravity by the accelerometer differs from the estimate: on its own axis, or in direction."""
        up = up_in_body(quaternion)
        if axis >= 3:
            return abs(acceleration[axis - 3] / STANDARD_GRAVITY - up[axis - 3]) > self.limits.stuck_turn
        norm = math.hypot(*acceleration)
        apart = math.dist(up, plus(ZERO, acceleration, 1.0 / norm))
        return apart > self.limits.turn and abs(norm / STANDARD_GRAVITY - 1.0) < self.limits.near_gravity


@dataclass(frozen=True)
class ClockLimits:
    """How much a clock may drift."""

    window: float = 0.25  #: s
    windows: int = 2  #: that drift in a row
    drift: float = 0.03  #: s a second, in each of these windows
    offset: float = 0.06  #: s, in all of them


class ClockCheck:
    """The stamps against the arrival of the samples: by a slow or fast clock every turn is too small or too large.

    Timers, batches and busy computers make samples arrive late for a moment, but never before they were taken. So the
    shortest time from stamp to arrival in each window must not grow, or fall below all before, from window to window.
    """

    limits = ClockLimits()
    offset = 0.0  #: s by which the clock may have gone wrong by the last sample
    _end = -math.inf  # s, of the present window
    _shortest = _last = _least = math.inf  # s from stamp to arrival: in this window, the last one, and all before that
    _drift, _windows = 0.0, 0  # s in how many windows in a row

    def check(self, time: float, arrival: float) -> None:
        """Check the stamp `time` of a sample that arrived at `arrival`, both s. Raises Contradiction."""
        limits, lag = self.limits, arrival - time
        self._shortest = min(self._shortest, lag)
        if arrival >= self._end:
            step_limit, self._end = limits.drift * (limits.window + arrival - self._end), arrival + limits.window
            step, self._least = self._shortest - self._last, min(self._least, self._last)
            drifts = step > step_limit or (step < -step_limit and self._last <= self._least)
            if not drifts or step * self._drift < 0.0:
                self._drift, self._windows = 0.0, 0
            if drifts:
                self._drift, self._windows = self._drift + step, self._windows + 1
            self._last, self._shortest = self._shortest, math.inf
        before = self._last - self._drift
        self.offset = abs(lag - before) if lag > before or before <= self._least else 0.0
        if self._windows >= limits.windows and abs(self._drift) > limits.offset:
            drifted = f"{-1e3 * self._drift:+.0f} ms in {limits.window * self._windows:.1f} s"
            expected = f"by a clock as fast as this computer's, not one that gains {drifted}"
            raise Contradiction("stamp", round(time, 4), expected)
