"""How far the estimated tilt may be off: a small model, in which each thing that was not measured has its term.

One standard deviation of the tilt is the root of the sum of the squares of the terms that docs/imu.md lists. Those of a
gap, of saturation, of repeated samples and of a jump of the rate add up, and decay with VQF's time constant.
"""

import math

MAX_SIGMA = math.radians(1.5)  # of a tilt that is used; it may be off by two
BASE = math.radians(0.6)  # VQF's error on real motion: 0.3 to 1.2 degrees RMS (docs/imu.md)
REPORTED = math.radians(1.0)  # data sheets of fused sensors state 1 to 2 degrees
BIAS_TIME = 2.0  # s; VQF averages over 3 s
CORRELATION_TIME = 0.25  # s, a quarter of a stride
SETTLE_TIME = 1.0  # s, the shortest time from a start to the first tilt
START_TIME = 10.0  # s, after which the error of the start has gone
DECAY_TIME = 3.0  # s, VQF's tauAcc
LEAST_ACCELERATION = 20.0  # rad/s^2, assumed in a gap even after rest
ACCELERATION_TIME = 0.3  # s
JUMP = math.radians(2.0)  # a sample; in good data a knock made 1.4 degrees
UNUSUAL = 8.0  # times the angular acceleration of the last ACCELERATION_TIME
GAP, GAP_SHARE = 1.5, 0.265  # usual intervals; of the turn that the acceleration makes beyond one of them
USUAL_SHARE = 0.02  # by which one interval changes the usual one


class TiltUncertainty:
    """Follows one estimate from its start, when nothing is known but the accelerometer."""

    sigma = math.inf  #: of the tilt, rad
    run = 0.0  #: rad lost in the present run of samples that did not show the rotation: their angles add up
    _age = 0.0  # s since the start
    _start, _rest = math.pi, math.inf  # rad, error of the start; rad^2, of all that does not add up
    _square = 0.0  # of the angular acceleration, (rad/s^2)^2, mean over ACCELERATION_TIME
    _lost = 0.0  # rad^2, of gaps and earlier runs

    def __init__(self, period: float) -> None:
        """Create it for samples that are usually `period` s apart."""
        self.period = period  #: s

    def miss(self, dt: float, change: float, unknown: float, repeated: float) -> bool:
        """Add the rotation that was not measured in `dt` s; return whether the estimate must begin anew.

        change: of the rate, rad/s. unknown: rad/s that the rate may have been off. repeated: s of equal samples.
        """
        is_gap, turn = dt > GAP * self.period, change * dt
        if not (unknown or repeated or is_gap or self.run or turn > JUMP):
            return False
        usual, lost = math.sqrt(self._square), unknown * dt
        if repeated:
            lost = 0.5 * usual * (2.0 * repeated - dt) * dt
        if is_gap:
            self._lost += (GAP_SHARE * max(LEAST_ACCELERATION, usual) * (dt - self.period) ** 2) ** 2
        elif turn > JUMP and change > UNUSUAL * usual * max(dt, 0.5 * self.period):
            lost += turn
        self.run += lost
        if not lost:
            self._lost, self.run = self._lost + self.run * self.run, 0.0
        return self._add_up() > MAX_SIGMA * MAX_SIGMA

    def advance(
        self, dt: float, count: int, spin_up: float, bias_sigma: float, square: float, contradiction: float
    ) -> None:
        """Go on by `count` samples in `dt` s, in which the rate changed by `spin_up` rad/s^2.

        bias_sigma: rad/s. square: mean one of the deviation of the acceleration in the world from its mean, as a share
        of 1 g. contradiction: rad by which gyroscope, accelerometer and clock contradict each other.
        """
        self._age += dt
        self._square += (spin_up * spin_up - self._square) * dt / ACCELERATION_TIME
        self.period += USUAL_SHARE * (dt - count * self.period)
        self._lost *= 1.0 - 2.0 * dt / DECAY_TIME
        if self._age >= START_TIME:
            self._start = 0.0
        elif self._age >= SETTLE_TIME:  # a movement after a still start does not make it larger again
            self._start = min(self._start, math.sqrt(square) * CORRELATION_TIME / self._age)
        bias, half = BIAS_TIME * bias_sigma, 0.5 * contradiction
        self._rest = BASE * BASE + bias * bias + self._start * self._start + half * half
        self._add_up()

    def report(self, dt: float) -> None:
        """Go on by `dt` s with an orientation that the IMU reports."""
        self._age, self._rest = self._age + dt, REPORTED * REPORTED
        self._add_up()

    def _add_up(self) -> float:
        """Return the rad^2 that were not measured."""
        lost = self._lost + self.run * self.run
        self.sigma = math.sqrt(self._rest + lost) if self._age >= SETTLE_TIME else math.inf
        return lost
