"""Friction of a joint over its speed: Coulomb, viscous and Stribeck.

    F(v) = coulomb + viscous v + stribeck exp(-(v / v_s)^2)          B. Armstrong-Helouvry et al., Automatica 30 (1994)

For a given Stribeck speed v_s this is linear in the other three, so v_s is searched on a grid.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from exo_gravity.core.calibration.motion import MAX_SPEED, Station
from exo_gravity.core.calibration.poses import hanging
from exo_gravity.core.errors import DataError
from exo_gravity.core.safety.limits import Limits

SPEEDS = (0.02, 0.05, 0.1, 0.18, MAX_SPEED)  # rad/s
SWEEP_TIME = 1.2  # s of a sweep's half at steady speed
AMPLITUDE = (0.05, 0.3)  # rad
STRIBECK_SPEEDS = np.geomspace(0.01, 0.2, 30)  # rad/s
SIGNIFICANT = 3.0  # standard errors, from which on a Stribeck part is kept
LEAST_RATIO = 2.0  # of the fastest to the slowest speed
RESOLUTION = 0.003  # Nm: standard error of a friction that was measured once


class FrictionCurve(NamedTuple):
    """Friction of a joint over its speed."""

    coulomb: float  #: Nm
    viscous: float  #: Nm s/rad
    stribeck: float  #: Nm, 0 if the data show none
    stribeck_speed: float  #: rad/s
    error: tuple[float, ...]  #: (3,), standard errors of coulomb, viscous and stribeck

    def at(self, speed: np.ndarray) -> np.ndarray:
        """Return the friction (n,) in Nm at `speed` (n,) rad/s, above 0."""
        bump = np.exp(-((np.asarray(speed) / self.stribeck_speed) ** 2))
        return np.asarray(self.coulomb + self.viscous * np.asarray(speed) + self.stribeck * bump)


def friction_stations(limits: Limits) -> list[Station]:
    """Return sweeps through the hanging arm at each of `SPEEDS`; the first lets the controller learn the friction."""
    amplitudes = np.clip(np.array((0.1, *SPEEDS)) * SWEEP_TIME, *AMPLITUDE).tolist()
    return [hanging(limits, *sweep) for sweep in zip((0.1, *SPEEDS), amplitudes, strict=True)]


def fit_friction(speed: np.ndarray, torque: np.ndarray) -> FrictionCurve:
    """Return the friction that fits `torque` (n,) in Nm at `speed` (n,) rad/s.

    Raises DataError for fewer than 3 speeds, or less than a factor of 2 between them.
    """
    speeds = len(np.unique(speed))
    if speeds < 3:
        raise DataError(f"friction was measured at {speeds} speeds, must be at least 3")
    if speed.max() < LEAST_RATIO * speed.min():
        measured = f"from {speed.min():.2f} to {speed.max():.2f} rad/s"
        raise DataError(f"friction was measured {measured}, the fastest must be {LEAST_RATIO:g} times the slowest")
    best = _fit(speed, torque)
    if speeds > 3:
        fits = [_fit(speed, torque, own) for own in STRIBECK_SPEEDS.tolist()]
        stribeck = min(fits, key=lambda fit: float(np.sum((fit.at(speed) - torque) ** 2)))
        if stribeck.stribeck > SIGNIFICANT * stribeck.error[2]:
            best = stribeck
    return best


def _fit(speed: np.ndarray, torque: np.ndarray, stribeck_speed: float = 0.0) -> FrictionCurve:
    """Return the fit with this Stribeck speed, 0 for a fit without Stribeck friction."""
    columns = [np.ones_like(speed), speed, *([np.exp(-((speed / stribeck_speed) ** 2))] if stribeck_speed else [])]
    matrix = np.stack(columns, axis=1)
    values, *_ = np.linalg.lstsq(matrix, torque, rcond=None)
    scatter = float(np.sum((matrix @ values - torque) ** 2)) / max(1, len(speed) - len(columns))
    errors = np.sqrt(max(scatter, RESOLUTION**2) * np.diag(np.linalg.pinv(matrix.T @ matrix)))
    coulomb, viscous, stribeck = (*values.tolist(), 0.0)[:3]
    return FrictionCurve(coulomb, viscous, stribeck, stribeck_speed or 1.0, (*errors.tolist(), 0.0)[:3])
