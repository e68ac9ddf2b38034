"""Held poses -> the arm's moments, the torque scale of each motor, and what the poses do not tell.

The commanded effort that holds the arm in a pose is, without friction, which averages out over both directions,

    effort = torque(moments + load) / scale + offset          torque: `core.model.moments.regressor` times the moments

A pose that does not fit the others (a hand on the arm, a slipping joint) is left out. A result that no arm can have is
refused, with the pose that is missing. Held poses do not tell a common factor of all scales and moments without a known
weight; nor a moment across link 3 or 4 from an error of that joint's zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from exo_gravity.core.calibration.identification_check import (
    check_fit,
    check_motors,
    check_physical,
    check_told,
    checked,
    untold,
)
from exo_gravity.core.calibration.pose_choice import TYPICAL_MOMENTS, next_pose
from exo_gravity.core.calibration.pose_fit import (
    ANGLE,
    COUNT,
    FACTOR,
    MOMENT,
    OFFSET,
    SCALE,
    TILT,
    Rows,
    Solution,
    final,
    turned_regressor,
    without_each_pose,
    without_outliers,
)
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.moments import load_moments, regressor
from exo_gravity.core.numbers import Vector

__all__ = ["Identified", "Observation", "identify", "next_pose"]

LEAST_SPREAD = 0.003  # Nm; about half a code of an AK motor's 12-bit torque
# Moments across and along the links between which an angle turns a weight: Y3 and M3, Y4 and M4, Z and M4.
BESIDE = ((6, 2), (7, 3), (5, 3))
BESIDE_ERROR = 0.05  # rad, of a weight's place; 3 degrees
TILT_ERROR = 0.05  # rad about each axis, of gravity's measured direction: an IMU's mounting, mostly its heading
EXACT = 1e-6  # error of a value that is held
HIDDEN = 0.1  # share of an unknown, in combinations that are not known, from which it is not known itself


class Observation(NamedTuple):
    """One pose, passed in both directions of motion.

    theta: (4,) rad. direction: (3,), gravity's unit vector in the base frame. effort: (4,) Nm as commanded, mean of
    both directions. friction: (4,) Nm, half of their difference. spread: (4,) Nm, standard error of `effort`.
    load_mass, load_lever: a weight in kg on link 4, and its distance in m from the elbow; 0 for none.
    """

    theta: Vector
    direction: Vector
    effort: Vector
    friction: Vector
    spread: Vector
    load_mass: float = 0.0
    load_lever: float = 0.0


@dataclass(frozen=True, eq=False)
class Identified:
    """The result of `identify`; n is the number of observations.

    moments: (8,) kg m in the order of `MOMENTS`. covariance: (8, 8), infinite on the diagonal for a moment that the
    poses do not tell, which is then that of `known`, or 0. scale: (4,), true torque per commanded torque. relative: no
    weight was hung, so the product of the scales of joints 2 to 4 is taken as 1, and the moments are in commanded
    torque, not in kilograms. scale_error: (4,), standard error, infinite if not known; 0 if the scale was not solved.
    Two standard errors cover 95 %, also for few poses. offset, friction: (4,) Nm as commanded. residual: (n, 4) Nm,
    effort minus prediction. held_out: (n, 4) Nm, the same predicted without that pose, NaN where the others do not
    suffice. singular_values: of the information in the poses, the largest first; below 1: combinations that are not
    known. unknown: sentences on what the poses do not tell, and what would. rejected: index and reason of each
    observation that is not used. tilt: (3,) rad in the base frame, rotation of gravity from the measured to the true
    direction, and tilt_covariance (3, 3). One lean of the stand does not tell the turn about gravity, two do.
    """

    moments: np.ndarray
    covariance: np.ndarray
    scale: np.ndarray
    scale_error: np.ndarray
    offset: np.ndarray
    friction: np.ndarray
    residual: np.ndarray
    held_out: np.ndarray
    singular_values: np.ndarray
    unknown: tuple[str, ...]
    rejected: tuple[tuple[int, str], ...] = ()
    relative: bool = False
    tilt: np.ndarray = field(default_factory=lambda: np.zeros(3))
    tilt_covariance: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))

    @property
    def error(self) -> np.ndarray:
        """Standard error (8,) of the moments in kg m."""
        return np.sqrt(np.diag(self.covariance))


def identify(
    observations: Sequence[Observation],
    length: Vector,
    gravity: float = STANDARD_GRAVITY,
    known: Identified | None = None,
    solve_scale: bool = True,
) -> Identified:
    """Return what the observations tell about an arm with links of `length` (4,) m.

    known: an earlier result of the same arm. With `solve_scale`, its moments and scales count according to their
    errors. Without, scale and offset are held at those of `known` (at 1 and 0 if there is none), and the moments are
    found anew: those of the arm with its wearer. Raises DataError if the result would be unphysical, naming the missing
    pose, and if an observation is impossible.
    """
    start = _start(known, solve_scale)
    rows = _with_conditions(_rows(observations, length, gravity), start, known if solve_scale else None, solve_scale)
    check_motors(rows.effort, rows.regressor @ np.array(TYPICAL_MOMENTS))
    keep, rejected = without_outliers(rows, start)
    used, solution = _bounded(rows.only(keep), start)
    check_fit(solution.residual, used.effort)
    direction, hidden = np.asarray(observations[-1].direction, dtype=float), solution.hidden > HIDDEN
    check_told(hidden, len(observations), direction, gravity)
    is_loaded = solve_scale and bool(np.any(used.load))
    told = replace(solution, unknowns=np.where(hidden, start, solution.unknowns))
    unknowns, covariance = _in_kilograms(told, known if solve_scale else None, is_loaded)
    error = np.where(hidden, np.inf, np.sqrt(np.diag(covariance)))
    moments, scale = unknowns[MOMENT], np.exp(unknowns[SCALE])
    check_physical(moments, error[MOMENT], scale, direction, gravity)
    is_relative = not is_loaded and (solve_scale if known is None else known.relative)
    return Identified(
        moments,
        np.where(np.diag(hidden[MOMENT]), np.inf, covariance[MOMENT, MOMENT]),
        scale,
        scale * error[SCALE],
        unknowns[OFFSET],
        np.median([observation.friction for observation in observations], axis=0),
        *_residuals(rows, keep, used, solution),
        solution.singular_values,
        untold(unknowns, covariance, hidden, is_relative),
        rejected,
        is_relative,
        unknowns[TILT],
        covariance[TILT, TILT],
    )


def _rows(observations: Sequence[Observation], length: Vector, gravity: float) -> Rows:
    """Return the observations as arrays, with every unknown free."""
    theta, direction, effort, spread, weights = checked(observations)
    load = np.array([load_moments(length, *weight) for weight in weights])
    beside = np.zeros((*load.shape, 3))
    for angle, (across, along) in enumerate(BESIDE):
        beside[:, across, angle] = load[:, along]
    return Rows(
        regressor(theta, direction, gravity),
        turned_regressor(theta, direction, gravity),
        load,
        beside,
        effort,
        np.hypot(spread, LEAST_SPREAD),
        np.ones(COUNT, dtype=bool),
        np.zeros((0, COUNT)),
        np.zeros(0),
    )


def _common(known: Identified) -> float:
    """Return the logarithm of the factor that moments and scales have in common."""
    return float(np.log(known.scale[1:]).mean())


def _start(known: Identified | None, solve_scale: bool) -> np.ndarray:
    """Return the unknowns (23,) at which the search starts; if scales are solved, with the common factor removed."""
    start = np.zeros(COUNT)
    start[FACTOR] = 1.0
    start[1:4] = TYPICAL_MOMENTS[1:4]
    if known is not None:
        common = _common(known) if solve_scale else 0.0
        start[MOMENT] = known.moments * math.exp(-common)
        start[SCALE] = np.log(known.scale) - common
        start[OFFSET] = known.offset
    return start


def _with_conditions(rows: Rows, start: np.ndarray, known: Identified | None, solve_scale: bool) -> Rows:
    """Return `rows` with what is held, and with `known` as linear conditions."""
    free = np.ones(COUNT, dtype=bool)
    free[SCALE] = free[OFFSET] = free[TILT] = solve_scale
    free[ANGLE] = bool(np.any(rows.load))
    free[FACTOR] = solve_scale and free[ANGLE.start]
    anchor = np.vstack((np.eye(COUNT)[ANGLE] / BESIDE_ERROR, np.eye(COUNT)[TILT] / TILT_ERROR))
    if solve_scale:
        common = np.zeros((1, COUNT))
        common[0, SCALE] = np.array((0.0, 1.0, 1.0, 1.0)) / EXACT  # the common factor is the weight's
        anchor = np.vstack((anchor, common))
    if known is not None:
        relative_error = np.maximum(known.scale_error / known.scale, EXACT)
        error = np.append(known.error * math.exp(-_common(known)), relative_error)
        anchor = np.vstack((anchor, np.eye(SCALE.stop, COUNT) / np.maximum(error, EXACT)[:, None]))
    return replace(rows, free=free, anchor=anchor, anchor_value=anchor @ (start * (np.arange(COUNT) < SCALE.stop)))


def _bounded(rows: Rows, start: np.ndarray) -> tuple[Rows, Solution]:
    """Return the solution with M1, the least certain moment, at least 0, and the rows with their estimated errors."""
    used, solution = final(rows, start)
    if solution.unknowns[0] >= 0.0:
        return used, solution
    others = np.arange(COUNT) != 0
    used, bounded = final(replace(rows, free=rows.free & others), start * others)
    covariance = bounded.covariance.copy()
    covariance[0, 0] = solution.covariance[0, 0]
    return used, replace(bounded, covariance=covariance)


def _in_kilograms(solution: Solution, known: Identified | None, is_loaded: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the unknowns (23,) and their covariance (23, 23) without the factor by which a weight seems too heavy."""
    unknowns, covariance = solution.unknowns.copy(), solution.covariance.copy()
    if known is not None and not known.relative and not is_loaded:
        unknowns[FACTOR] = math.exp(-_common(known))
        share = np.min(known.scale_error[1:] / known.scale[1:])
        covariance[FACTOR, FACTOR] = (share * unknowns[FACTOR]) ** 2
    factor = unknowns[FACTOR]
    change = np.eye(COUNT)
    change[MOMENT, MOMENT] /= factor
    change[MOMENT, FACTOR] = -unknowns[MOMENT] / factor**2
    change[SCALE, FACTOR] = -1.0 / factor
    unknowns[MOMENT] /= factor
    unknowns[SCALE] -= math.log(factor)
    # Student's distribution: for few poses two standard errors would cover less than 95 %.
    return unknowns, (1.0 + 1.25 / (solution.freedom.min() + 6.0)) ** 2 * change @ covariance @ change.T


def _residuals(rows: Rows, keep: np.ndarray, used: Rows, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Return residual and held-out residual (n, 4) in Nm of all observations, also of those that were left out."""
    residual = rows.effort - rows.predicted(solution.unknowns)
    held_out = residual.copy()
    held_out[keep], _ = without_each_pose(solution, used.sigma)
    return residual, held_out
