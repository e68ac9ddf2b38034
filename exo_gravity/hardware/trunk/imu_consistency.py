"""Gyroscope and accelerometer against each other: a wrong unit, swapped or reversed axes.

The two must show the same turn of gravity over the last second. While a person moves, the accelerometer also measures
the movement, which shows in its length: the more that deviates from 1 g, the larger a turn must be to be compared. A
sample is refused while the turns differ. If that goes on, the estimate begins anew, and is used only after the two have
agreed on a turn, or at rest. The limits were set on the trials of docs/imu.md, of whose samples they refuse 0.05 %.
"""

from __future__ import annotations

import math

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.quaternion import Floats3
from exo_gravity.core.model.vector3 import plus

TURN_TIME = 1.0  # s over which the two turns are compared
CLEAR_TURN = 0.04  # of a unit vector: 2.3 degrees
CLEAR = 6.0  # times the deviation from 1 g, that a turn must also exceed
UNLIKE = 0.6  # share of the gyroscope's turn by which the two differ, with other axes or another sign
ALIKE = 0.3
AGREEMENT_TIME = 0.2  # s of like turns
PATIENCE = 0.06  # s of unlike turns; like ones count against them. In good data it was up to 0.04 s
FORGET_TIME = 2.0  # s
SHORT_TIME = 0.012  # s; a movement can look like a contradiction for as long
AT_REST, REST_TIME = 0.03, 3.0  # share of 1 g; s: at rest the estimate is right whatever the gyroscope measures


class ImuConsistency:
    """Follows one IMU that reports no orientation. is_suspect: the two must agree before the estimate is used."""

    def __init__(self) -> None:
        self.is_suspect = False
        self._agreed = 0.0  # s
        self.restart()

    def restart(self) -> None:
        """Begin anew with the next sample. Whether the two have agreed before is kept."""
        self._up: Floats3 | None = None  # low-pass filtered, like the next one
        self._measured: Floats3 = (0.0, 0.0, 0.0)
        self._unlike = self._run = 0.0  # s of unlike turns, in all and without a break
        self._rest = 0.0  # s

    def suspect(self) -> None:
        """Require that the two agree on a turn."""
        self.is_suspect, self._agreed = True, 0.0

    @property
    def is_broken(self) -> bool:
        """Whether a contradiction has gone on."""
        return self._unlike > PATIENCE

    def update(self, dt: float, up: Floats3, acceleration: Floats3, deviation: float) -> None:
        """Compare the estimate, whose world z axis is `up` in the IMU's axes, with `acceleration`.

        deviation: of the length of the acceleration from 1 g, as a share. Raises ParameterError.
        """
        x, y, z = acceleration
        norm = math.hypot(x, y, z)
        measured = x / norm, y / norm, z / norm
        if self._up is None:
            self._up, self._measured = up, measured
        self._up = blended(self._up, up, dt / TURN_TIME)
        self._measured = blended(self._measured, measured, dt / TURN_TIME)
        self._unlike -= self._unlike * dt / FORGET_TIME
        size = math.dist(up, self._up)
        if size > CLEAR_TURN:
            turn, measured_turn = plus(up, self._up, -1.0), plus(measured, self._measured, -1.0)
            self._compare(dt, turn, size, measured_turn, deviation)
        elif self.is_suspect:
            self._rest = self._rest + dt if deviation < AT_REST else 0.0
            self.is_suspect = self._rest < REST_TIME

    def _compare(self, dt: float, turn: Floats3, size: float, measured_turn: Floats3, deviation: float) -> None:
        self._rest = 0.0
        is_clear = size > CLEAR * deviation
        unlike = math.dist(turn, measured_turn)
        if is_clear and unlike < ALIKE * size:
            self._agreed += dt
            self._unlike = max(0.0, self._unlike - 2.0 * dt)
            self.is_suspect = self.is_suspect and self._agreed < AGREEMENT_TIME
        if not (is_clear and unlike > UNLIKE * size):
            self._run = 0.0
            return
        self._run += dt
        self._unlike += dt
        if self._run > SHORT_TIME:
            expected = "the turn that the accelerometer shows: check the gyroscope's unit, axes and signs"
            raise ParameterError("turn by angular_velocity", [round(v, 3) for v in turn], expected)


def blended(a: Floats3, b: Floats3, share: float) -> Floats3:
    """Return `a` moved towards `b` by `share`, at most to `b`."""
    k = share if share < 1.0 else 1.0
    (x, y, z), (u, v, w) = a, b
    return x + k * (u - x), y + k * (v - y), z + k * (w - z)
