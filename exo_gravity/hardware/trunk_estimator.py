# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Samples of an inertial measurement unit (IMU) on the trunk -> gravity in the trunk's axes, and how sure that is.

An orientation that the IMU reports is used as it is, while gyroscope and accelerometer confirm it. Without one, VQF
(D. Laidig, T. Seel, Information Fusion 91, 2023) fuses these two. Without a magnetometer the heading drifts, on which
gravity does not depend.

Only a sample that no working IMU gives is refused, with the reason; the estimate goes on over it. What was not
measured, in a gap or in saturation, makes the estimate less certain. While it may be off by more than 3 degrees there
is no output: the output never jumps.

One standard deviation of the tilt is the root of the sum of the squares of the terms that docs/imu.md lists. Those of a
gap, of saturation, of repeated samples and of a jump of the rate add up, and decay with VQF's time constant.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import (
    ZERO,
    Floats3,
    Quaternion,
    plus,
    product,
    unit_quaternion,
    up_in_body,
)
from exo_gravity.core.arm.tilt import angle_between, pitch_roll, rotation_matrix
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import one_float
from exo_gravity.core.trunk import checks
from exo_gravity.core.trunk.checks import Agreement, Contradiction, ImuSample, in_range, reported_orientation

try:
    from vqf import VQF
except ImportError:  # needed only for an IMU that reports no orientation
    VQF = None

__all__ = ["ImuSample", "TrunkEstimator", "TrunkOrientation"]

PACK = struct.Struct("6d").pack_into


@dataclass(frozen=True)
class EstimatorTuning:
    """When the estimate begins anew, and when the samples are judged."""

    longest_gap: float = 0.1  #: s between two samples, after which the estimate begins anew
    fastest_report: float = 15.0  #: rad/s; a reported orientation that turns faster has jumped: no trunk does
    report_rounding: float = 0.01  #: rad by which rounding may turn a reported orientation
    judgement_period: float = 0.0195  #: s between two judgements of the samples: every second one at 100 Hz,
    fast_period: float = 0.0095  #: or each one
    fast: float = 3.0  #: rad/s, while the IMU turns faster than this
    overshoot: float = 0.25  #: share of the gyroscope's range by which the true rate may exceed it
    bias_interval: int = 10  #: samples between two looks at the bias, which changes slowly


TUNING = EstimatorTuning()


@dataclass(frozen=True)
class ErrorModel:
    """How large each error of the tilt is, and how long it lasts."""

    limit: float = math.radians(1.5)  #: of a tilt that is used; it may be off by two standard deviations
    fused: float = math.radians(0.6)  #: VQF's error on real motion: 0.3 to 1.2 degrees RMS (docs/imu.md)
    reported: float = math.radians(1.0)  #: data sheets of fused sensors state 1 to 2 degrees
    bias_time: float = 2.0  #: s for which an unknown bias turns the estimate; VQF averages over 3 s
    correlation_time: float = 0.25  #: s, a quarter of a stride
    first_tilt: float = 1.0  #: s, the shortest time from a start to the first tilt
    start_time: float = 10.0  #: s, after which the error of the start has gone
    decay_time: float = 3.0  #: s, VQF's tauAcc
    acceleration: float = 20.0  #: rad/s^2, the least that is assumed in a gap, even after rest
    acceleration_time: float = 0.3  #: s over which the angular acceleration is averaged
    jump: float = math.radians(2.0)  #: rad a sample that are suspicious; in good data a knock made 1.4 degrees,
    unusual: float = 8.0  #: if the rate changes by this many times the angular acceleration so far
    gap: float = 1.5  #: usual intervals that make a gap
    gap_share: float = 0.265  #: of the turn that the acceleration makes beyond one interval, as measured
    interval_gain: float = 0.02  #: by which one interval changes the usual one


MODEL = ErrorModel()


