# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What an IMU reports, and what no working one does.

First what single samples and stamps show: values beyond the ranges, that repeat, or that come seldom or by a wrong
clock. A value at the end of the sensor's range is saturated: only its sign is known. One beyond the range cannot come
from the sensor: a unit or a parameter is wrong.

Then whether orientation, gyroscope and accelerometer agree: what shows a wrong unit, axis or sign, and filled-in
values. An accelerometer shows gravity only where its mean is 1 g. While a person moves it also measures the movement,
so each check against it waits until a movement cannot be the reason. The limits were set on the trials of docs/imu.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import ZERO, Floats3, Quaternion, cross, dot, plus, rotated, three_floats, up_in_body
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import clamp
from exo_gravity.core.params import OpenChoices, Param
from exo_gravity.core.trunk.inputs import NOT_REPORTED

# The usual widest ranges of a MEMS sensor, and those that any sensor may have.
GYROSCOPE_RANGE, GYROSCOPE_RANGES = 34.9, (1.0, 200.0)  # rad/s; 2000 deg/s
ACCELEROMETER_RANGE, ACCELEROMETER_RANGES = 156.9, (15.0, 4000.0)  # m/s^2; 16 g


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
        sensor = "gyroscope" if name == "angular_velocity" else "accelerometer"
        raise ParameterError(name, vector, f"at most {sensor}_range = {limit:.4g} (is its unit right?)")
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


class RateCheck:
    """Samples that come too seldom: between two of them a trunk turns unseen."""

    least = 20.0  #: Hz, what is promised, and the smallest value of the parameter `rate`
    interval = 0.06  #: s between two samples that are too slow: some jitter of 20 Hz is permitted
    longest = 1.0  #: s; beyond, the driver paused or was started again
    samples = 5  #: in a row
    _slow = 0  # intervals in a row
    _time = 0.0  # s, their sum

    def check(self, dt: float) -> None:
        """Take the s between two samples; raise ParameterError once they come too seldom."""
        if not self.interval < dt <= self.longest:
            self._slow, self._time = 0, 0.0
            return
        self._slow, self._time = self._slow + 1, self._time + dt
        if self._slow >= self.samples:
            rate = self._slow / self._time
            expected = f"{self.least:g} or more; they come at {rate:.0f} Hz: set a higher rate in the IMU's driver"
            raise ParameterError("samples a second", round(rate, 1), expected)


class EqualValues:
    """Values that an IMU repeats with new stamps: all from a frozen one, one axis from a broken one.

    A MEMS IMU has noise: of 13,514 samples no two in a row were equal. Zeros alone are not judged: some drivers fill
    them in for what the IMU does not measure. Coarse steps can hide the noise of one axis at rest; so an axis is stuck
    only if the trunk turned: if the accelerometer shows another direction of gravity than the estimate.
    """

    frozen_time = 0.1  #: s of equal samples from which on the IMU is frozen,
    frozen_samples = 10  #: if they are at least this many
    stuck_samples = 5  #: that repeat the value of one axis
    near_gravity = 0.15  #: share of 1 g within which the acceleration shows gravity's direction
    turn = math.radians(3.0)  #: between gravity by the accelerometer and by the estimate: the trunk has turned
    stuck_turn = 0.09  #: the same along a stuck axis of the accelerometer, of a unit vector
    duration = 0.0  #: s for which whole samples have been equal
    _since = 0.0  # s, of the first of them
    _values: tuple[float, ...] = (math.nan,) * 6  # gyroscope and accelerometer
    _repeats: tuple[int, ...] = (0,) * 6  # of each value

    def check(self, time: float, values: tuple[float, ...], quaternion: Quaternion | None) -> None:
        """Raise ParameterError once the IMU is frozen, Contradiction once an axis is stuck, at the sample of `time` s.

        quaternion: the estimate at the last sample, world from IMU; None if an axis cannot be judged by it.
        """
        last, self._values = self._values, values
        u, v, w, x, y, z = values
        if u != last[0] and v != last[1] and w != last[2] and x != last[3] and y != last[4] and z != last[5]:
            self._since, self.duration, self._repeats = time, 0.0, (0,) * 6
            return
        counts = zip(values, last, self._repeats, strict=True)
        repeats = self._repeats = tuple([count + 1 if value == before else 0 for value, before, count in counts])
        if all(repeats):
            self.duration = time - self._since
            is_long = min(repeats) + 1 >= self.frozen_samples and self.duration >= self.frozen_time
            if is_long and any(values):
                expected = "different from sample to sample, as noise makes them: the IMU or its driver is frozen"
                raise ParameterError("angular_velocity and linear_acceleration", list(values), expected)
            return
        self._since, self.duration, axis = time, 0.0, repeats.index(max(repeats))
        if repeats[axis] >= self.stuck_samples and quaternion and self._has_turned(axis, quaternion, (x, y, z)):
            name, shown = ("angular_velocity", values[:3]) if axis < 3 else ("linear_acceleration", values[3:])
            expected = f"different from sample to sample while the trunk turns: the {'xyz'[axis % 3]} axis is stuck"
            raise Contradiction(name, shown, expected)

    def _has_turned(self, axis: int, quaternion: Quaternion, acceleration: Floats3) -> bool:
        """Return whether gravity by the accelerometer differs from the estimate: on its own axis, or in direction."""
        up = up_in_body(quaternion)
        if axis >= 3:
            return abs(acceleration[axis - 3] / STANDARD_GRAVITY - up[axis - 3]) > self.stuck_turn
        norm = math.hypot(*acceleration)
        apart = math.dist(up, plus(ZERO, acceleration, 1.0 / norm))
        return apart > self.turn and abs(norm / STANDARD_GRAVITY - 1.0) < self.near_gravity


