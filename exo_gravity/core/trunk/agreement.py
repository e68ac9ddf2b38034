# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether orientation, gyroscope and accelerometer agree: what shows a wrong unit, axis or sign, and filled-in values.

An accelerometer shows gravity only where its mean is 1 g. While a person moves it also measures the movement, so each
check against it waits until a movement cannot be the reason. The limits were set on the trials of docs/imu.md.
"""

import math
from dataclasses import dataclass

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import ZERO, Floats3, Quaternion, cross, dot, plus, rotated, up_in_body
from exo_gravity.core.trunk.imu_checks import Contradiction

UPWARD = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class MeanLimits:
    """How far the mean acceleration in the world may be from gravity."""

    time: float = 2.0  #: s of samples in the mean
    shortest: float = 0.5  #: s; fewer samples are not judged; less than the time to the first tilt
    offset: float = 0.04  #: share of 1 g: bias and scale of an accelerometer that was never calibrated
    walk: float = 0.67 / STANDARD_GRAVITY  #: s: 0.67 m/s; an IMU that is swung in a circle by hand needs 0.45
    direction_time: float = 0.3  #: s for which a movement keeps its direction
    removed: float = 0.5  #: share of 1 g below which gravity is not in the acceleration,
    in_g: float = 0.15  #: unless it is 1 g divided by 9.8, within this share
    downward: float = -0.5  #: share of 1 g along the world's z axis from which on the acceleration points down


class MeanAcceleration:
    """The mean acceleration in the world must be gravity, because a velocity is bounded.

    Over a time T a change of velocity by v shifts the mean by v / T. For a person who starts to walk v is known; for
    any other movement it is the deviation of the acceleration from its mean times the time for which it keeps its
    direction.
    """

    limits = MeanLimits()
    age = 0.0  #: s of samples so far
    square = 0.0  #: of the acceleration's deviation from its mean, in shares of 1 g
    _mean = ZERO  # acceleration in the world, in 1 g

    def check(self, dt: float, acceleration: Floats3) -> None:
        """Take the mean acceleration in the world, in 1 g, of the next `dt` s. Raises Contradiction."""
        limits = self.limits
        self.age += dt
        span = min(self.age, limits.time)
        share, change = dt / span, plus(acceleration, self._mean, -1.0)
        self._mean = plus(self._mean, change, share)
        self.square += share * ((1.0 - share) * dot(change, change) - self.square)
        shift = math.dist(self._mean, UPWARD)
        limit = limits.offset + (limits.walk + limits.direction_time * math.sqrt(self.square)) / span
        if shift > limit and self.age >= limits.shortest:
            mean = [round(STANDARD_GRAVITY * component, 2) for component in self._mean]
            expected = f"within {STANDARD_GRAVITY * limit:.2f} m/s^2 of gravity upwards: {self._mistake()}"
            raise Contradiction("mean linear_acceleration in the world", mean, expected)

    def _mistake(self) -> str:
        """Return what makes the mean wrong, as far as its length and sign show it."""
        length = math.hypot(*self._mean)
        if abs(length * STANDARD_GRAVITY - 1.0) < self.limits.in_g:
            return "it must be in m/s^2, not in g"
        if length < self.limits.removed:
            return "it must contain gravity, +9.8 upward at rest, which the driver seems to remove"
        if self._mean[2] < self.limits.downward:
            return "it must point upward at rest (REP-145): check axes and signs, also of the orientation"
        return "check units, axes and signs"


@dataclass(frozen=True)
class TurnLimits:
    """How the turns by gyroscope and accelerometer are compared.

    Lengths are those of the change of gravity's unit vector, accelerations are shares of 1 g.
    """

    time: float = 1.0  #: s over which the two turns are compared
    clear: float = 0.04  #: the smallest turn that is compared: 2.3 degrees,
    clear_of_motion: float = 6.0  #: and this many times the deviation from 1 g,
    deviation_time: float = 0.15  #: s, over which that is averaged
    knock: float = 0.3  #: by which the acceleration changes between two judgements where it is no gravity
    unlike: float = 0.55  #: share of the gyroscope's turn by which the two differ where axes or signs are wrong,
    alike: float = 0.3  #: and where they are right
    lever: float = 0.42 / STANDARD_GRAVITY  #: s^2: from the axis of a turn to the IMU, 0.42 m, which a swing explains
    most: float = 0.3  #: that a swing explains at most,
    shown: float = 2.0  #: and at most this many times the change of the acceleration, which a swing shows, too
    steady_time: float = 0.3  #: s over which the acceleration is averaged, from which its change is taken
    shown_time: float = 0.5  #: s for which such a change counts
    start_time: float = 2.0  #: s from the start on in which no swing is taken for an explanation
    velocity: float = 0.009  #: s 1 g, that a movement may add beyond this; at most 0.0082 in 30 of 32 random days
    notice: float = 0.0003  #: s 1 g, from which on the whole difference counts as uncertainty
    memory: float = 2.0  #: s, after which differences are forgotten
    agreement_time: float = 0.6  #: s of like turns after which a suspect estimate is trusted,
    rest_time: float = 3.0  #: or s at rest, where the estimate is right whatever the gyroscope measures,
    quiet_time: float = 5.0  #: or s without a contradiction: in shaken samples no turn may be clear for long
    at_rest: float = 0.03  #: deviation from 1 g


class Turns:
    """Gravity must have turned by gyroscope and accelerometer alike over the last second.

    The more the acceleration's length deviates from 1 g, the larger a turn must be to be compared.
    """

    limits = TurnLimits()
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
        limits = self.limits
        return self._agreed >= limits.agreement_time or self._rest >= limits.rest_time or self._age >= limits.quiet_time

    def check(
        self, dt: float, up: Floats3, acceleration: Floats3, last: float, swing: float, unmeasured: float
    ) -> None:
        """Compare the turns at the end of the next `dt` s. Raises Contradiction.

        up: the world's z axis by the estimate. acceleration: the mean of the `dt` s in 1 g. Both in the IMU's axes.
        last: length of the last acceleration, in 1 g.
        swing: rad/s^2, the angular acceleration and the square of the angular velocity.
        unmeasured: rad that the gyroscope may have missed.
        """
        limits = self.limits
        self._age += dt
        self._deviation += (abs(last - 1.0) - self._deviation) * min(1.0, dt / limits.deviation_time)
        share = dt / limits.time
        apart = plus(up, acceleration, -1.0 / math.hypot(*acceleration))
        if self._up is None:
            self._up, self._apart, self._last, self._steady = up, apart, acceleration, acceleration
        turned, unlike = plus(up, self._up, -1.0), plus(apart, self._apart, -1.0)
        self._up, self._apart = plus(self._up, turned, share), plus(self._apart, unlike, share)
        change = plus(acceleration, self._steady, -1.0)
        self._steady = plus(self._steady, change, min(1.0, dt / limits.steady_time))
        self._shown = max(math.hypot(*change), self._shown * (1.0 - dt / limits.shown_time))
        self._unlike -= self._unlike * dt / limits.memory
        self.contradiction = 0.0
        size, difference = math.hypot(*turned), math.hypot(*unlike)
        self._rest = self._rest + dt if size <= limits.clear and self._deviation < limits.at_rest else 0.0
        is_knock, self._last = math.dist(acceleration, self._last) > limits.knock, acceleration
        if size > max(limits.clear, limits.clear_of_motion * self._deviation) and not is_knock:
            self._compare(dt, turned, size, difference, swing, unmeasured)

    def _compare(
        self, dt: float, turned: Floats3, size: float, difference: float, swing: float, unmeasured: float
    ) -> None:
        """Compare a clear turn, `size` of `turned`, with the accelerometer's, which differs by `difference`."""
        limits = self.limits
        explained = 0.0  # before and just after the first tilt nothing is lost by a refusal
        if self._age > limits.start_time:
            explained = min(limits.most, limits.lever * swing, limits.shown * self._shown)
        excess = difference - limits.unlike * size - explained - unmeasured
        if difference < limits.alike * size:
            self._agreed += dt
            self._unlike = max(0.0, self._unlike - 2.0 * dt * size)
        elif excess > 0.0:
            self._unlike += dt * excess
            self.contradiction = difference * self._unlike / limits.notice
            if self._unlike > limits.velocity:
                expected = "the turn that the accelerometer shows: check the gyroscope's unit, axes and signs"
                raise Contradiction("turn by angular_velocity", [round(v, 3) for v in turned], expected)


