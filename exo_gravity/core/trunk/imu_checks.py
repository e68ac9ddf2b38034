"""What no working IMU does: exceed its ranges, repeat values, contradict gravity or itself, run by a wrong clock.

A value at the end of the sensor's range is saturated: only its sign is known. One beyond the range cannot come from
the sensor: a unit or a parameter is wrong. While a person moves, the accelerometer also measures the movement, so each
check against it waits until a movement cannot be the reason. The limits were set on the trials of docs/imu.md.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from exo_gravity.core.arm.arm import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import ZERO, Floats3, Quaternion, dot, plus, rotated, three_floats, up_in_body
from exo_gravity.core.errors import ParameterError

# The usual widest ranges of a MEMS sensor, and those that any sensor may have.
GYROSCOPE_RANGE, GYROSCOPE_RANGES = 34.9, (1.0, 200.0)  # rad/s; 2000 deg/s
ACCELEROMETER_RANGE, ACCELEROMETER_RANGES = 156.9, (15.0, 4000.0)  # m/s^2; 16 g
RANGES = {"angular_velocity": "gyroscope_range", "linear_acceleration": "accelerometer_range"}
SATURATED, BEYOND = 0.995, 1.03  # shares of the range: scale factors of MEMS sensors are wrong by up to 3 %
DEAD, ALMOST_NOTHING = 0.02, 1.5  # m/s^2: even in free fall noise and bias make more
SAME = 0.15  # share of 1 g

FROZEN_TIME, FROZEN_SAMPLES = 0.1, 10  # s of equal samples, and at least this many
STUCK_SAMPLES, NO_REPEATS = 5, (0,) * 6  # that repeat the value of an axis; of each axis
NEAR_GRAVITY = 0.15  # share of 1 g
TURN = math.radians(3.0)
STUCK_TURN = 0.09  # of gravity's unit vector along an axis

QUIET_TIME, QUIET = 0.15, 0.1  # s over which the deviation from 1 g is averaged; share of 1 g
MAX_CONTRADICTION = math.radians(20.0)
CONTRADICTION_TIME = 0.5  # s; less than the time to settle, so that a wrong orientation is never used

TURN_TIME = 1.0  # s over which the two turns are compared
CLEAR_TURN = 0.04  # of a unit vector: 2.3 degrees
CLEAR = 6.0  # times the deviation from 1 g, that a turn must also exceed
UNLIKE, ALIKE = 0.55, 0.3  # share of the gyroscope's turn by which the two differ, with other axes or sign, or without
LEVER, MOST = 0.42 / STANDARD_GRAVITY, 0.3  # s^2: m from the axis of a turn to the IMU, per 1 g; 1 g, at most
PATIENCE = 0.009  # s 1 g: the velocity that a movement may add beyond this; at most 0.0082 in 30 of 32 random days
NOTICE = 0.0003  # s 1 g, by which the two differ fully
FORGET_TIME = 2.0  # s
AGREEMENT_TIME = 0.6  # s of like turns
AT_REST, REST_TIME = 0.03, 3.0  # share of 1 g; s: at rest the estimate is right whatever the gyroscope measures

AVERAGE_TIME, LEAST_TIME = 2.0, 0.5  # s of samples whose mean is gravity; fewer are not judged
OFFSET = 0.04  # share of 1 g: bias and scale of an accelerometer that was never calibrated
WALK = 0.67 / STANDARD_GRAVITY  # s: m/s, per 1 g; 0.45 m/s is needed for an IMU swung in a circle by hand
DIRECTION_TIME = 0.3  # s for which a movement keeps its direction
UPWARD = (0.0, 0.0, 1.0)

WINDOW, DRIFTING_WINDOWS = 0.25, 2  # s; in a row
MAX_DRIFT, MAX_OFFSET = 0.03, 0.06  # s a second, in each of these windows; s, in all of them


class ImuSample(NamedTuple):
    """One sample in the IMU's own axes; None marks what it does not report: the orientation, or one of the others."""

    time: float  #: s, when it was taken, not when it arrived
    angular_velocity: Sequence[float] | None  #: (3,) rad/s
    acceleration: Sequence[float] | None  #: (3,) m/s^2, +9.8 upward at rest (REP-145)
    orientation: Sequence[float] | None = None  #: (x, y, z, w), world from IMU, world z up


class Contradiction(ParameterError):
    """The samples contradict each other: the estimate begins anew once gyroscope and accelerometer agree on a turn."""


def in_range(name: str, values: Sequence[float] | None, limit: float) -> tuple[Floats3, bool]:
    """Return `values` as 3 floats, and whether one is saturated; raise ParameterError if one is beyond `limit`."""
    vector = x, y, z = three_floats(name, values)
    end = SATURATED * limit
    if -end < x < end and -end < y < end and -end < z < end:
        return vector, False
    if max(map(abs, vector)) > BEYOND * limit:
        raise ParameterError(name, vector, f"at most {RANGES[name]} = {limit:.4g} (is its unit right?)")
    return vector, True