class ClockCheck:
    """The stamps against the arrival of the samples: by a slow or fast clock every turn is too small or too large.

    Timers, batches and busy computers make samples arrive late for a moment, but never before they were taken. So the
    shortest time from stamp to arrival in each window must not grow, or fall below all before, from window to window.
    """

    window = 0.25  #: s
    windows = 2  #: that drift in a row
    drift = 0.03  #: s a second, in each of these windows
    drifted = 0.06  #: s, in all of them
    offset = 0.0  #: s by which the clock may have gone wrong by the last sample
    _end = -math.inf  # s, of the present window
    _shortest = _last = _least = math.inf  # s from stamp to arrival: in this window, the last one, and all before that
    _drift, _windows = 0.0, 0  # s in how many windows in a row

    def check(self, time: float, arrival: float) -> None:
        """Check the stamp `time` of a sample that arrived at `arrival`, both s. Raises Contradiction."""
        lag = arrival - time
        self._shortest = min(self._shortest, lag)
        if arrival >= self._end:
            step_limit, self._end = self.drift * (self.window + arrival - self._end), arrival + self.window
            step, self._least = self._shortest - self._last, min(self._least, self._last)
            drifts = step > step_limit or (step < -step_limit and self._last <= self._least)
            if not drifts or step * self._drift < 0.0:
                self._drift, self._windows = 0.0, 0
            if drifts:
                self._drift, self._windows = self._drift + step, self._windows + 1
            self._last, self._shortest = self._shortest, math.inf
        before = self._last - self._drift
        self.offset = abs(lag - before) if lag > before or before <= self._least else 0.0
        if self._windows >= self.windows and abs(self._drift) > self.drifted:
            drifted = f"{-1e3 * self._drift:+.0f} ms in {self.window * self._windows:.1f} s"
            expected = f"by a clock as fast as this computer's, not one that gains {drifted}"
            raise Contradiction("stamp", round(time, 4), expected)


class MeanAcceleration:
    """The mean acceleration in the world must be gravity, because a velocity is bounded.

    Over a time T a change of velocity by v shifts the mean by v / T. For a person who starts to walk v is known; for
    any other movement it is the deviation of the acceleration from its mean times the time for which it keeps its
    direction.
    """

    time = 2.0  #: s of samples in the mean
    shortest = 0.5  #: s; fewer samples are not judged; less than the time to the first tilt
    offset = 0.04  #: share of 1 g: bias and scale of an accelerometer that was never calibrated
    walk = 0.67 / STANDARD_GRAVITY  #: s: 0.67 m/s; an IMU that is swung in a circle by hand needs 0.45
    direction_time = 0.3  #: s for which a movement keeps its direction
    removed = 0.5  #: share of 1 g below which gravity is not in the acceleration,
    in_g = 0.15  #: unless it is 1 g divided by 9.8, within this share
    downward = -0.5  #: share of 1 g along the world's z axis from which on the acceleration points down
    age = 0.0  #: s of samples so far
    square = 0.0  #: of the acceleration's deviation from its mean, in shares of 1 g
    _mean = ZERO  # acceleration in the world, in 1 g

    @property
    def has_seen_gravity(self) -> bool:
        """Whether the accelerometer has shown a mean of 1 g."""
        return self.age >= self.shortest

    def check(self, dt: float, acceleration: Floats3) -> None:
        """Take the mean acceleration in the world, in 1 g, of the next `dt` s. Raises Contradiction."""
        self.age += dt
        span = min(self.age, self.time)
        share, change = dt / span, plus(acceleration, self._mean, -1.0)
        self._mean = plus(self._mean, change, share)
        self.square += share * ((1.0 - share) * dot(change, change) - self.square)
        shift = math.dist(self._mean, (0.0, 0.0, 1.0))
        limit = self.offset + (self.walk + self.direction_time * math.sqrt(self.square)) / span
        if shift > limit and self.has_seen_gravity:
            mean = [round(STANDARD_GRAVITY * component, 2) for component in self._mean]
            expected = f"within {STANDARD_GRAVITY * limit:.2f} m/s^2 of gravity upwards: {self._mistake()}"
            raise Contradiction("mean linear_acceleration in the world", mean, expected)

    def _mistake(self) -> str:
        """Return what makes the mean wrong, as far as its length and sign show it."""
        length = math.hypot(*self._mean)
        if abs(length * STANDARD_GRAVITY - 1.0) < self.in_g:
            return "it must be in m/s^2, not in g"
        if length < self.removed:
            return "it must contain gravity, +9.8 upward at rest, which the driver seems to remove"
        if self._mean[2] < self.downward:
            return "it must point upward at rest (REP-145): check axes and signs, also of the orientation"
        return "check units, axes and signs"