class TiltUncertainty:
    """Follows one estimate from its start, when nothing is known but the accelerometer."""

    sigma = math.inf  #: of the tilt, rad
    run = 0.0  #: rad lost in the present run of samples that did not show the rotation: their angles add up
    _age = 0.0  # s since the start
    _start, _rest = math.pi, math.inf  # rad, error of the start; rad^2, of all that does not add up
    _square = 0.0  # of the angular acceleration, (rad/s^2)^2, a running mean
    _lost = 0.0  # rad^2, of gaps and earlier runs

    def __init__(self, period: float) -> None:
        """Create it for samples that are usually `period` s apart."""
        self.period = period  #: s

    @property
    def unmeasured(self) -> float:
        """Rotation that was lost of late, in gaps and saturation, rad."""
        return math.sqrt(self._lost + self.run * self.run)

    def add_unmeasured(self, dt: float, change: float, unknown: float, repeated: float) -> bool:
        """Add the rotation that was not measured in `dt` s; return whether the estimate must begin anew.

        change: of the rate, rad/s.
        unknown: by which the rate may have been off, rad/s.
        repeated: how long the samples have been equal, s.
        """
        is_gap, turn = dt > MODEL.gap * self.period, change * dt
        if not (unknown or repeated or is_gap or self.run or turn > MODEL.jump):
            return False
        usual, lost = math.sqrt(self._square), unknown * dt
        if repeated:
            lost = 0.5 * usual * (2.0 * repeated - dt) * dt
        if is_gap:
            self._lost += (MODEL.gap_share * max(MODEL.acceleration, usual) * (dt - self.period) ** 2) ** 2
        elif turn > MODEL.jump and change > MODEL.unusual * usual * max(dt, 0.5 * self.period):
            lost += turn
        self.run += lost
        if not lost:
            self._lost, self.run = self._lost + self.run * self.run, 0.0
        return self._add_up() > MODEL.limit * MODEL.limit

    def advance(
        self, dt: float, count: int, spin_up: float, bias_sigma: float, square: float, contradiction: float
    ) -> None:
        """Go on by `count` samples in `dt` s, in which the rate changed by `spin_up` rad/s^2.

        bias_sigma: standard deviation of the gyroscope's bias, rad/s.
        square: mean square of the deviation of the acceleration in the world from its mean, in shares of 1 g.
        contradiction: by which gyroscope, accelerometer and clock contradict each other, rad.
        """
        self._age += dt
        self._square += (spin_up * spin_up - self._square) * dt / MODEL.acceleration_time
        self.period += MODEL.interval_gain * (dt - count * self.period)
        self._lost *= 1.0 - 2.0 * dt / MODEL.decay_time
        if self._age >= MODEL.start_time:
            self._start = 0.0
        elif self._age >= MODEL.first_tilt:  # a movement after a still start does not make it larger again
            self._start = min(self._start, math.sqrt(square) * MODEL.correlation_time / self._age)
        bias, half = MODEL.bias_time * bias_sigma, 0.5 * contradiction
        self._rest = MODEL.fused * MODEL.fused + bias * bias + self._start * self._start + half * half
        self._add_up()

    def report(self, dt: float) -> None:
        """Go on by `dt` s with an orientation that the IMU reports."""
        self._age, self._rest = self._age + dt, MODEL.reported * MODEL.reported
        self._add_up()

    def _add_up(self) -> float:
        """Return the rad^2 that were not measured."""
        lost = self._lost + self.run * self.run
        self.sigma = math.sqrt(self._rest + lost) if self._age >= MODEL.first_tilt else math.inf
        return lost


class TrunkOrientation(NamedTuple):
    """The trunk's orientation by one sample."""

    orientation: Quaternion  #: (x, y, z, w), world from trunk; its heading is arbitrary
    uncertainty: float  #: one standard deviation of the tilt, rad

    @property
    def gravity(self) -> np.ndarray:
        """Its unit vector (3,) in the trunk's axes (x forward, y left, z up)."""
        return -np.array(up_in_body(self.orientation))

    @property
    def pitch(self) -> float:
        """In rad (REP-103: > 0 bows forward)."""
        return pitch_roll(self.gravity)[0]

    @property
    def roll(self) -> float:
        """In rad (> 0 leans right)."""
        return pitch_roll(self.gravity)[1]


