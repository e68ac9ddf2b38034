# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What messages bring of the trunk, extrapolated to the moment at which it acts: its tilt, and the motion an arm feels.

A tilt becomes gravity's direction, an angular velocity and an age. Gravity's vector (`/imu/data`) goes before pitch and
roll (`/imu/pitch_yaw`), which are used only while no vector arrives: it comes with the angular velocity that
extrapolates it.

An accelerometer measures specific force, acceleration less gravity: for the arm, its opposite is gravity. The motors'
torque takes effect 10 to 20 ms after the sample that it answers. Walking shakes a trunk at 2 and 4 Hz, so that a torque
15 ms late leaves 19 and 37 % of the disturbance. A parabola through the last 40 ms of samples, extrapolated to the
moment of the effect, leaves 1 and 7 %; from 10 Hz on, extrapolating is worse than ignoring the acceleration.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import ZERO, Floats3, acceleration_of, plus, three_floats
from exo_gravity.core.arm.tilt import Tilt, angle_between, gravity_in_trunk
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Vector
from exo_gravity.core.vocabulary import NO_REASON, Status, Withdrawal

NOT_REPORTED = -1.0  # first entry of the covariance of what an IMU does not measure (REP-145)


@dataclass(frozen=True)
class TiltLimits:
    """What a message of the tilt may say, and how long it is used."""

    #: rad from upright: a person bows by 110 degrees at most. A quaternion in the order w, x, y, z, an accelerometer
    #: whose sign is reversed, and a z axis that points down show a person who stands as upside down
    upside_down: float = math.radians(120.0)

    speed: float = 5.0  #: rad/s, faster than a trunk can tilt
    #: rad, by which a tilt may deviate from a reference direction that follows the tilts no faster than `speed`. Noise
    #: stays within it; neither a jump nor many small ones in a row do
    jump: float = 0.1
    #: rad/s; the torque follows a faster turn as a guided motion: a fall, or an IMU that comes loose. A bow of 30
    #: degrees in a second is slower. With 0.05 an IMU that slips by 30 degrees at 0.2 to 0.74 rad/s drives an arm at
    #: 0.4 rad/s, not at 2.6; but then the arm of a wearer who leans by 20 degrees in 1 s and reaches sinks by 28
    #: degrees once they relax, driven at up to 1.2 rad/s, where it stays at rest
    followed: float = 0.75
    ahead: float = 0.05  #: rad, once the tilt is so far ahead of one that turns no faster
    #: s by which a stamp may be ahead of our clock: /clock comes in steps, hosts differ by ms. A clock that goes fast
    #: gets further ahead, which shows only that: no sample arrives before it was taken. So a lead is added to all ages,
    lead: float = 0.05
    lead_decay: float = 0.002  #: and is forgotten by this many s a second, faster than a clock gains
    lag: float = 1.0  #: s by which a stamp may be behind; beyond, it comes from another clock
    #: rad by which the trunk may have turned otherwise since a tilt that is late for a moment and is turned on: the
    #: torque is then off by 10 % of gravity's largest
    turn: float = 0.1
    #: rad/s by which the last angular velocity may be wrong: a quick bow, of 90 degrees in 1.5 s, accelerates by
    #: 4 rad/s^2, which is 0.4 rad/s on average over `hold`
    turn_rate: float = 0.5
    turn_rate_alone: float = 1.0  #: rad/s, without an angular velocity, which a sender of pitch and roll does not give

    @property
    def hold(self) -> float:
        """For how long a late tilt with an angular velocity is turned on, s."""
        return self.turn / self.turn_rate


TILT = TiltLimits()


def check_trunk(tilt: Tilt) -> None:
    """Raise ParameterError for a trunk that is upside down: the IMU is not as its parameters or its driver say."""
    if tilt.axis_angle > TILT.upside_down:
        within = f"within {math.degrees(TILT.upside_down):.0f} degrees of upright, not upside down"
        causes = "is each quaternion in the order x, y, z, w; is the acceleration +9.8 upward at rest; is z up?"
        raise ParameterError("trunk tilt", [round(tilt.pitch, 2), round(tilt.roll, 2)], f"{within}: {causes}")