@dataclass(frozen=True)
class ReportedLimits:
    """How far the turns of a reported orientation may differ from the gyroscope's."""

    time: float = 1.0  #: s, after which a difference is forgotten
    difference: float = math.radians(2.0)  #: rad; the filter in the sensor also follows the accelerometer
    late: float = 0.06  #: s of the fastest turn of late: 30 ms of the filter's delay, and 3 % of scale over `time`
    bias_time: float = 10.0  #: s over which the gyroscope's bias is averaged, which the filter has subtracted
    largest_bias: float = 0.1  #: rad/s about each axis; 6 deg/s
    turning: float = 0.15  #: rad/s; an orientation that turns faster is compared, and not constant
    agreement_time: float = 0.6  #: s of such turns after which a suspect orientation is trusted


class ReportedTurns:
    """A reported orientation must turn as the gyroscope does: one that a driver fills in does not.

    Compared are turns about horizontal axes, which move gravity: a magnetometer may correct the heading.
    """

    limits = ReportedLimits()
    _up: Floats3 | None = None  # the last one
    _apart = ZERO  # rad, a rotation in the IMU's axes: by which the turns have differed of late
    _bias = ZERO  # rad/s, its mean
    _fastest = 0.0  # rad/s, of the orientation of late
    _jolt = 0.0  # rad that the gyroscope may have missed of late
    _age = _agreed = 0.0  # s

    @property
    def is_trusted(self) -> bool:
        """Whether an orientation that was suspect may be used again."""
        return self._agreed >= self.limits.agreement_time

    def check(self, dt: float, up: Floats3, turn: Floats3, jolt: float) -> None:
        """Compare the turns in the next `dt` s, after which the world's z axis is `up`. Raises Contradiction.

        turn: (3,) rad by the gyroscope. jolt: rad that it may have missed. Vectors in the IMU's axes.
        """
        limits, last, self._up = self.limits, self._up, up
        if last is None:
            return
        # The world's z axis turns the other way in the axes of a body that turns.
        change, middle = plus(up, last, -1.0), plus(ZERO, plus(up, last), 0.5)
        apart = cross(middle, plus(change, cross(turn, middle)))
        self._age += dt
        share, most = min(1.0, dt / min(self._age, limits.bias_time)), limits.largest_bias
        x, y, z = plus(self._bias, plus(plus(ZERO, apart, 1.0 / dt), self._bias, -1.0), share)
        self._bias = max(-most, min(most, x)), max(-most, min(most, y)), max(-most, min(most, z))
        kept, speed = 1.0 - min(1.0, dt / limits.time), math.hypot(*change) / dt
        self._apart = plus(plus(apart, self._bias, -dt), self._apart, kept)
        self._fastest, self._jolt = max(speed, self._fastest * kept), max(jolt, self._jolt * kept)
        if math.hypot(*self._apart) > limits.difference + limits.late * self._fastest + self._jolt:
            turned = [round(math.degrees(component), 1) for component in self._apart]
            expected = (
                "near 0: check unit, axes and signs of the gyroscope, and whether the driver fills in an orientation "
                "that it does not have (then its orientation_covariance[0] must be -1)"
            )
            raise Contradiction("turn by angular_velocity less that of orientation, in degrees", turned, expected)
        if speed > limits.turning:
            self._agreed += dt


