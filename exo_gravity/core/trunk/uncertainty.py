"""How far the estimated tilt may be off: a small model, in which each thing that was not measured has its term.

One standard deviation of the tilt is the root of the sum of the squares of the terms that docs/imu.md lists. Those of a
gap, of saturation, of repeated samples and of a jump of the rate add up, and decay with VQF's time constant.
"""

from __future__ import annotations

import math

from exo_gravity.core.model.rotation import Floats3

MAX_ERROR = math.radians(3.0)  # of a tilt that is used
SIGMAS = 2.0  # standard deviations by which a tilt may be off
BASE = math.radians(0.6)  # VQF's error on real motion: 0.3 to 1.2 degrees RMS (docs/imu.md)
BIAS_TIME = 2.0  # s; VQF averages over 3 s
CORRELATION_TIME = 0.25  # s, a quarter of a stride
SETTLE_TIME = 1.0  # s, the shortest time from a start to the first tilt
START_TIME = 10.0  # s, after which the error of the start has gone
DECAY_TIME = 3.0  # s, VQF's tauAcc
LEAST_ACCELERATION = 20.0  # rad/s^2, assumed in a gap even after rest
ACCELERATION_TIME = 0.3  # s
OVERSHOOT = 0.25  # share of the range by which the true rate exceeds it
JUMP = math.radians(2.0)  # a sample; in good data a knock made 1.4 degrees
UNUSUAL = 8.0  # times the angular acceleration of the last ACCELERATION_TIME
GAP = 1.5  # usual intervals
LONG_GAP, GAP_DIVISOR = 5.0, 30.0
USUAL_SHARE = 0.02  # by which one interval changes the usual one


class TiltUncertainty:
    """Follows one estimate from its start, when nothing is known but the accelerometer."""

    variance = math.inf  #: of the tilt, rad^2
    _square = 0.0  # of the angular acceleration, (rad/s^2)^2, mean over ACCELERATION_TIME
    _lost = 0.0  # rad^2, of gaps and of runs of samples that did not show the rotation
    _run = 0.0  # rad lost in the present run, whose angles have one direction
    _start = math.pi  # rad, error of the start
    _age = 0.0  # s since the start

    def __init__(self, period: float) -> None:
        """Create it for samples that are usually `period` s apart."""
        self._period = period

    @property
    def is_lost(self) -> bool:
        """Whether so much rotation was not measured that the estimate must begin anew."""
        return SIGMAS * SIGMAS * (self._lost + self._run * self._run) > MAX_ERROR * MAX_ERROR

    @property
    def is_settled(self) -> bool:
        """Whether the tilt is off by no more than MAX_ERROR."""
        return self._age >= SETTLE_TIME and SIGMAS * SIGMAS * self.variance <= MAX_ERROR * MAX_ERROR

    def advance(
        self, dt: float, rate: Floats3, last_rate: Floats3, unknown: float = 0.0, repeated: float = 0.0
    ) -> None:
        """Add the rotation that was not measured between the last sample and this one, `dt` s later.

        unknown: rad/s by which the true rate may differ. repeated: s for which samples have been equal.
        """
        self._age += dt
        self._lost *= 1.0 - 2.0 * dt / DECAY_TIME
        period, lost = self._period, unknown * dt
        if repeated:
            lost = 0.5 * math.sqrt(self._square) * (2.0 * repeated - dt) * dt
        if dt > GAP * period:
            share = min(dt / period, LONG_GAP) / GAP_DIVISOR
            self._lost += max(LEAST_ACCELERATION**2, self._square) * (share * dt * dt) ** 2
        elif dt:
            change = math.dist(rate, last_rate)
            acceleration = change / max(dt, 0.5 * period)
            if change * dt > JUMP and acceleration > UNUSUAL * math.sqrt(self._square):
                lost += change * dt
            self._square += (acceleration * acceleration - self._square) * dt / ACCELERATION_TIME
        self._run += lost
        if not lost:
            self._lost, self._run = self._lost + self._run * self._run, 0.0
        self._period = period + USUAL_SHARE * (dt - period) if dt else period

    def combine(self, bias_sigma: float, square: float, contradiction: float) -> None:
        """Add up the terms.

        bias_sigma: rad/s. square: mean one of the deviation of the acceleration in the world from its mean, as a share
        of 1 g. contradiction: rad by which gyroscope and accelerometer contradict each other.
        """
        if self._age >= START_TIME:
            self._start = 0.0
        elif self._age >= SETTLE_TIME:  # a movement after a still start does not make it larger again
            self._start = min(self._start, math.sqrt(square) * CORRELATION_TIME / self._age)
        terms = BASE, BIAS_TIME * bias_sigma, self._start, contradiction / SIGMAS, self._run
        self.variance = self._lost + sum([term * term for term in terms])