class TiltInput:
    """The newest tilt of the trunk, for one arm. timeout: s after which a tilt is too old; may be changed."""

    def __init__(self, side: str, timeout: float) -> None:
        self.timeout = timeout
        self._side = side
        self._tilt = Tilt.of(side)
        self._angular_velocity = ZERO
        self._time = -math.inf  # s, when it was measured
        self._in_time = -math.inf  # s, when the newest one that came in time was measured
        self._arrival = -math.inf
        self._lead = 0.0  # s, of the stamps
        self._reference = self._tilt.direction  # (3,), follows the tilts no faster than a trunk tilts
        self._behind = self._reference  # (3,), follows them no faster than TILT.followed
        #: the tilt of a trunk that turns no faster, while the newest one is far ahead of it; else None
        self.overtaken: Tilt | None = None
        self._vector_arrival = -math.inf  # of a gravity vector, accepted or not
        self._refusal = ""  # why the newest one was refused; contains no measured value

    def set_tilt(self, now: float, pitch: float, roll: float, age: float = 0.0) -> None:
        """Set pitch and roll in rad, which arrived at `now` (s) and were measured `age` s earlier.

        Ignored while gravity's vector arrives. Raises ParameterError if a trunk cannot have moved that far since the
        last measurement, and if `age` is impossible because the clock that stamped it differs from ours.
        """
        if now - self._vector_arrival > self.timeout:
            self._set(now, lambda: gravity_in_trunk(*Tilt.of(self._side, pitch, roll)[:2]), ZERO, age)

    def set_gravity(
        self, now: float, gravity: Sequence[float], angular_velocity: Sequence[float] = ZERO, age: float = 0.0
    ) -> None:
        """Set gravity's direction (3,) and the angular velocity (3,) rad/s, in the trunk's axes; else as `set_tilt`."""
        self._vector_arrival = now
        self._set(now, lambda: gravity, angular_velocity, age)

    def at(self, now: float) -> Tilt:
        """Return the tilt at `now`, turned on from the newest measurement, by no more than a trunk can tilt."""
        lead = min(now - self._time, max(self.timeout, TILT.hold))
        rate = math.hypot(*self._angular_velocity)
        if not rate or not 0.0 < lead < math.inf:
            return self._tilt
        lead *= min(1.0, TILT.speed / rate)
        # A vector at rest in the world turns in the axes of a body by -w: g' = g x w.
        a, b, c = self._in_trunk(self._tilt.direction)
        x, y, z = self._angular_velocity
        turned = a + lead * (b * z - c * y), b + lead * (c * x - a * z), c + lead * (a * y - b * x)
        return Tilt.of_gravity(self._side, turned)

    def age(self, now: float) -> float:
        """Return the age of the newest tilt at `now` by its stamp, in s; infinity before the first tilt."""
        return now - self._time

    def unknown_turn(self, now: float) -> float:
        """Return by how many rad the trunk may have turned otherwise than `at` says since the last tilt in time.

        Infinite if the newest one was refused: what contradicts it is not late.
        """
        if self._refusal:
            return math.inf
        return (TILT.turn_rate if any(self._angular_velocity) else TILT.turn_rate_alone) * (now - self._in_time)

    def problem(self, now: float) -> Status:
        """Return why there is no fresh tilt at `now`; false if there is one."""
        if now - self._time <= self.timeout:
            return NO_REASON
        code, text = Withdrawal.LATE_TILT, f"trunk tilt older than {self.timeout * 1000:.0f} ms"
        if self._time == -math.inf:
            code, text = Withdrawal.NO_TILT, "no trunk tilt yet"
        elif now - self._arrival <= self.timeout:
            lags = "by its stamp: the IMU driver lags, or its clock differs"
            code, text = Withdrawal.LATE_TILT_STAMP, f"{text} {lags}"
        if self._refusal:
            return Status(Withdrawal.REFUSED_TILT, f"{text} (the newest was refused: {self._refusal})")
        return Status(code, text)

    def _set(self, now: float, gravity: Callable[[], Vector], angular_velocity: Sequence[float], age: float) -> None:
        """Take a direction of gravity, or note why it is refused and raise ParameterError."""
        try:
            tilt = Tilt.of_gravity(self._side, gravity())
            self._accept(now, tilt, three_floats("angular_velocity", angular_velocity), age)
        except ParameterError as error:
            self._refusal = f"{error.name} must be {error.expected}"
            raise

    def _accept(self, now: float, tilt: Tilt, angular_velocity: Floats3, age: float) -> None:
        lead = max(0.0, self._lead - TILT.lead_decay * (now - self._arrival))
        if not -TILT.lead <= age + lead <= TILT.lag:
            span = f"from {-TILT.lead:g} to {TILT.lag:g} s"
            expected = f"{span}: synchronise the clocks of the IMU driver and this computer"
            raise ParameterError("age of the trunk tilt by its stamp", round(age + lead, 3), expected)
        check_trunk(tilt)
        lead = max(lead, -age)
        measured = now - max(0.0, age + lead)
        # Directions are compared, which are continuous where pitch and roll flip, in a bow through 90 degrees.
        elapsed = max(0.0, measured - self._time)
        reference, way = _followed(self._reference, tilt.direction, TILT.speed * elapsed)
        if way > TILT.jump:
            expected = f"within {TILT.jump:g} rad plus {TILT.speed:g} rad/s of the last ones"
            raise ParameterError("trunk tilt", [tilt.pitch, tilt.roll], expected)
        self._reference = reference
        self._behind, ahead = _followed(self._behind, tilt.direction, TILT.followed * elapsed)
        self.overtaken = Tilt.of_gravity(self._side, self._in_trunk(self._behind)) if ahead > TILT.ahead else None
        self._tilt, self._angular_velocity = tilt, angular_velocity
        self._time, self._arrival, self._lead, self._refusal = measured, now, lead, ""
        if now - measured <= self.timeout:
            self._in_time = measured

    def _in_trunk(self, direction: Floats3) -> Floats3:
        """Return in the trunk's axes what is in the arm's base frame, whose right one is mirrored."""
        b, a, c = direction
        return a, b if self._side == "left" else -b, -c


