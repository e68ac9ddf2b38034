# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How far the estimated tilt may be off: a small model, in which each thing that was not measured has its term.

One standard deviation of the tilt is the root of the sum of the squares of the terms that docs/imu.md lists. Those of a
gap, of saturation, of repeated samples and of a jump of the rate add up, and decay with VQF's time constant.
"""

import math
from dataclasses import dataclass


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