class TrunkEstimator:
    """Follows one IMU; where VQF is installed, it need not report its orientation."""

    def __init__(
        self,
        rotation_trunk_from_imu: Sequence[float],
        rate: float = 100.0,
        gyroscope_range: float = checks.GYROSCOPE_RANGE,
        accelerometer_range: float = checks.ACCELEROMETER_RANGE,
    ) -> None:
        """Create an estimator for an IMU mounted at `rotation_trunk_from_imu`, (x, y, z, w), known from a calibration.

        rate: nominal sample rate, Hz.
        gyroscope_range: at which the sensor saturates, rad/s.
        accelerometer_range: at which it saturates, m/s^2.

        Raises ParameterError.
        """
        #: (3, 3), trunk from IMU
        self.rotation = rotation_matrix(rotation_trunk_from_imu, "rotation_trunk_from_imu")
        x, y, z, w = unit_quaternion("rotation_trunk_from_imu", rotation_trunk_from_imu)
        self._imu_from_trunk = (-x, -y, -z, w)
        self._period = 1.0 / one_float("rate", rate, 2.0 / TUNING.longest_gap, 10_000.0, "Hz")
        self._fastest = one_float("gyroscope_range", gyroscope_range, *checks.GYROSCOPE_RANGES, "rad/s")
        ranges = checks.ACCELEROMETER_RANGES
        self._strongest = one_float("accelerometer_range", accelerometer_range, *ranges, "m/s^2")
        self._fusion = VqfFusion(self._period) if VQF else None
        self._equal, self._clock = checks.EqualValues(), checks.ClockCheck()
        self._seldom, self._agreement = checks.RateCheck(), Agreement()
        self._has_turned = False  # whether the gyroscope has shown anything but zeros, which some drivers fill in
        self._is_fused: bool | None = None  # None before the first sample
        self._time = -math.inf
        self._restart("no sample yet")

    def _restart(self, why: str, is_suspect: bool = False) -> None:
        """Begin anew with the next sample, or the present one."""
        if self._fusion:
            self._fusion.restart()
        self._why = why  # there is no orientation yet
        self._uncertainty = TiltUncertainty(self._period)
        self._agreement = Agreement(is_suspect or self._agreement.is_suspect)
        self._quaternion: Quaternion | None = None  # of the IMU by the last sample, world from IMU
        self._force: Floats3 | None = None  # m/s^2, of the last sample
        self._speed = 0.0  # rad/s, the highest in the last second
        self._judged = self._time  # s, of the sample of the last judgement
        self._rates: list[Floats3] = []  # rad/s, at it and since then
        self._total, self._count = ZERO, 0  # m/s^2, sum of the forces since then, and how many they are
        self._turn, self._jolt = ZERO, 0.0  # rad, by the gyroscope since then, and what it may have missed

    @property
    def gyroscope_bias(self) -> np.ndarray:
        """The gyroscope bias that the fusion estimates and subtracts, (3,) rad/s in the IMU's axes."""
        return self._fusion.bias if self._fusion else np.zeros(3)

    @property
    def settling(self) -> str:
        """Why there is no orientation yet; empty once there is."""
        if self._agreement.is_suspect:
            return f"until its measurements agree on a turn of the trunk; {self._why}"
        if self._uncertainty.sigma <= MODEL.limit:
            return ""
        return "gyroscope and accelerometer show different turns" if self._agreement.turns.contradiction else self._why

    def update(self, sample: ImuSample, arrival: float | None = None) -> TrunkOrientation | None:
        """Process a sample; return the trunk's orientation, or None while it is not sure enough.

        arrival: when the sample arrived, s, by a clock that need not agree with that of the stamps; None: not known.

        Raises ParameterError if the sample is impossible, frozen or not later than the last one (it is then ignored),
        or if what it measures contradicts itself or the samples before it.
        """
        if sample.orientation is not None and reported_orientation(sample.orientation, 0.0) is None:
            sample = sample._replace(orientation=None)
        try:
            quaternion = self._fused(sample) if sample.orientation is None else self._reported(sample)
            if arrival is not None:
                self._clock.check(self._time, arrival)
        except Contradiction as error:
            self._restart(f"{error.name} must be {error.expected}", is_suspect=True)
            raise
        sigma = self._uncertainty.sigma
        is_sure = sigma <= MODEL.limit and self._agreement.mean.has_seen_gravity and not self._agreement.is_suspect
        return TrunkOrientation(product(quaternion, self._imu_from_trunk), sigma) if is_sure else None

    def _reported(self, sample: ImuSample) -> Quaternion:
        """Return the orientation that the IMU reports, world from IMU."""
        quaternion, last = unit_quaternion("orientation", sample.orientation), self._quaternion
        if sample.acceleration is None:
            expected = "reported, with gravity in it: an orientation is used only while the accelerometer confirms it"
            raise ParameterError("linear_acceleration", None, expected)
        force, is_cut = in_range("linear_acceleration", sample.acceleration, self._strongest)
        checks.check_unit(force, self._force)
        rate = ZERO
        if sample.angular_velocity is not None:
            rate, _ = in_range("angular_velocity", sample.angular_velocity, self._fastest)
        dt, up = self._step(sample, rate + force, None), up_in_body(quaternion)
        reach = TUNING.fastest_report * max(dt, self._period) + TUNING.report_rounding
        if last and angle_between(up, up_in_body(last)) > reach:
            self._restart("orientation jumped")
        self._force = None if is_cut else force
        self._quaternion = quaternion
        self._uncertainty.report(dt)
        self._has_turned = self._has_turned or any(rate)
        before = self._rates[-1] if self._rates else rate
        self._turn = plus(self._turn, plus(rate, before), 0.5 * dt)
        self._jolt = max(self._jolt, math.dist(rate, before) * dt)
        self._collect(rate, force, is_cut)
        elapsed = self._time - self._judged
        if elapsed >= TUNING.judgement_period:
            if self._count:
                mean = plus(ZERO, self._total, 1.0 / (self._count * STANDARD_GRAVITY))
                turn = self._turn if self._has_turned else None
                self._agreement.check_reported(elapsed, quaternion, mean, turn, self._jolt)
            self._begin_judgement(rate)
        return quaternion

    def _fused(self, sample: ImuSample) -> Quaternion:
        """Return the IMU's orientation, world from IMU, by gyroscope and accelerometer."""
        if self._fusion is None:
            raise ParameterError("orientation", None, "reported by the IMU, or install vqf to fuse it")
        rate, is_saturated = in_range("angular_velocity", sample.angular_velocity, self._fastest)
        force, is_cut = in_range("linear_acceleration", sample.acceleration, self._strongest)
        checks.check_unit(force, self._force)
        dt = self._step(sample, rate + force, None if is_saturated or is_cut else self._quaternion)
        last = self._rates[-1] if self._rates else rate
        unknown = TUNING.overshoot * self._fastest if is_saturated else 0.0
        if self._uncertainty.add_unmeasured(dt, math.dist(rate, last), unknown, self._equal.duration):
            self._restart("too much rotation was not measured")
        self._force = None if is_cut else force
        quaternion = self._quaternion = self._fusion.advance(dt, rate, last, self._force)
        self._collect(rate, force, is_cut)
        is_fast = math.hypot(*rate) >= TUNING.fast
        if self._time - self._judged >= (TUNING.fast_period if is_fast else TUNING.judgement_period):
            self._judge(quaternion, force, self._fusion.bias_sigma)
        return quaternion

    def _judge(self, quaternion: Quaternion, force: Floats3, bias_sigma: float) -> None:
        """Judge what the samples since the last judgement tell together."""
        dt, rates, agreement = self._time - self._judged, self._rates, self._agreement
        first, middle, rate = rates[0], rates[len(rates) // 2], rates[-1]
        spin_up, speed = (math.dist(first, middle) + math.dist(middle, rate)) / dt, math.hypot(*rate)
        if self._count:
            share, length = 1.0 / (self._count * STANDARD_GRAVITY), math.hypot(*force) / STANDARD_GRAVITY
            unmeasured, swing = self._uncertainty.unmeasured, spin_up + speed * speed
            agreement.check(dt, quaternion, plus(ZERO, self._total, share), length, swing, unmeasured)
        self._speed = max(sum(map(abs, rate)), self._speed * (1.0 - dt))
        contradiction = agreement.turns.contradiction + self._speed * self._clock.offset
        self._uncertainty.advance(dt, len(rates) - 1, spin_up, bias_sigma, agreement.mean.square, contradiction)
        self._begin_judgement(rate)

    def _collect(self, rate: Floats3, force: Floats3, is_cut: bool) -> None:
        """Take a sample for the next judgement; is_cut: whether the force is saturated."""
        self._rates.append(rate)
        if not is_cut:
            self._total, self._count = plus(self._total, force), self._count + 1

    def _begin_judgement(self, rate: Floats3) -> None:
        """Begin to collect for the next judgement; rate: rad/s, of the newest sample."""
        self._judged, self._rates, self._total, self._count = self._time, [rate], ZERO, 0
        self._turn, self._jolt = ZERO, 0.0

    def _step(self, sample: ImuSample, values: tuple[float, ...], quaternion: Quaternion | None) -> float:
        """Return the time in s since the last sample, 0 if the estimate begins with this one; check both."""
        time, is_fused = float(sample.time), sample.orientation is None
        dt = time - self._time
        if not math.isfinite(time) or -TUNING.longest_gap <= dt <= 0.0:  # far in the past: another clock, like a gap
            raise ParameterError("stamp", time, "a finite number, later than the last stamp")
        self._equal.check(time, values, quaternion if dt <= TUNING.longest_gap else None)
        self._time = time
        try:
            self._seldom.check(dt)
        except ParameterError as error:
            self._restart(f"{error.name} must be {error.expected}")
            raise
        if 0.0 < dt <= TUNING.longest_gap and is_fused is self._is_fused:
            return dt
        self._restart(f"gap of {dt:.2f} s" if is_fused is self._is_fused else "started")
        self._is_fused, self._clock = is_fused, checks.ClockCheck()
        return 0.0


class VqfFusion:
    """Orientation by VQF from samples that are not evenly spaced; the heading is arbitrary.

    VQF averages the accelerometer in the frame that the gyroscope carries along, and learns the gyroscope's bias at
    rest and in motion. Its sampling period is fixed, but samples come with jitter and with gaps. So the rates are
    scaled such that VQF turns in its period as far as the IMU did between two samples, and the accelerometer is passed
    on once for each period that has passed. On evenly spaced samples this is VQF alone.
    """

    def __init__(self, period: float) -> None:
        """Create a fusion for samples that are usually `period` s apart."""
        self._period = self._due = period  # s; for which the accelerometer has not been passed on
        self._vqf, self._count = VQF(period), 0
        self._values = np.zeros(6)  # of gyroscope and accelerometer, reused
        self._rate, self._force = self._values[:3], self._values[3:]
        self.bias = np.zeros(3)  #: rad/s

    def restart(self) -> None:
        """Forget the orientation, keep the bias."""
        bias, sigma = self._vqf.getBiasEstimate()
        self._vqf.resetState()
        self._vqf.setBiasEstimate(bias, sigma)
        self._due = self._period

    def advance(self, dt: float, rate: Floats3, last_rate: Floats3, acceleration: Floats3 | None) -> Quaternion:
        """Return the orientation `dt` s after the last sample, world from IMU.

        rate: of this sample, for the period that it ends, rad/s.
        last_rate: of the last one; over several periods those between the two are interpolated.
        acceleration: m/s^2; None: not known.
        """
        vqf, period = self._vqf, self._period
        if not self._count % TUNING.bias_interval:
            self.bias, self.bias_sigma = vqf.getBiasEstimate()
            self._bias = self.bias.tolist()
        self._count += 1
        periods = dt / period
        (x, y, z), (a, b, c) = rate, self._bias
        if periods > 1.001:
            x, y, z = plus(rate, plus(last_rate, rate, -1.0), 0.5 - 0.5 / periods)
        turn = a + periods * (x - a), b + periods * (y - b), c + periods * (z - c)
        PACK(self._values, 0, *turn, *(acceleration or turn))
        count = round((self._due + dt) / period)
        self._due += dt - count * period
        if acceleration and count:
            vqf.update(self._rate, self._force)
            for _ in range(1, count):
                vqf.updateAcc(self._force)
        else:
            vqf.updateGyr(self._rate)
        w, x, y, z = vqf.getQuat6D().tolist()
        return x, y, z, w