def _followed(reference: Floats3, direction: Floats3, reach: float) -> tuple[Floats3, float]:
    """Return `reference` turned towards `direction` by `reach` rad at most, both (3,), and the rad that are left."""
    way = angle_between(direction, reference)
    share = 1.0 if way <= reach else reach / way
    x, y, z = (old + share * (new - old) for new, old in zip(direction, reference, strict=True))
    norm = math.hypot(x, y, z) or 1.0
    return (x / norm, y / norm, z / norm), (1.0 - share) * way


@dataclass(frozen=True)
class FeltTuning:
    """How the felt motion is extrapolated."""

    window: float = 0.045  #: s of samples that the parabola fits, 5 at 100 Hz
    samples: int = 4  #: that it fits at a lower rate, or after losses,
    longest_window: float = 0.085  #: if this many s hold them, as from 40 Hz on
    #: s, added to the sample's age: 3 ms of delay in the sensor's low-pass filter (MPU-6050, 94 Hz), and 6 ms until the
    #: middle of the 4 ms for which the motors apply the torque
    effect: float = 0.009
    longest_lead: float = 0.03  #: s beyond the newest sample, farther than which the parabola is not extrapolated
    range: tuple[float, float] = (
        0.2 * STANDARD_GRAVITY,
        3.0 * STANDARD_GRAVITY,
    )  #: m/s^2; a hard seat is felt as 2.3 g


FELT = FeltTuning()


class Felt(NamedTuple):
    """Gravity less the trunk's acceleration, (3,) m/s^2, and angular acceleration, (3,) rad/s^2, in its axes."""

    gravity: Floats3
    angular_acceleration: Floats3


class FeltMotion:
    """Follows the samples of one IMU."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, tuple[float, ...]]] = deque()
        self._time = -math.inf  # of the newest sample
        self._parabola: np.ndarray | None = None  # (3, 6), coefficients of (t^2, t, 1) for force and angular velocity

    def add(
        self, now: float, specific_force: Sequence[float], angular_velocity: Sequence[float], age: float = 0.0
    ) -> None:
        """Add the sample taken `age` s before `now`: (3,) m/s^2 and (3,) rad/s in the trunk's axes.

        An older sample than the newest is ignored. Raises ParameterError unless all numbers are finite.
        """
        force = three_floats("linear_acceleration", specific_force)
        values = force + three_floats("angular_velocity", angular_velocity)
        time = now - max(0.0, age)
        if not time > self._time:
            return
        self._time = time
        self._samples.append((time, values))
        while self._samples[0][0] < time - (FELT.window if len(self._samples) > FELT.samples else FELT.longest_window):
            self._samples.popleft()
        self._parabola = None
        if len(self._samples) >= FELT.samples:
            times = np.array([taken - time for taken, _ in self._samples])
            self._parabola = np.linalg.lstsq(np.vander(times, 3), [row for _, row in self._samples], rcond=None)[0]

    def at(self, time: float, shoulder_from_imu: Floats3 = (0.0, 0.0, 0.0)) -> Felt | None:
        """Return what the arm will feel when a torque computed at `time` (s) acts, None if too few samples tell it.

        shoulder_from_imu: (3,) m in the trunk's axes. Where the trunk turns, its places accelerate differently.
        """
        lead = time - self._time + FELT.effect
        if self._parabola is None or lead > FELT.window + FELT.effect:
            return None
        lead = min(lead, FELT.longest_lead)
        bend, slope, newest = self._parabola
        values = newest + lead * (slope + lead * bend)
        a, b, c = (slope + 2.0 * lead * bend)[3:].tolist()
        x, y, z, *turning = values.tolist()
        x, y, z = plus((x, y, z), acceleration_of(shoulder_from_imu, (turning[0], turning[1], turning[2]), (a, b, c)))
        low, high = FELT.range
        norm = math.hypot(x, y, z)
        share = max(low, min(high, norm)) / max(norm, 1e-9)
        return Felt((-share * x, -share * y, -share * z), (a, b, c))
