"""The pose that tells most about the unknowns of an arm, after the poses already taken."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from exo_gravity.core.calibration.pose_fit import COUNT, MOMENT, NATURAL, NOTHING_KNOWN, Rows
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.moments import MOMENTS, regressor
from exo_gravity.core.numbers import Vector

# kg m, of a robot arm with the motors of this package; only the share of noise and scale in a pose depends on it.
TYPICAL_MOMENTS = (0.08, 0.15, 0.2, 0.026, 0.0, 0.0, 0.0, 0.0)
NOISE = 0.03  # Nm in any pose
NOISE_SHARE = 0.02  # of the torque
# deg of each joint, within the paper's ranges: from these a missing pose is suggested.
GRID = ((-60, 0, 60), (15, 45, 75, 105, 135), (-30, 0, 30, 60, 90, 120), (0, 30, 60, 90, 120, 150))


def next_pose(
    taken: Sequence[Vector],
    candidates: np.ndarray,
    direction: Vector = (0.0, 0.0, 1.0),
    moments: Vector = TYPICAL_MOMENTS,
    gravity: float = STANDARD_GRAVITY,
) -> int:
    """Return the index of the candidate that adds the most information to the poses `taken`, by D-optimality.

    taken: (4,) rad each, none at the start. candidates: (n, 4) rad. direction: (3,), gravity's unit vector in the base
    frame. moments: (8,) kg m, a guess. Raises ParameterError if there is no candidate.
    """
    if len(candidates) == 0:
        raise ParameterError("candidates", [], "at least one pose")
    information = np.diag(NATURAL**-2.0)
    if len(taken):
        rows = told_by(np.asarray(taken, dtype=float), direction, np.asarray(moments), gravity).reshape(-1, COUNT)
        information += rows.T @ rows
    covariance = np.linalg.inv(information)
    rows = told_by(candidates, direction, np.asarray(moments), gravity)
    added = np.eye(4) + rows @ covariance @ rows.transpose(0, 2, 1)
    return int(np.argmax(np.linalg.slogdet(added)[1]))


def told_by(theta: np.ndarray, direction: Vector, moments: np.ndarray, gravity: float) -> np.ndarray:
    """Return the derivative of the efforts in the poses (n, 4) by the unknowns, divided by their noise: (n, 4, 23)."""
    rows = regressor(theta, direction, gravity)
    torque = rows @ moments
    noise = np.hypot(NOISE, NOISE_SHARE * torque)
    count = len(theta)
    empty = np.zeros((0, COUNT))
    load, beside = np.zeros((count, len(MOMENTS))), np.zeros((count, len(MOMENTS), 3))
    poses = Rows(
        rows, np.zeros((*rows.shape, 3)), load, beside, torque, noise, np.ones(COUNT, dtype=bool), empty, np.zeros(0)
    )
    unknowns = NOTHING_KNOWN.copy()
    unknowns[MOMENT] = moments
    return np.asarray(poses.jacobian(unknowns) / noise[..., None])


def missing_pose(hidden: np.ndarray, direction: Vector, moments: np.ndarray, gravity: float) -> str:
    """Return, in words, the pose of `GRID` that tells most about the unknowns of which `hidden` (23,) are not known."""
    poses = np.radians(list(itertools.product(*GRID)))
    told = told_by(poses, direction, moments, gravity) * NATURAL * hidden
    best = poses[int(np.argmax((told**2).sum(axis=(1, 2))))]
    return f"[{', '.join(f'{math.degrees(angle):.0f}' for angle in best)}] degrees"