@dataclass(frozen=True)
class ConstantLimits:
    """When an orientation without a gyroscope beside it is taken for one that is filled in."""

    same: float = math.radians(0.05)  #: rad, within which it stays; a person sways more, and a filter has noise
    time: float = 0.5  #: s for which it stays there,
    turn: float = math.radians(3.0)  #: rad by which gravity has meanwhile turned by the accelerometer,
    near_gravity: float = 0.05  #: share of 1 g within which it shows gravity
    smooth_time: float = 0.15  #: s over which it is averaged


class ConstantOrientation:
    """An orientation that stays exactly the same while gravity turns by the accelerometer is filled in."""

    limits = ConstantLimits()
    _up: Floats3 | None = None  # since it last changed
    _force = _first = ZERO  # the acceleration now and when it last changed, in 1 g
    _since = 0.0  # s

    def check(self, dt: float, up: Floats3, acceleration: Floats3) -> None:
        """Take the orientation at the end of the next `dt` s; the rest is as for `Agreement`. Raises Contradiction."""
        limits = self.limits
        share = 1.0 if self._up is None else min(1.0, dt / limits.smooth_time)
        self._force = plus(self._force, plus(acceleration, self._force, -1.0), share)
        if self._up is None or math.dist(up, self._up) > limits.same:
            self._up, self._first, self._since = up, self._force, 0.0
            return
        self._since += dt
        length = math.hypot(*self._force)
        cosine = dot(self._force, self._first) / (length * math.hypot(*self._first))
        has_turned = cosine < math.cos(limits.turn) and abs(length - 1.0) < limits.near_gravity
        if has_turned and self._since > limits.time:
            expected = "different after gravity has turned by linear_acceleration: does the driver fill it in?"
            raise Contradiction("orientation", [round(component, 3) for component in up], expected)