class Turns:
    """Gravity must have turned by gyroscope and accelerometer alike over the last second.

    The more the acceleration's length deviates from 1 g, the larger a turn must be to be compared.
    """

    time = 1.0  #: s over which the two turns are compared
    clear = 0.04  #: the smallest turn that is compared: 2.3 degrees,
    clear_of_motion = 6.0  #: and this many times the deviation from 1 g,
    deviation_time = 0.15  #: s, over which that is averaged
    knock = 0.3  #: by which the acceleration changes between two judgements where it is no gravity
    unlike = 0.55  #: share of the gyroscope's turn by which the two differ where axes or signs are wrong,
    alike = 0.3  #: and where they are right
    lever = 0.42 / STANDARD_GRAVITY  #: s^2: from the axis of a turn to the IMU, 0.42 m, which a swing explains
    most = 0.3  #: that a swing explains at most,
    shown = 2.0  #: and at most this many times the change of the acceleration, which a swing shows, too
    steady_time = 0.3  #: s over which the acceleration is averaged, from which its change is taken
    shown_time = 0.5  #: s for which such a change counts
    start_time = 2.0  #: s from the start on in which no swing is taken for an explanation
    velocity = 0.009  #: s 1 g, that a movement may add beyond this; at most 0.0082 in 30 of 32 random days
    notice = 0.0003  #: s 1 g, from which on the whole difference counts as uncertainty
    memory = 2.0  #: s, after which differences are forgotten
    agreement_time = 0.6  #: s of like turns after which a suspect estimate is trusted,
    rest_time = 3.0  #: or s at rest, where the estimate is right whatever the gyroscope measures,
    quiet_time = 5.0  #: or s without a contradiction: in shaken samples no turn may be clear for long
    at_rest = 0.03  #: deviation from 1 g
    contradiction = 0.0  #: rad by which the two turns differ, while they clearly do
    _deviation = 0.0  # of the acceleration's length from 1 g, a running mean, as a share
    _up: Floats3 | None = None  # running mean of gravity's direction by the estimate; None before the first
    _apart = ZERO  # the same less the accelerometer's
    _last = _steady = ZERO  # the acceleration in the IMU's axes before, and its running mean
    _shown = 0.0  # the acceleration's largest change from it of late
    _unlike = 0.0  # s 1 g, by which the turns have differed
    _agreed = _rest = _age = 0.0  # s

    @property
    def is_trusted(self) -> bool:
        """Whether an estimate that was suspect may be used again."""
        return self._agreed >= self.agreement_time or self._rest >= self.rest_time or self._age >= self.quiet_time

    def check(
        self, dt: float, up: Floats3, acceleration: Floats3, last: float, swing: float, unmeasured: float
    ) -> None:
        """Compare the turns at the end of the next `dt` s. Raises Contradiction.

        up: the world's z axis by the estimate. acceleration: the mean of the `dt` s in 1 g. Both in the IMU's axes.
        last: length of the last acceleration, in 1 g.
        swing: rad/s^2, the angular acceleration and the square of the angular velocity.
        unmeasured: rad that the gyroscope may have missed.
        """
        self._age += dt
        self._deviation += (abs(last - 1.0) - self._deviation) * min(1.0, dt / self.deviation_time)
        share = dt / self.time
        apart = plus(up, acceleration, -1.0 / math.hypot(*acceleration))
        if self._up is None:
            self._up, self._apart, self._last, self._steady = up, apart, acceleration, acceleration
        turned, unlike = plus(up, self._up, -1.0), plus(apart, self._apart, -1.0)
        self._up, self._apart = plus(self._up, turned, share), plus(self._apart, unlike, share)
        change = plus(acceleration, self._steady, -1.0)
        self._steady = plus(self._steady, change, min(1.0, dt / self.steady_time))
        self._shown = max(math.hypot(*change), self._shown * (1.0 - dt / self.shown_time))
        self._unlike -= self._unlike * dt / self.memory
        self.contradiction = 0.0
        size, difference = math.hypot(*turned), math.hypot(*unlike)
        self._rest = self._rest + dt if size <= self.clear and self._deviation < self.at_rest else 0.0
        is_knock, self._last = math.dist(acceleration, self._last) > self.knock, acceleration
        if size > max(self.clear, self.clear_of_motion * self._deviation) and not is_knock:
            self._compare(dt, turned, size, difference, swing, unmeasured)

    def _compare(
        self, dt: float, turned: Floats3, size: float, difference: float, swing: float, unmeasured: float
    ) -> None:
        """Compare a clear turn, `size` of `turned`, with the accelerometer's, which differs by `difference`."""
        explained = 0.0  # before and just after the first tilt nothing is lost by a refusal
        if self._age > self.start_time:
            explained = min(self.most, self.lever * swing, self.shown * self._shown)
        excess = difference - self.unlike * size - explained - unmeasured
        if difference < self.alike * size:
            self._agreed += dt
            self._unlike = max(0.0, self._unlike - 2.0 * dt * size)
        elif excess > 0.0:
            self._unlike += dt * excess
            self.contradiction = difference * self._unlike / self.notice
            if self._unlike > self.velocity:
                expected = "the turn that the accelerometer shows: check the gyroscope's unit, axes and signs"
                raise Contradiction("turn by angular_velocity", [round(v, 3) for v in turned], expected)


