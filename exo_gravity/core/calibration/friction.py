"""Friction of a joint over its speed: Coulomb, viscous and Stribeck.

    F(v) = coulomb + viscous v + stribeck exp(-(v / v_s)^2)          B. Armstrong-Helouvry et al., Automatica 30 (1994)

For a given Stribeck speed v_s this is linear in the other three, so v_s is searched on a grid.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from exo_gravity.core.calibration.motion import MAX_SPEED, Station
from exo_gravity.core.calibration.poses import measurable
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
    error: tuple[float, float, float]  #: standard errors of coulomb, viscous and stribeck

    def at(self, speed: np.ndarray) -> np.ndarray:
        """Return the friction (n,) in Nm at `speed` (n,) rad/s, above 0."""
        bump = np.exp(-((np.asarray(speed) / self.stribeck_speed) ** 2))
        return np.asarray(self.coulomb + self.viscous * np.asarray(speed) + self.stribeck * bump)


def friction_stations(limits: Limits) -> list[Station]:
    """Return sweeps through the hanging arm at each of `SPEEDS`; the first lets the controller learn the friction."""
    stations = []
    for speed in (0.1, *SPEEDS):
        amplitude = max(AMPLITUDE[0], min(AMPLITUDE[1], speed * SWEEP_TIME))
        low, high = measurable(limits, amplitude)
        stations.append(Station(tuple(np.clip(limits.home, low + 0.1, high - 0.1).tolist()), speed, amplitude, 2))
    return stations


def fit_friction(speed: np.ndarray, torque: np.ndarray) -> FrictionCurve:
    """Return the friction that fits `torque` (n,) in Nm at `speed` (n,) rad/s.

    Raises DataError for fewer than 3 speeds, or less than a factor of 2 between them.
    """
    speed, torque = np.asarray(speed, dtype=float), np.asarray(torque, dtype=float)
    if len(np.unique(speed)) < 3:
        raise DataError(f"friction was measured at {len(np.unique(speed))} speeds, must be at least 3")
    if speed.max() < LEAST_RATIO * speed.min():
        measured = f"from {speed.min():.2f} to {speed.max():.2f} rad/s"
        raise DataError(f"friction was measured {measured}, the fastest must be {LEAST_RATIO:g} times the slowest")
    best = _fit(speed, torque, 1.0, with_stribeck=False)
    if len(np.unique(speed)) > 3:
        fits = [_fit(speed, torque, float(own), with_stribeck=True) for own in STRIBECK_SPEEDS]
        stribeck = min(fits, key=lambda fit: float(np.sum((fit.at(speed) - torque) ** 2)))
        if stribeck.stribeck > SIGNIFICANT * stribeck.error[2]:
            best = stribeck
    return best


def _fit(speed: np.ndarray, torque: np.ndarray, stribeck_speed: float, with_stribeck: bool) -> FrictionCurve:
    columns = np.stack((np.ones_like(speed), speed, np.exp(-((speed / stribeck_speed) ** 2))), axis=1)
    used = columns if with_stribeck else columns[:, :2]
    values, *_ = np.linalg.lstsq(used, torque, rcond=None)
    freedom = len(speed) - used.shape[1]
    scatter = float(np.sum((used @ values - torque) ** 2)) / freedom if freedom > 0 else 0.0
    variance = max(scatter, RESOLUTION**2) * np.diag(np.linalg.pinv(used.T @ used))
    coulomb, viscous, stribeck = (*values.tolist(), 0.0)[:3]
    errors = (*np.sqrt(variance).tolist(), 0.0)
    return FrictionCurve(coulomb, viscous, stribeck, stribeck_speed, (errors[0], errors[1], errors[2]))