class Agreement:
    """All of these checks on one estimate from its start. Every method raises Contradiction."""

    def __init__(self, is_suspect: bool = False) -> None:
        #: whether the samples must agree on a turn, or the trunk rest, before the estimate is used
        self.is_suspect = is_suspect
        self._mean, self._turns = MeanAcceleration(), Turns()
        self._reported, self._constant = ReportedTurns(), ConstantOrientation()

    @property
    def has_seen_gravity(self) -> bool:
        """Whether the accelerometer has shown a mean of 1 g."""
        return self._mean.age >= self._mean.limits.shortest

    @property
    def square(self) -> float:
        """Mean square of the deviation of the acceleration from its mean, in shares of 1 g."""
        return self._mean.square

    @property
    def contradiction(self) -> float:
        """By how many rad gyroscope and accelerometer differ, while they clearly do."""
        return self._turns.contradiction

    def check(
        self, dt: float, quaternion: Quaternion, acceleration: Floats3, last: float, swing: float, unmeasured: float
    ) -> None:
        """Check a fused orientation, world from IMU, at the end of the next `dt` s; the rest is as for `Turns`."""
        self._mean.check(dt, rotated(quaternion, acceleration))
        self._turns.check(dt, up_in_body(quaternion), acceleration, last, swing, unmeasured)
        if self._turns.is_trusted:
            self.is_suspect = False

    def check_reported(
        self, dt: float, quaternion: Quaternion, acceleration: Floats3, turn: Floats3 | None, jolt: float
    ) -> None:
        """Check a reported orientation, world from IMU, at the end of the next `dt` s.

        acceleration: the mean of the `dt` s in 1 g, in the IMU's axes.
        turn: rad by the gyroscope, None if the IMU has none. The rest is as for `ReportedTurns`.
        """
        self._mean.check(dt, rotated(quaternion, acceleration))
        if turn is None:
            self._constant.check(dt, up_in_body(quaternion), acceleration)
            self.is_suspect = self.is_suspect and self._mean.age < self._turns.limits.quiet_time
            return
        self._reported.check(dt, up_in_body(quaternion), turn, jolt)
        if self._reported.is_trusted:
            self.is_suspect = False
