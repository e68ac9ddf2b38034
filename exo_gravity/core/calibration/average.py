"""The samples of sweeps through a pose, there and back -> gravity torque and friction of each joint.

At the same angle the torque of the way there is gravity plus friction, that of the way back gravity minus friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.numbers import JOINT_COUNT

BINS = 4  # of each sweep: neighbouring samples share the slow oscillations of the controller
RESOLUTION = 0.002  # Nm: standard error that is left of the 12-bit torque command (7.3 mNm per code) after averaging


class Sweep(NamedTuple):
    """The samples of one sweep: position and effort (n, 4), in rad and Nm; forward: on the way there."""

    forward: bool
    position: np.ndarray
    effort: np.ndarray


class Average(NamedTuple):
    """What sweeps show at theta, (4,) rad; all others (4,) Nm.

    spread: standard error of effort. unrest: largest change of the effort from one cycle to another.
    """

    theta: np.ndarray
    effort: np.ndarray
    friction: np.ndarray
    spread: np.ndarray
    unrest: np.ndarray


def average(sweeps: Sequence[Sweep], slope: np.ndarray, bend: np.ndarray | None = None) -> Average:
    """Return the average of `sweeps`, which alternate between there and back.

    slope: (4, 4) Nm/rad, change of the expected torque with each angle, which relates efforts at different angles.
    bend: (4,) Nm/rad^2, second derivative while all joints turn alike. Without it a sweep of 0.07 rad shows up to 0.3 %
    less than the torque at its middle.
    """
    theta = np.mean([sweep.position.mean(axis=0) for sweep in sweeps], axis=0)
    bent = np.zeros(JOINT_COUNT) if bend is None else bend
    bins = np.array([_in_bins(sweep, theta, slope, bent) for sweep in sweeps])  # (sweeps, BINS, 4)
    there, back = bins[0::2], bins[1::2]
    gravity = (there + back) / 2.0
    cycles = gravity.mean(axis=1)
    friction = (there - back).mean(axis=(0, 1)) / 2.0
    independent = max(1.0, gravity[..., 0].size / 2.0)
    scatter = gravity.reshape(-1, JOINT_COUNT).std(axis=0, ddof=1) / np.sqrt(independent)
    return Average(theta, cycles.mean(axis=0), friction, np.hypot(scatter, RESOLUTION), np.ptp(cycles, axis=0))


def _in_bins(sweep: Sweep, theta: np.ndarray, slope: np.ndarray, bend: np.ndarray) -> np.ndarray:
    """Return the mean effort (BINS, 4) of a sweep in order of the angle, reduced to `theta`."""
    away = sweep.position - theta
    reduced = sweep.effort - away @ slope.T - np.outer(away.mean(axis=1) ** 2 / 2.0, bend)
    parts = np.array_split(reduced if sweep.forward else reduced[::-1], BINS)
    return np.array([part.mean(axis=0) for part in parts])
