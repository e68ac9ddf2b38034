"""How far the estimated tilt may be off: a small model, in which each thing that was not measured has its term.

One standard deviation of the tilt is the root of the sum of the squares of
    BASE                              VQF's error on real motion: 0.3 to 1.2 degrees RMS (docs/imu.md)
    BIAS_TIME * s_b                   gyroscope bias not yet learnt: its standard deviation s_b, over VQF's 3 s window
    v / (g T)                         start: T s after it, the mean acceleration is wrong by a change of speed v over T,
                                      which is the deviation of the acceleration times CORRELATION_TIME
    a t^2 n / 30                      a gap of t s or n periods, 5 at most: rates interpolated, while the rotation
                                      accelerated by a, as of late; measured on the same trials
    OVERSHOOT * range * t             t s of saturation: the true rate exceeded the range by this share
    a t^2 / 2                         t s of repeated samples: the rate may have changed since
    w t                               t s at a rate w, of which an axis is stuck
    w t                               a rate that changes by w in one sample of t s, unusually and by more than JUMP
The last five add up, and decay with VQF's time constant.
"""

from __future__ import annotations

import math

from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.quaternion import Floats3

MAX_ERROR = math.radians(3.0)  # of a tilt that is used
SIGMAS = 2.0  # standard deviations that count as "may be off by"
BASE = math.radians(0.6)
BIAS_TIME = 2.0  # s
CORRELATION_TIME = 0.25  # s, a quarter of a stride
SETTLE_TIME = 1.0  # s, the shortest time from a start to the first tilt
START_TIME = 10.0  # s, after which the error of the start has gone
DECAY_TIME = 3.0  # s, VQF's tauAcc
LEAST_ACCELERATION = 20.0  # rad/s^2, assumed in a gap even after rest
ACCELERATION_TIME = 0.3  # s
OVERSHOOT = 0.25
JUMP = math.radians(2.0)  # a sample; in good data a knock made 1.4 degrees
UNUSUAL = 8.0  # times the angular acceleration of late
GAP = 1.5  # periods
LONG_GAP, GAP_DIVISOR = 5.0, 30.0


class TiltUncertainty:
    """Follows one estimate. sigma: one standard deviation of the tilt, rad."""

    def __init__(self, rate: float, gyroscope_range: float) -> None:
        self._period = 1.0 / rate
        self._overshoot = OVERSHOOT * gyroscope_range
        self._square = 0.0  # of the angular acceleration, (rad/s^2)^2, mean over ACCELERATION_TIME
        self.restart()

    def restart(self) -> None:
        """Begin anew: nothing is known but the accelerometer."""
        self.sigma = math.inf
        self._lost = 0.0  # rad^2, of gaps and saturation
        self._run = 0.0  # rad lost in the present run of samples that do not tell the rotation
        self._is_losing = False  # whether the run goes on
        self._start = math.pi  # rad, error of the start
        self._age = 0.0  # s since the start
        self._count = 0
        self._sum, self._squares = [0.0, 0.0, 0.0], 0.0  # of the acceleration in the world since the start

    @property
    def is_lost(self) -> bool:
        """Whether so much rotation was not measured that the estimate must begin anew."""
        return SIGMAS * math.sqrt(self._lost) > MAX_ERROR

    @property
    def is_settled(self) -> bool:
        """Whether the tilt is off by no more than MAX_ERROR."""
        return self._age >= SETTLE_TIME and SIGMAS * self.sigma <= MAX_ERROR

    def advance(self, dt: float, rate: Floats3, last_rate: Floats3) -> None:
        """Count the rotation that was not measured between the last sample and this one, `dt` s later."""
        if not self._is_losing:
            self._run = 0.0
        self._is_losing = False
        self._age += dt
        self._lost *= max(0.0, 1.0 - 2.0 * dt / DECAY_TIME)
        if dt > GAP * self._period:
            share = min(dt / self._period, LONG_GAP) / GAP_DIVISOR
            self._lost += max(LEAST_ACCELERATION**2, self._square) * (share * dt * dt) ** 2
        elif dt > 0.0:
            change = math.dist(rate, last_rate)
            acceleration = change / max(dt, 0.5 * self._period)
            if change * dt > JUMP and acceleration > UNUSUAL * math.sqrt(self._square):
                self._lose(change * dt)
            self._square += (acceleration * acceleration - self._square) * min(1.0, dt / ACCELERATION_TIME)

    def saturate(self, dt: float) -> None:
        """Count a saturated rate."""
        self._lose(self._overshoot * dt)

    def repeat(self, dt: float, duration: float) -> None:
        """Count a sample that repeats the last one, the `duration` s of equal ones having grown by `dt`."""
        self._lose(0.5 * math.sqrt(self._square) * (2.0 * duration - dt) * dt)

    def distrust(self, dt: float, rate: Floats3) -> None:
        """Count a rate of which an axis is stuck as not measured."""
        self._lose(math.hypot(*rate) * dt)

    def _lose(self, angle: float) -> None:
        """Add an angle in rad; the angles of one run have one direction, those of different runs do not."""
        self._lost += angle * (angle + 2.0 * self._run)  # the difference of the squares
        self._run += angle
        self._is_losing = True

    def combine(self, bias_sigma: float, acceleration_in_world: Floats3 | None) -> None:
        """Add up the terms. acceleration_in_world: by the present estimate; None if it is not known."""
        if self._age >= START_TIME:
            self._start = 0.0
        elif acceleration_in_world is not None:
            self._narrow(acceleration_in_world)
        bias = BIAS_TIME * bias_sigma
        self.sigma = math.sqrt(BASE * BASE + bias * bias + self._start * self._start + self._lost)

    def _narrow(self, acceleration: Floats3) -> None:
        """Let the error of the start shrink; a movement after a still start does not make it larger again."""
        self._count += 1
        for axis, value in enumerate(acceleration):
            self._sum[axis] += value
            self._squares += value * value
        if self._age < SETTLE_TIME:
            return
        mean_square = sum(value * value for value in self._sum) / self._count**2
        deviation = math.sqrt(max(0.0, self._squares / self._count - mean_square))
        self._start = min(self._start, deviation * CORRELATION_TIME / (STANDARD_GRAVITY * self._age))
