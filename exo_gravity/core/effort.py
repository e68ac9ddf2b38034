"""A wearer's effort: what it takes to move an arm, from the torque he gives and the speed of the joints."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

SMOOTHING = 0.02  # s
STANDING = 0.005  # rad/s, below which a joint counts as standing


class Effort(NamedTuple):
    """A wearer's effort in one task, after the settling.

    rms, peak: (4,) Nm. work: J that the wearer put in, per s. jerk: RMS of the motion over all joints, rad/s^3. felt:
    reflected inertia in kg m^2, Coulomb friction in Nm and viscous friction in Nm s/rad of a sweep's joint, else None.
    held: RMS of the torque over all joints in Nm while the arm is held still, NaN for a task without holds.
    """

    rms: np.ndarray
    peak: np.ndarray
    work: float
    jerk: float
    felt: tuple[float, float, float] | None
    held: float = math.nan

    @property
    def total(self) -> float:
        """RMS of the torque over all joints in Nm: the root of the sum of squares."""
        return float(np.linalg.norm(self.rms))


def effort_of(
    torque: np.ndarray,
    speed: np.ndarray,
    rate: float,
    swept: int | None = None,
    holding: np.ndarray | None = None,
) -> Effort:
    """Return the effort of a wearer who gave `torque` (n, 4) in Nm at the joints' `speed` (n, 4) in rad/s.

    rate: samples per s. swept: the joint that made a sweep, None for another task. holding: (n,) whether the arm is
    held still, None for a task without holds.
    """
    smooth = _smoothed(speed, rate)
    acceleration = np.gradient(smooth, 1.0 / rate, axis=0)
    jerk = np.gradient(acceleration, 1.0 / rate, axis=0)[1:-1]
    return Effort(
        np.sqrt(np.mean(torque**2, axis=0)),
        np.abs(torque).max(axis=0),
        float(np.maximum((torque * speed).sum(axis=1), 0.0).mean()),
        float(np.sqrt(np.mean((jerk**2).sum(axis=1)))),
        None if swept is None else _felt(_smoothed(torque, rate), smooth, acceleration, swept),
        math.nan if holding is None else float(np.sqrt(np.mean((torque[holding] ** 2).sum(axis=1)))),
    )


def _felt(torque: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, n: int) -> tuple[float, float, float]:
    """Return inertia, Coulomb and viscous friction of joint `n`; the other joints, which move a little, act on it."""
    others = [joint for joint in range(speed.shape[1]) if joint != n]
    own = acceleration[:, n], np.tanh(speed[:, n] / STANDING), speed[:, n], np.ones(len(speed))
    columns = np.column_stack((*own, acceleration[:, others]))
    inertia, coulomb, viscous = np.linalg.lstsq(columns, torque[:, n], rcond=None)[0][:3].tolist()
    return inertia, coulomb, viscous


def _smoothed(values: np.ndarray, rate: float) -> np.ndarray:
    """Return the moving average over SMOOTHING, without the ends."""
    width = max(1, round(SMOOTHING * rate))
    return np.stack([np.convolve(column, np.ones(width) / width, mode="valid") for column in values.T], axis=1)
