"""What no working IMU does: exceed its ranges, repeat values, contradict gravity or itself, run by a wrong clock.

A value at the end of the sensor's range is saturated: only its sign is known. One beyond the range cannot come from
the sensor: a unit or a parameter is wrong. While a person moves, the accelerometer also measures the movement, so each
check against it waits until a movement cannot be the reason. The limits were set on the trials of docs/imu.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from exo_gravity.core.arm.arm import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import ZERO, Floats3, Quaternion, dot, plus, rotated, three_floats, up_in_body
from exo_gravity.core.errors import ParameterError

# The usual widest ranges of a MEMS sensor, and those that any sensor may have.
GYROSCOPE_RANGE, GYROSCOPE_RANGES = 34.9, (1.0, 200.0)  # rad/s; 2000 deg/s
ACCELEROMETER_RANGE, ACCELEROMETER_RANGES = 156.9, (15.0, 4000.0)  # m/s^2; 16 g
RANGES = {"angular_velocity": "gyroscope_range", "linear_acceleration": "accelerometer_range"}
UPWARD = (0.0, 0.0, 1.0)


class ImuSample(NamedTuple):
    """One sample in the IMU's own axes; None marks what it does not report: the orientation, or one of the others."""

    time: float  #: s, when it was taken, not when it arrived
    angular_velocity: Sequence[float] | None  #: (3,) rad/s
    acceleration: Sequence[float] | None  #: (3,) m/s^2, +9.8 upward at rest (REP-145)
    orientation: Sequence[float] | None = None  #: (x, y, z, w), world from IMU, world z up


class Contradiction(ParameterError):
    """The samples contradict each other: the estimate begins anew once gyroscope and accelerometer agree on a turn."""


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
        is_dead, in_si = max(map(abs, acceleration)) < SAMPLE.dead, plus(ZERO, acceleration, STANDARD_GRAVITY)
        if is_dead or (last and math.dist(in_si, last) < SAMPLE.same * STANDARD_GRAVITY):
            raise ParameterError("linear_acceleration", acceleration, "in m/s^2, not in g, and not dead")


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
class ReportedLimits:
    """How far a reported orientation may differ from the accelerometer, near rest."""

    near_rest: float = 0.1  #: share of 1 g by which the acceleration may differ
    largest: float = math.radians(20.0)  #: rad
    time: float = 0.5  #: s; less than the time to the first tilt, so that a wrong orientation is never used


@dataclass(frozen=True)
class TurnLimits:
    """How the turns by gyroscope and accelerometer are compared.

    Lengths are those of the change of gravity's unit vector, accelerations are shares of 1 g.
    """

    time: float = 1.0  #: s over which the two turns are compared
    clear: float = 0.04  #: the smallest turn that is compared: 2.3 degrees,
    clear_of_motion: float = 6.0  #: and this many times the deviation from 1 g,
    deviation_time: float = 0.15  #: s, over which that is averaged
    unlike: float = 0.55  #: share of the gyroscope's turn by which the two differ where axes or signs are wrong,
    alike: float = 0.3  #: and where they are right
    lever: float = 0.42 / STANDARD_GRAVITY  #: s^2: from the axis of a turn to the IMU, 0.42 m, which a swing explains
    most: float = 0.3  #: that a swing explains at most
    velocity: float = 0.009  #: s 1 g, that a movement may add beyond this; at most 0.0082 in 30 of 32 random days
    notice: float = 0.0003  #: s 1 g, from which on the whole difference counts as uncertainty
    memory: float = 2.0  #: s, after which differences are forgotten
    agreement_time: float = 0.6  #: s of like turns after which a suspect estimate is trusted,
    rest_time: float = 3.0  #: or s at rest, where the estimate is right whatever the gyroscope measures
    at_rest: float = 0.03  #: deviation from 1 g


@dataclass(frozen=True)
class MeanLimits:
    """How far the mean acceleration in the world may be from gravity."""

    time: float = 2.0  #: s of samples in the mean
    shortest: float = 0.5  #: s; fewer samples are not judged
    offset: float = 0.04  #: share of 1 g: bias and scale of an accelerometer that was never calibrated
    walk: float = 0.67 / STANDARD_GRAVITY  #: s: 0.67 m/s; an IMU that is swung in a circle by hand needs 0.45
    direction_time: float = 0.3  #: s for which a movement keeps its direction