class ReportedTurns:
    """A reported orientation must turn as the gyroscope does: one that a driver fills in does not.

    Compared are turns about horizontal axes, which move gravity: a magnetometer may correct the heading.
    """

    time = 1.0  #: s, after which a difference is forgotten
    difference = math.radians(2.0)  #: rad; the filter in the sensor also follows the accelerometer
    late = 0.06  #: s of the fastest turn of late: 30 ms of the filter's delay, and 3 % of scale over `time`
    bias_time = 10.0  #: s over which the gyroscope's bias is averaged, which the filter has subtracted
    largest_bias = 0.1  #: rad/s about each axis; 6 deg/s
    turning = 0.15  #: rad/s; an orientation that turns faster is compared, and not constant
    agreement_time = 0.6  #: s of such turns after which a suspect orientation is trusted
    _up: Floats3 | None = None  # the last one
    _apart = ZERO  # rad, a rotation in the IMU's axes: by which the turns have differed of late
    _bias = ZERO  # rad/s, its mean
    _fastest = 0.0  # rad/s, of the orientation of late
    _jolt = 0.0  # rad that the gyroscope may have missed of late
    _age = _agreed = 0.0  # s

    @property
    def is_trusted(self) -> bool:
        """Whether an orientation that was suspect may be used again."""
        return self._agreed >= self.agreement_time

    def check(self, dt: float, up: Floats3, turn: Floats3, jolt: float) -> None:
        """Compare the turns in the next `dt` s, after which the world's z axis is `up`. Raises Contradiction.

        turn: (3,) rad by the gyroscope. jolt: rad that it may have missed. Vectors in the IMU's axes.
        """
        last, self._up = self._up, up
        if last is None:
            return
        # The world's z axis turns the other way in the axes of a body that turns.
        change, middle = plus(up, last, -1.0), plus(ZERO, plus(up, last), 0.5)
        apart = cross(middle, plus(change, cross(turn, middle)))
        self._age += dt
        share = min(1.0, dt / min(self._age, self.bias_time))
        bias = plus(self._bias, plus(plus(ZERO, apart, 1.0 / dt), self._bias, -1.0), share)
        x, y, z = (clamp(component, self.largest_bias) for component in bias)
        self._bias = x, y, z
        kept, speed = 1.0 - min(1.0, dt / self.time), math.hypot(*change) / dt
        self._apart = plus(plus(apart, self._bias, -dt), self._apart, kept)
        self._fastest, self._jolt = max(speed, self._fastest * kept), max(jolt, self._jolt * kept)
        if math.hypot(*self._apart) > self.difference + self.late * self._fastest + self._jolt:
            turned = [round(math.degrees(component), 1) for component in self._apart]
            expected = (
                "near 0: check unit, axes and signs of the gyroscope, and whether the driver fills in an orientation "
                "that it does not have (then its orientation_covariance[0] must be -1)"
            )
            raise Contradiction("turn by angular_velocity less that of orientation, in degrees", turned, expected)
        if speed > self.turning:
            self._agreed += dt


