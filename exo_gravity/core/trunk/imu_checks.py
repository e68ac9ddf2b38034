"""What no working IMU does over several samples: repeat values, contradict gravity or itself, run by a wrong clock.

While a person moves, the accelerometer also measures the movement. So each check against it waits until a movement
cannot be the reason. The limits were set on the trials of docs/imu.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import eq

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.rotation import ZERO, Floats3, Quaternion, dot, plus, rotated

FROZEN_TIME, FROZEN_SAMPLES = 0.1, 10  # s of equal samples, and at least this many
STUCK_SAMPLES, NO_REPEATS = 5, (0.0,) * 6  # that repeat the value of an axis; of each axis
NEAR_GRAVITY = 0.15  # share of 1 g
TURN = math.radians(3.0)
STUCK_TURN = 0.09  # of gravity's unit vector along an axis

CHECK_PERIOD = 0.0095  # s between two comparisons of gyroscope and accelerometer
QUIET_TIME, QUIET = 0.15, 0.1  # s over which the deviation from 1 g is averaged; share of 1 g
MAX_CONTRADICTION = math.radians(20.0)
CONTRADICTION_TIME = 0.5  # s; less than the time to settle, so that a wrong orientation is never used

TURN_TIME = 1.0  # s over which the two turns are compared
CLEAR_TURN = 0.04  # of a unit vector: 2.3 degrees
CLEAR = 6.0  # times the deviation from 1 g, that a turn must also exceed
UNLIKE, ALIKE = 0.6, 0.3  # share of the gyroscope's turn by which the two differ, with other axes or sign, or without
LEVER, MOST = 0.35 / STANDARD_GRAVITY, 0.3  # s^2: m from the axis of a turn to the IMU, per 1 g; 1 g, at most
PATIENCE = 0.01  # s 1 g: the velocity that a movement may add beyond this; 0.006 in ordinary motion
NOTICE = 0.0006  # s 1 g, by which the two differ fully
FORGET_TIME = 2.0  # s
AGREEMENT_TIME = 0.6  # s of like turns
AT_REST, REST_TIME = 0.03, 3.0  # share of 1 g; s: at rest the estimate is right whatever the gyroscope measures

AVERAGE_TIME, LEAST_TIME = 2.0, 0.5  # s of samples whose mean is gravity; fewer are not judged
OFFSET = 0.04  # share of 1 g: bias and scale of an accelerometer that was never calibrated
WALK = 0.75 / STANDARD_GRAVITY  # s: m/s, per 1 g; 0.45 m/s is needed for an IMU swung in a circle by hand
DIRECTION_TIME = 0.3  # s for which a movement keeps its direction

WINDOW, DRIFTING_WINDOWS = 0.25, 2  # s; in a row
MAX_DRIFT, MAX_OFFSET = 0.03, 0.06  # s a second, in each of these windows; s, in all of them


class Contradiction(ParameterError):
    """The samples contradict each other: the estimate begins anew once gyroscope and accelerometer agree on a turn."""


class EqualValues:
    """Values that an IMU repeats with new stamps: all from a frozen one, one axis from a broken one.

    Gyroscope and accelerometer of a MEMS IMU have noise, so their values differ from sample to sample (measured: no two
    samples in a row were equal in 13,514). A vector of zeros is not judged: some drivers fill in zeros for what the IMU
    does not measure. At rest coarse steps can hide the noise of one axis; so an axis is stuck only if the trunk turned
    meanwhile: if the accelerometer shows another direction of gravity than the estimate.
    """

    duration = 0.0  #: s for which whole samples have been equal
    _since = math.inf  # s, of the first of them
    _values: tuple[float, ...] = (math.nan,) * 6  # gyroscope and accelerometer
    _repeats: tuple[float, ...] = NO_REPEATS  # of each value

    def check(self, time: float, rate: Floats3, acceleration: Floats3 | None, up: Floats3 | None) -> None:
        """Raise ParameterError once the IMU is frozen, Contradiction once an axis is stuck, at the sample of `time` s.

        up: the vertical in the IMU's axes by an estimate from the samples before; None if there is none.
        """
        last, self._values = self._values, rate + (acceleration or ZERO)
        if not any(map(eq, self._values, last)):
            self._since, self.duration, self._repeats = time, 0.0, NO_REPEATS
            return
        pairs = zip(self._repeats, self._values, last, strict=True)
        repeats = self._repeats = tuple([count + 1.0 if value == before else 0.0 for count, value, before in pairs])
        least, most = min(repeats), max(repeats)
        self._since = min(self._since, time) if least else time
        self.duration = time - self._since
        if least + 1 >= FROZEN_SAMPLES and self.duration >= FROZEN_TIME and any(self._values):
            expected = "different from sample to sample, as noise makes them: the IMU or its driver is frozen"
            raise ParameterError("angular_velocity and linear_acceleration", list(self._values), expected)
        axis = repeats.index(most)
        if least or most < STUCK_SAMPLES or not up or not acceleration or not _should_change(axis, up, acceleration):
            return
        name, shown = ("angular_velocity", rate) if axis < 3 else ("linear_acceleration", acceleration)
        expected = f"different from sample to sample while the trunk turns: the {'xyz'[axis % 3]} axis is stuck"
        raise Contradiction(name, shown, expected)


def _should_change(axis: int, up: Floats3, acceleration: Floats3) -> bool:
    """Return whether gravity by the estimate is not what the accelerometer shows: for one of its axes, or at all."""
    x, y, z = (component / STANDARD_GRAVITY for component in acceleration)
    if axis >= 3:
        return abs((x, y, z)[axis - 3] - up[axis - 3]) > STUCK_TURN
    norm = math.hypot(x, y, z)
    return abs(norm - 1.0) < NEAR_GRAVITY and math.dist(up, (x / norm, y / norm, z / norm)) > TURN


class Agreement:
    """The orientation against the accelerometer. Every method raises Contradiction where no movement explains it.

    Turns: gravity must have turned by gyroscope and accelerometer alike over the last second. The more the
    acceleration's length deviates from 1 g, the larger a turn must be to be compared.

    Mean: the mean acceleration in the world must be gravity, because a velocity is bounded. Over a time T a change of
    velocity by v shifts the mean by v / T. For a person who starts to walk v is known; for any other movement it is the
    deviation of the acceleration from its mean times the time for which it keeps its direction.
    """

    contradiction = 0.0  #: rad by which the two turns differ, while they clearly do
    square = 0.0  #: of the acceleration's deviation from its mean, in shares of 1 g
    _deviation = 0.0  # of the acceleration's length from 1 g, mean over QUIET_TIME, as a share
    _means: Sequence[float] = ()  # over TURN_TIME, of gravity's direction by the estimate and of the acceleration's
    _rate = ZERO  # rad/s, at the last comparison
    _unlike = _agreed = _rest = _contradicted = _age = 0.0  # s
    _mean = ZERO  # acceleration in the world, in 1 g
    _since = ZERO, 0.0, 0  # the last comparison: sum of the accelerations, s, samples

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

    def check(self, dt: float, quaternion: Quaternion, up: Floats3, acceleration: Floats3, rate: Floats3) -> None:
        """Compare a fused orientation, and its world z axis `up` in the IMU's axes, with the acceleration.

        This is the mean since the last comparison, CHECK_PERIOD before.
        """
        total, span, count = self._since
        total, dt, count = plus(acceleration, total), dt + span, count + 1
        if dt < CHECK_PERIOD and self._means:
            self._since = total, dt, count
            return
        self._since = ZERO, 0.0, 0
        mean = plus(ZERO, total, 1.0 / (count * STANDARD_GRAVITY))
        spin_up = math.dist(rate, self._rate) / dt if dt else 0.0
        self._rate = rate
        # Before and just after the first tilt nothing is lost by a refusal.
        explained = min(MOST, LEVER * (spin_up + dot(rate, rate))) if self._age > AVERAGE_TIME else 0.0
        self._check_turns(dt, up, mean, explained)
        self._check_mean(dt, rotated(quaternion, mean))

    def _check_turns(self, dt: float, up: Floats3, acceleration: Floats3, explained: float) -> None:
        """Compare the turns. acceleration: in 1 g; explained: the part of it that the rotation may cause."""
        norm = math.hypot(*acceleration)
        self._deviation += (abs(norm - 1.0) - self._deviation) * min(1.0, dt / QUIET_TIME)
        now = [*up, acceleration[0] / norm, acceleration[1] / norm, acceleration[2] / norm]
        means = [mean + dt / TURN_TIME * (v - mean) for mean, v in zip(self._means or now, now, strict=True)]
        turned = [v - mean for mean, v in zip(means, now, strict=True)]
        size, difference = math.hypot(*turned[:3]), math.dist(turned[:3], turned[3:])
        self._means, self.contradiction = means, 0.0
        self._unlike -= self._unlike * dt / FORGET_TIME
        if size <= CLEAR_TURN:
            self._rest = self._rest + dt if self._deviation < AT_REST else 0.0
            self.is_suspect = self.is_suspect and self._rest < REST_TIME
            return
        self._rest = 0.0
        if size <= CLEAR * self._deviation:
            return
        excess = difference - UNLIKE * size - explained
        if difference < ALIKE * size:
            self._agreed += dt
            self._unlike = max(0.0, self._unlike - 2.0 * dt * size)
            self.is_suspect = self.is_suspect and self._agreed < AGREEMENT_TIME
        elif excess > 0.0:
            self._unlike += dt * excess
            self.contradiction = difference * self._unlike / NOTICE
            if self._unlike > PATIENCE:
                expected = "the turn that the accelerometer shows: check the gyroscope's unit, axes and signs"
                raise Contradiction("turn by angular_velocity", [round(v, 3) for v in turned[:3]], expected)

    def _check_mean(self, dt: float, acceleration: Floats3) -> None:
        """Compare the mean acceleration in the world, in 1 g, with gravity."""
        self._age += dt
        span = min(self._age, AVERAGE_TIME)
        share = dt / span if dt else 1.0
        change = plus(acceleration, self._mean, -1.0)
        self._mean = u, v, w = plus(self._mean, change, share)
        self.square += share * ((1.0 - share) * dot(change, change) - self.square)
        shift = math.hypot(u, v, w - 1.0)
        if shift < OFFSET or self._age < LEAST_TIME:
            return
        limit = OFFSET + (WALK + DIRECTION_TIME * math.sqrt(self.square)) / span
        if shift > limit:
            mean = [round(STANDARD_GRAVITY * component, 2) for component in (u, v, w)]
            expected = f"within {STANDARD_GRAVITY * limit:.2f} m/s^2 of gravity upwards: check units, axes and signs"
            raise Contradiction("mean linear_acceleration in the world", mean, expected)


class ClockCheck:
    """The stamps against the arrival of the samples: by a slow or fast clock every turn is too small or too large.

    Timers, batches and busy computers make samples arrive late for a moment, but never before they were taken. So the
    shortest time from stamp to arrival in each WINDOW must not grow, or fall below all before, from window to window.
    """

    offset = 0.0  #: s by which the clock may have gone wrong by the last sample
    _end = math.inf  # s, of the present window
    _shortest = _last = _least = math.inf  # s from stamp to arrival: in this window, the last one, and all before that
    _drift, _windows = 0.0, 0  # s in how many windows in a row

    def check(self, time: float, arrival: float) -> None:
        """Check the stamp `time` of a sample that arrived at `arrival`, both s. Raises Contradiction."""
        lag = arrival - time
        self._shortest = min(self._shortest, lag)
        if self._end == math.inf:
            self._end, self._last = arrival + WINDOW, lag
        if arrival >= self._end:
            self._close(MAX_DRIFT * (WINDOW + arrival - self._end))
            self._end = arrival + WINDOW
        before = self._last - self._drift
        self.offset = abs(lag - before) if lag > before or before <= self._least else 0.0
        if self._windows >= DRIFTING_WINDOWS and abs(self._drift) > MAX_OFFSET:
            drifted = f"{-1e3 * self._drift:+.0f} ms in {WINDOW * self._windows:.1f} s"
            expected = f"by a clock as fast as this computer's, not one that gains {drifted}"
            raise Contradiction("stamp", round(time, 4), expected)

    def _close(self, limit: float) -> None:
        """End the window, in which a drift by more than `limit` s is one."""
        step, self._least = self._shortest - self._last, min(self._least, self._last)
        drifts = step > limit or (step < -limit and self._last <= self._least)
        if not drifts or step * self._drift < 0.0:
            self._drift, self._windows = 0.0, 0
        if drifts:
            self._drift, self._windows = self._drift + step, self._windows + 1
        self._last, self._shortest = self._shortest, math.inf