class Agreement:
    """The orientation against the accelerometer. Every method raises where no movement explains the difference.

    Turns: gravity must have turned by gyroscope and accelerometer alike over the last second. The more the
    acceleration's length deviates from 1 g, the larger a turn must be to be compared.

    Mean: the mean acceleration in the world must be gravity, because a velocity is bounded. Over a time T a change of
    velocity by v shifts the mean by v / T. For a person who starts to walk v is known; for any other movement it is the
    deviation of the acceleration from its mean times the time for which it keeps its direction.
    """

    reported, turn, mean = ReportedLimits(), TurnLimits(), MeanLimits()
    contradiction = 0.0  #: rad by which the two turns differ, while they clearly do
    square = 0.0  #: of the acceleration's deviation from its mean, in shares of 1 g
    _deviation = 0.0  # of the acceleration's length from 1 g, a running mean, as a share
    _up = _apart = ZERO  # running means: gravity's direction by the estimate, and less the accelerometer's
    _unlike = 0.0  # s 1 g, by which the turns have differed
    _agreed = _rest = _contradicted = _age = 0.0  # s
    _mean = ZERO  # acceleration in the world, in 1 g

    def __init__(self, is_suspect: bool = False) -> None:
        #: whether the two must agree on a turn, or the trunk rest, before the estimate is used
        self.is_suspect = is_suspect

    def check_reported(self, dt: float, up: Floats3, acceleration: Floats3) -> None:
        """Check a reported orientation: one that the driver does not have, or upside down.

        up: the world's z axis in the IMU's axes. Raises ParameterError.
        """
        norm = math.hypot(*acceleration)
        if abs(norm / STANDARD_GRAVITY - 1.0) < self.reported.near_rest:
            contradicts = dot(up, acceleration) < norm * math.cos(self.reported.largest)
            self._contradicted = self._contradicted + dt if contradicts else 0.0
        if self._contradicted > self.reported.time:
            limit = math.degrees(self.reported.largest)
            expected = f"within {limit:g} degrees of the accelerometer at rest: check the IMU's axes, units and signs"
            raise ParameterError("gravity_in_imu", [round(-component, 2) for component in up], expected)

    def check(self, dt: float, quaternion: Quaternion, acceleration: Floats3, last: float, swing: float) -> None:
        """Compare a fused orientation, world from IMU, with the mean acceleration, in 1 g, of the `dt` s that it ends.

        last: length of the last acceleration, in 1 g. swing: rad/s^2, the angular acceleration and the square of the
        angular velocity.
        """
        limits = self.turn
        self._age += dt
        self._deviation += (abs(last - 1.0) - self._deviation) * min(1.0, dt / limits.deviation_time)
        self._check_mean(dt, rotated(quaternion, acceleration))
        up, share = up_in_body(quaternion), dt / limits.time
        apart = plus(up, acceleration, -1.0 / math.hypot(*acceleration))
        if self._age == dt:
            self._up, self._apart = up, apart
        turned, unlike = plus(up, self._up, -1.0), plus(apart, self._apart, -1.0)
        self._up, self._apart = plus(self._up, turned, share), plus(self._apart, unlike, share)
        self._unlike -= self._unlike * dt / limits.memory
        self.contradiction = 0.0
        size, difference = math.hypot(*turned), math.hypot(*unlike)
        self._rest = self._rest + dt if size <= limits.clear and self._deviation < limits.at_rest else 0.0
        if size > max(limits.clear, limits.clear_of_motion * self._deviation):
            self._compare(dt, turned, size, difference, swing)
        if self._agreed >= limits.agreement_time or self._rest >= limits.rest_time:
            self.is_suspect = False

    def _compare(self, dt: float, turned: Floats3, size: float, difference: float, swing: float) -> None:
        """Compare a clear turn, `size` of `turned`, with the accelerometer's, which differs by `difference`."""
        limits = self.turn
        # Before and just after the first tilt nothing is lost by a refusal.
        explained = min(limits.most, limits.lever * swing) if self._age > self.mean.time else 0.0
        excess = difference - limits.unlike * size - explained
        if difference < limits.alike * size:
            self._agreed += dt
            self._unlike = max(0.0, self._unlike - 2.0 * dt * size)
        elif excess > 0.0:
            self._unlike += dt * excess
            self.contradiction = difference * self._unlike / limits.notice
            if self._unlike > limits.velocity:
                expected = "the turn that the accelerometer shows: check the gyroscope's unit, axes and signs"
                raise Contradiction("turn by angular_velocity", [round(v, 3) for v in turned], expected)

    def _check_mean(self, dt: float, acceleration: Floats3) -> None:
        """Compare the mean acceleration in the world, in 1 g, with gravity."""
        limits = self.mean
        span = min(self._age, limits.time)
        share, change = dt / span, plus(acceleration, self._mean, -1.0)
        self._mean = plus(self._mean, change, share)
        self.square += share * ((1.0 - share) * dot(change, change) - self.square)
        shift = math.dist(self._mean, UPWARD)
        limit = limits.offset + (limits.walk + limits.direction_time * math.sqrt(self.square)) / span
        if shift > limit and self._age >= limits.shortest:
            mean = [round(STANDARD_GRAVITY * component, 2) for component in self._mean]
            expected = f"within {STANDARD_GRAVITY * limit:.2f} m/s^2 of gravity upwards: check units, axes and signs"
            raise Contradiction("mean linear_acceleration in the world", mean, expected)


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