def check_living(acceleration: Floats3, last: Floats3 | None) -> None:
    """Raise ParameterError for an accelerometer that is dead, or in g; last: the acceleration before, None at first."""
    if math.dist(acceleration, ZERO) < ALMOST_NOTHING:
        is_dead, in_si = max(map(abs, acceleration)) < DEAD, plus(ZERO, acceleration, STANDARD_GRAVITY)
        if is_dead or (last and math.dist(in_si, last) < SAME * STANDARD_GRAVITY):
            raise ParameterError("linear_acceleration", acceleration, "in m/s^2, not in g, and not dead")


class EqualValues:
    """Values that an IMU repeats with new stamps: all from a frozen one, one axis from a broken one.

    A MEMS IMU has noise: of 13,514 samples no two in a row were equal. Zeros alone are not judged: some drivers fill
    them in for what the IMU does not measure. Coarse steps can hide the noise of one axis at rest; so an axis is stuck
    only if the trunk turned: if the accelerometer shows another direction of gravity than the estimate.
    """

    duration = 0.0  #: s for which whole samples have been equal
    _since = 0.0  # s, of the first of them
    _values: tuple[float, ...] = (math.nan,) * 6  # gyroscope and accelerometer
    _repeats: tuple[int, ...] = NO_REPEATS  # of each value

    def check(self, time: float, values: tuple[float, ...], quaternion: Quaternion | None) -> None:
        """Raise ParameterError once the IMU is frozen, Contradiction once an axis is stuck, at the sample of `time` s.

        quaternion: the estimate at the last sample, world from IMU; None if an axis cannot be judged by it.
        """
        last, self._values = self._values, values
        u, v, w, x, y, z = values
        if u != last[0] and v != last[1] and w != last[2] and x != last[3] and y != last[4] and z != last[5]:
            self._since, self.duration, self._repeats = time, 0.0, NO_REPEATS
            return
        counts = zip(values, last, self._repeats, strict=True)
        repeats = self._repeats = tuple([count + 1 if value == before else 0 for value, before, count in counts])
        if all(repeats):
            self.duration = time - self._since
            if min(repeats) + 1 >= FROZEN_SAMPLES and self.duration >= FROZEN_TIME and any(values):
                expected = "different from sample to sample, as noise makes them: the IMU or its driver is frozen"
                raise ParameterError("angular_velocity and linear_acceleration", list(values), expected)
            return
        self._since, self.duration, axis = time, 0.0, repeats.index(max(repeats))
        if repeats[axis] >= STUCK_SAMPLES and quaternion and _turned(axis, up_in_body(quaternion), (x, y, z)):
            name, shown = ("angular_velocity", values[:3]) if axis < 3 else ("linear_acceleration", values[3:])
            expected = f"different from sample to sample while the trunk turns: the {'xyz'[axis % 3]} axis is stuck"
            raise Contradiction(name, shown, expected)


def _turned(axis: int, up: Floats3, acceleration: Floats3) -> bool:
    """Return whether gravity by the accelerometer differs from the estimate: on its own axis, or in direction."""
    if axis >= 3:
        return abs(acceleration[axis - 3] / STANDARD_GRAVITY - up[axis - 3]) > STUCK_TURN
    norm = math.hypot(*acceleration)
    apart = math.dist(up, plus(ZERO, acceleration, 1.0 / norm))
    return apart > TURN and abs(norm / STANDARD_GRAVITY - 1.0) < NEAR_GRAVITY