class ConstantOrientation:
    """An orientation that stays exactly the same while gravity turns by the accelerometer is filled in."""

    same = math.radians(0.05)  #: rad, within which it stays; a person sways more, and a filter has noise
    time = 0.5  #: s for which it stays there,
    turn = math.radians(3.0)  #: rad by which gravity has meanwhile turned by the accelerometer,
    near_gravity = 0.05  #: share of 1 g within which it shows gravity
    smooth_time = 0.15  #: s over which it is averaged
    _up: Floats3 | None = None  # since it last changed
    _force = _first = ZERO  # the acceleration now and when it last changed, in 1 g
    _since = 0.0  # s

    def check(self, dt: float, up: Floats3, acceleration: Floats3) -> None:
        """Take the orientation at the end of the next `dt` s; the rest is as for `Agreement`. Raises Contradiction."""
        share = 1.0 if self._up is None else min(1.0, dt / self.smooth_time)
        self._force = plus(self._force, plus(acceleration, self._force, -1.0), share)
        if self._up is None or math.dist(up, self._up) > self.same:
            self._up, self._first, self._since = up, self._force, 0.0
            return
        self._since += dt
        length = math.hypot(*self._force)
        cosine = dot(self._force, self._first) / (length * math.hypot(*self._first))
        has_turned = cosine < math.cos(self.turn) and abs(length - 1.0) < self.near_gravity
        if has_turned and self._since > self.time:
            expected = "different after gravity has turned by linear_acceleration: does the driver fill it in?"
            raise Contradiction("orientation", [round(component, 3) for component in up], expected)


class Agreement:
    """All of these checks on one estimate from its start. Every method raises Contradiction."""

    def __init__(self, is_suspect: bool = False) -> None:
        #: whether the samples must agree on a turn, or the trunk rest, before the estimate is used
        self.is_suspect = is_suspect
        self.mean, self.turns = MeanAcceleration(), Turns()
        self._reported, self._constant = ReportedTurns(), ConstantOrientation()

    def check(
        self, dt: float, quaternion: Quaternion, acceleration: Floats3, last: float, swing: float, unmeasured: float
    ) -> None:
        """Check a fused orientation, world from IMU, at the end of the next `dt` s; the rest is as for `Turns`."""
        self.mean.check(dt, rotated(quaternion, acceleration))
        self.turns.check(dt, up_in_body(quaternion), acceleration, last, swing, unmeasured)
        if self.turns.is_trusted:
            self.is_suspect = False

    def check_reported(
        self, dt: float, quaternion: Quaternion, acceleration: Floats3, turn: Floats3 | None, jolt: float
    ) -> None:
        """Check a reported orientation, world from IMU, at the end of the next `dt` s.

        acceleration: the mean of the `dt` s in 1 g, in the IMU's axes.
        turn: rad by the gyroscope, None if the IMU has none. The rest is as for `ReportedTurns`.
        """
        self.mean.check(dt, rotated(quaternion, acceleration))
        if turn is None:
            self._constant.check(dt, up_in_body(quaternion), acceleration)
            self.is_suspect = self.is_suspect and self.mean.age < self.turns.quiet_time
            return
        self._reported.check(dt, up_in_body(quaternion), turn, jolt)
        if self._reported.is_trusted:
            self.is_suspect = False


# The parameters of `imu`

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
    Param("rate", 100.0, "nominal sample rate", (RateCheck.least, 2000.0), "Hz", fixed=True),
    Param("gyroscope_range", GYROSCOPE_RANGE, "rate at which it saturates",
          GYROSCOPE_RANGES, "rad/s", fixed=True),
    Param("accelerometer_range", ACCELEROMETER_RANGE, "where it saturates",
          ACCELEROMETER_RANGES, "m/s^2", fixed=True),
    Param("timeout", 0.1, "time without IMU data that is an error", (0.02, 1.0), "s", fixed=True),
)
# fmt: on