class Agreement:
    """The orientation against the accelerometer. Every method raises where no movement explains the difference.

    Turns: gravity must have turned by gyroscope and accelerometer alike over the last second. The more the
    acceleration's length deviates from 1 g, the larger a turn must be to be compared.

    Mean: the mean acceleration in the world must be gravity, because a velocity is bounded. Over a time T a change of
    velocity by v shifts the mean by v / T. For a person who starts to walk v is known; for any other movement it is the
    deviation of the acceleration from its mean times the time for which it keeps its direction.
    """

    contradiction = 0.0  #: rad by which the two turns differ, while they clearly do
    square = 0.0  #: of the acceleration's deviation from its mean, in shares of 1 g
    _deviation = 0.0  # of the acceleration's length from 1 g, mean over QUIET_TIME, as a share
    _up = _apart = ZERO  # means over TURN_TIME: gravity's direction by the estimate, and less the accelerometer's
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
        if abs(norm / STANDARD_GRAVITY - 1.0) < QUIET:
            contradicts = dot(up, acceleration) < norm * math.cos(MAX_CONTRADICTION)
            self._contradicted = self._contradicted + dt if contradicts else 0.0
        if self._contradicted > CONTRADICTION_TIME:
            limit = math.degrees(MAX_CONTRADICTION)
            expected = f"within {limit:g} degrees of the accelerometer at rest: check the IMU's axes, units and signs"
            raise ParameterError("gravity_in_imu", [round(-component, 2) for component in up], expected)

    def check(self, dt: float, quaternion: Quaternion, acceleration: Floats3, last: float, swing: float) -> None:
        """Compare a fused orientation, world from IMU, with the mean acceleration, in 1 g, of the `dt` s that it ends.

        last: length of the last acceleration, in 1 g. swing: rad/s^2, the angular acceleration and the square of the
        angular velocity.
        """
        self._age += dt
        self._deviation += (abs(last - 1.0) - self._deviation) * min(1.0, dt / QUIET_TIME)
        self._check_mean(dt, rotated(quaternion, acceleration))
        up, share = up_in_body(quaternion), dt / TURN_TIME
        apart = plus(up, acceleration, -1.0 / math.hypot(*acceleration))
        if self._age == dt:
            self._up, self._apart = up, apart
        turned, unlike = plus(up, self._up, -1.0), plus(apart, self._apart, -1.0)
        self._up, self._apart = plus(self._up, turned, share), plus(self._apart, unlike, share)
        self._unlike -= self._unlike * dt / FORGET_TIME
        self.contradiction = 0.0
        size, difference = math.hypot(*turned), math.hypot(*unlike)
        self._rest = self._rest + dt if size <= CLEAR_TURN and self._deviation < AT_REST else 0.0
        if size > max(CLEAR_TURN, CLEAR * self._deviation):
            self._compare(dt, turned, size, difference, swing)
        if self._agreed >= AGREEMENT_TIME or self._rest >= REST_TIME:
            self.is_suspect = False

    def _compare(self, dt: float, turned: Floats3, size: float, difference: float, swing: float) -> None:
        """Compare a clear turn, `size` of `turned`, with the accelerometer's, which differs by `difference`."""
        # Before and just after the first tilt nothing is lost by a refusal.
        explained = min(MOST, LEVER * swing) if self._age > AVERAGE_TIME else 0.0
        excess = difference - UNLIKE * size - explained
        if difference < ALIKE * size:
            self._agreed += dt
            self._unlike = max(0.0, self._unlike - 2.0 * dt * size)
        elif excess > 0.0:
            self._unlike += dt * excess
            self.contradiction = difference * self._unlike / NOTICE
            if self._unlike > PATIENCE:
                expected = "the turn that the accelerometer shows: check the gyroscope's unit, axes and signs"
                raise Contradiction("turn by angular_velocity", [round(v, 3) for v in turned], expected)

    def _check_mean(self, dt: float, acceleration: Floats3) -> None:
        """Compare the mean acceleration in the world, in 1 g, with gravity."""
        span = min(self._age, AVERAGE_TIME)
        share, change = dt / span, plus(acceleration, self._mean, -1.0)
        self._mean = plus(self._mean, change, share)
        self.square += share * ((1.0 - share) * dot(change, change) - self.square)
        shift = math.dist(self._mean, UPWARD)
        limit = OFFSET + (WALK + DIRECTION_TIME * math.sqrt(self.square)) / span
        if shift > limit and self._age >= LEAST_TIME:
            mean = [round(STANDARD_GRAVITY * component, 2) for component in self._mean]
            expected = f"within {STANDARD_GRAVITY * limit:.2f} m/s^2 of gravity upwards: check units, axes and signs"
            raise Contradiction("mean linear_acceleration in the world", mean, expected)


class ClockCheck:
    """The stamps against the arrival of the samples: by a slow or fast clock every turn is too small or too large.

    Timers, batches and busy computers make samples arrive late for a moment, but never before they were taken. So the
    shortest time from stamp to arrival in each WINDOW must not grow, or fall below all before, from window to window.
    """

    offset = 0.0  #: s by which the clock may have gone wrong by the last sample
    _end = -math.inf  # s, of the present window
    _shortest = _last = _least = math.inf  # s from stamp to arrival: in this window, the last one, and all before that
    _drift, _windows = 0.0, 0  # s in how many windows in a row

    def check(self, time: float, arrival: float) -> None:
        """Check the stamp `time` of a sample that arrived at `arrival`, both s. Raises Contradiction."""
        lag = arrival - time
        self._shortest = min(self._shortest, lag)
        if arrival >= self._end:
            limit, self._end = MAX_DRIFT * (WINDOW + arrival - self._end), arrival + WINDOW
            step, self._least = self._shortest - self._last, min(self._least, self._last)
            drifts = step > limit or (step < -limit and self._last <= self._least)
            if not drifts or step * self._drift < 0.0:
                self._drift, self._windows = 0.0, 0
            if drifts:
                self._drift, self._windows = self._drift + step, self._windows + 1
            self._last, self._shortest = self._shortest, math.inf
        before = self._last - self._drift
        self.offset = abs(lag - before) if lag > before or before <= self._least else 0.0
        if self._windows >= DRIFTING_WINDOWS and abs(self._drift) > MAX_OFFSET:
            drifted = f"{-1e3 * self._drift:+.0f} ms in {WINDOW * self._windows:.1f} s"
            expected = f"by a clock as fast as this computer's, not one that gains {drifted}"
            raise Contradiction("stamp", round(time, 4), expected)
