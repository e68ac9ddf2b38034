# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Weighted least squares for the unknowns of an arm in held poses.

The unknowns are the moments of an arm of n joints (moment_model.py) in kg m, the logarithm of its torque scales, the
offsets in Nm, the angles by which a known weight seems to lie beside its link, the rotation of gravity's direction from
the measured to the true one (an IMU is mounted, and a stand placed, to no better than a degree), a spring across each
joint in Nm/rad (where it is slack is part of the offset), the slope of each scale over the motor's temperature, and
small turns of the joints' places. The commanded effort is `torque(moments + load) / scale + offset`.

Each unknown is known before, with a standard error: the moments as the file has them, the others as 0. What the poses
do not show of it stays within that, and is part of the errors.

A first fit, in which large residuals weigh less, finds the poses that somebody touched. The plain fit leaves them out.

Errors are larger in some joints than the observations state (gear friction is not the same in every
pose), so each joint gets a factor of its own, estimated from its residuals and pooled with the others where poses are
few.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from exo_gravity.core.errors import DataError
from exo_gravity.lab.calibration.moment_model import TURN, TURNS, MomentModel
from exo_gravity.lab.calibration.tracking import Observation


@dataclass(frozen=True)
class Fit:
    """The errors that the fit expects."""

    least_spread: float = 0.003  #: Nm; about half a code of an AK motor's 12-bit torque
    share: float = 0.4  #: of a moment: masses and torque scales that are each off by 30 %
    moment: float = 0.02  #: kg m, in addition: off-axis moments of which the file knows nothing
    scale: float = 0.3  #: of a torque scale,
    described_scale: float = 0.15  #: and of an arm whose masses are known; users report 0.75
    offset: float = 0.3  #: Nm
    beside: float = 0.05  #: rad, by which a known weight may lie beside its link; 3 degrees
    #: rad about each axis, of gravity's measured direction: an IMU's mounting, mostly its heading
    tilt: float = 0.05
    spring: float = 0.09  #: Nm/rad: cables of up to 0.15
    slope: float = 0.001  #: 1/K: magnets lose 0.001 to 0.002, and the file's slope is corrected
    least_warming: float = 5.0  #: K between the coldest and the warmest pose, from which a slope can show
    zero: float = 0.015  #: rad, of an encoder's zero in a file: at most 1.5 degrees, over sqrt(3)
    #: rad, of a joint's axis in each direction across it: it is at most 1.5 degrees askew, as on printed and welded
    #: brackets, over sqrt(6)
    axis: float = 0.0107
    pooling: float = 2.0  #: degrees of freedom with which all joints together inform the error of each
    reach: float = 2.0  #: standard errors, from which on a residual counts less while outliers are searched
    outlier: float = 6.0  #: standard errors, beyond which a pose is left out
    #: Nm, and this share of the peak effort: a smaller error does no harm, nor does a hand cause it
    least_outlier: float = 0.03
    share_of_peak: float = 0.01  #: of the effort, likewise
    most: int = 50  #: evaluations of a fit
    least_factor: float = 1e-4  #: of a variance, where poses agree by chance
    steps: int = 6  #: of the joints' factors, and of the weights of residuals
    hidden: float = 0.7  #: part of the variance before, from which on an unknown is not known
    common: float = 0.5  #: part of the error before, from which on a weight shows no common factor of the scales
    asked: float = 2.2  #: standard errors beyond which a spring is one; its square is ln of 120 efforts


FIT = Fit()


class Places(NamedTuple):
    """How exactly the places of an arm's joints are known before a tour, as standard errors in rad."""

    zero: float = FIT.zero  #: of the encoders' zeros
    axis: float = FIT.axis  #: of the axes, in each direction across them


DISTURBED = "Was it touched, does a joint slip or touch a stop?"
EXACT = 1e-5  # error of a value that is held
NEAR = 1e-3  # standard errors, within which an unknown is at its lowest value


class FitLayout(NamedTuple):
    """Where each of the unknowns of an arm stands."""

    moment: slice  #: kg m
    scale: slice  #: logarithms
    offset: slice  #: Nm
    angle: slice  #: rad
    tilt: slice  #: rad, the rotation vector of gravity in the base frame
    spring: slice  #: Nm/rad
    slope: slice  #: 1/K, of the torque scale over the motor's temperature
    turn: slice  #: rad, of the joints' places: about each joint's axis, its zero, and about two directions across it

    @property
    def total(self) -> int:
        """How many unknowns there are."""
        return int(self.turn.stop)


def layout_of(model: MomentModel, turns: int = TURNS) -> FitLayout:
    """Return where the unknowns of an arm stand, of each of whose joints so many `turns` are fitted."""
    joints = model.count
    ends = np.cumsum((0, len(model.names), joints, joints, 2, 3, joints, joints, turns * joints)).tolist()
    return FitLayout(*map(slice, ends[:-1], ends[1:]))


class Known(NamedTuple):
    """What is known of the unknowns before."""

    start: np.ndarray  #: (count,)
    error: np.ndarray  #: (count,), standard errors
    least: np.ndarray  #: (count,), lowest possible values
    product: np.ndarray  #: (c, count), linear combinations of the change from `start` that are 0, by their errors


def known_of(model: MomentModel, places: Places | None, is_relative: bool) -> Known:
    """Return what is known of an arm.

    places: how exactly those of its joints are known; None where these are not fitted.
    is_relative: without a weight a common factor does not show, which is then 1.
    """
    at = layout_of(model, TURNS if places else 0)
    start, least, error = np.zeros(at.total), np.full(at.total, -np.inf), np.zeros(at.total)
    start[at.moment] = model.moments
    least[at.spring] = least[list(model.at_least_0)] = 0.0
    error[at.moment] = FIT.share * np.abs(model.moments) + FIT.moment
    error[at.scale] = FIT.described_scale if model.is_described else FIT.scale
    error[at.offset], error[at.angle] = FIT.offset, FIT.beside
    error[at.tilt] = FIT.tilt if model.shows_tilt else EXACT
    error[at.spring], error[at.slope] = FIT.spring, FIT.slope
    if places:
        error[at.turn] = np.tile((places.zero, places.axis, places.axis), model.count)
    if model.shows_tilt:
        error[at.turn][:TURNS] = 0.0  # the whole arm turns with its first joint, which is the same as gravity turned
    product = np.eye(at.total)[at.scale][model.compared].sum(axis=0, keepdims=True) * is_relative
    return Known(start, np.maximum(error, EXACT), least, product / EXACT)


class Rows(NamedTuple):
    """The regressor in m poses of an arm with n joints and k moments."""

    along: np.ndarray  #: (m, n, k, 3) Nm per kg m, the torque with gravity along each axis of the base frame
    turned: np.ndarray  #: (m, n, k, 3, t) Nm per kg m and rad, its derivative by the turns that are fitted
    theta: np.ndarray  #: (m, n) rad
    warmth: np.ndarray  #: (m, n) K of the motors, beyond the mean of their poses; 0 where it is not known
    direction: np.ndarray  #: (m, 3), gravity's unit vector in the base frame, as measured
    load: np.ndarray  #: (m, k) kg m, moments of the weight
    beside: np.ndarray  #: (m, k, a) kg m per rad, how these moments change with the angles of a weight
    layout: FitLayout

    def only(self, keep: np.ndarray) -> "Rows":
        """Return the poses that `keep` (m,) selects."""
        return Rows._make((*(column[keep] for column in self[:-1]), self.layout))

    def predicted(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the commanded effort (m, n) in Nm."""
        _, torque, given = self._parts(unknowns)
        return np.asarray(torque * given + unknowns[self.layout.offset])

    def jacobian(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the derivative of `predicted` by the unknowns, (m, n, count)."""
        at, (rows, torque, given) = self.layout, self._parts(unknowns)
        own = np.eye(self.theta.shape[1])[None]  # what belongs to a joint changes that joint's effort alone
        effort = torque * given
        angles, moments = rows @ self.beside, self._moments(unknowns)
        turns = np.einsum("mi,ita->mta", self.direction, TURN)
        tilted = np.einsum("mnka,mta,mk->mnt", self.along, turns, moments, optimize=True)
        by_turns = np.einsum("mnkat,ma,mk->mnt", self.turned, self.direction, moments, optimize=True)
        warming = self.warmth / (1.0 + unknowns[at.slope] * self.warmth)
        parts = (
            rows * given[..., None],
            -own * effort[..., None],
            np.broadcast_to(own, (*effort.shape, own.shape[-1])),
            angles * given[..., None],
            tilted * given[..., None],
            own * (self.theta * given)[..., None],
            -own * (effort * warming)[..., None],
            by_turns * given[..., None],
        )
        return np.concatenate(parts, axis=-1)

    def _moments(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the moments of arm and weight, (m, k) kg m."""
        return np.asarray(unknowns[self.layout.moment] + self.load + self.beside @ unknowns[self.layout.angle])

    def _parts(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the regressor (m, n, k), the torque of gravity and springs (m, n), and what a command is of it."""
        at = self.layout
        direction = self.direction + self.direction @ (unknowns[at.tilt] @ TURN)
        rows = np.einsum("mnka,ma->mnk", self.along + self.turned @ unknowns[at.turn], direction)
        torque = np.einsum("mnk,mk->mn", rows, self._moments(unknowns)) + unknowns[at.spring] * self.theta
        return rows, torque, np.exp(-unknowns[at.scale]) / (1.0 + unknowns[at.slope] * self.warmth)


def rows_at(model: MomentModel, theta: np.ndarray, direction: np.ndarray, turned: np.ndarray | None = None) -> Rows:
    """Return the regressor at `theta` (m, n) rad, without a weight, with motors of one temperature.

    direction: (m, 3). turned: (m, n, k, 3, t), the derivative by turns, without which none is fitted.
    """
    load = np.zeros((len(theta), len(model.names)))
    beside = np.zeros((*load.shape, 2))
    is_fixed = turned is None
    turned = np.zeros((*theta.shape, len(model.names), 3, 0)) if turned is None else turned
    layout = layout_of(model, 0 if is_fixed else TURNS)
    return Rows(model.along_axes(theta), turned, theta, 0.0 * theta, direction, load, beside, layout)


class Solution(NamedTuple):
    """A fit."""

    unknowns: np.ndarray  #: (count,)
    covariance: np.ndarray  #: (count, count)
    hidden: np.ndarray  #: (count,), whether the poses do not show an unknown
    residual: np.ndarray  #: (m, n) Nm
    held_out: np.ndarray  #: (m, n) Nm, of a prediction from the other poses
    sigma: np.ndarray  #: (m, n) Nm, standard error of the effort as the residuals show it
    freedom: np.ndarray  #: (n,), degrees of freedom of each joint's residuals

    @property
    def error(self) -> np.ndarray:
        """Standard errors (count,), infinite where the poses do not show an unknown."""
        return np.where(self.hidden, np.inf, np.sqrt(np.diag(self.covariance)))


def columns(observations: Sequence[Observation]) -> list[np.ndarray]:
    """Return theta (m, n) rad, direction (m, 3), effort and spread (m, n) Nm. Raises DataError if one is not finite."""
    if not observations:
        raise DataError("no pose was observed")
    names = "theta", "direction", "effort", "spread"
    found = [np.array([getattr(one, name) for one in observations], dtype=float) for name in names]
    for name, values in zip(names, found, strict=True):
        for index in np.flatnonzero(~np.isfinite(values).all(axis=1))[:1]:
            raise DataError(f"pose {index + 1}: {name} = {values[index].tolist()}: must be finite numbers")
    return found


def temperatures(observations: Sequence[Observation]) -> np.ndarray:
    """Return the motors' temperatures (m, n) in degC, NaN where one is not known."""
    unknown = np.full(len(observations[0].theta), np.nan)
    given = [one.temperature if len(one.temperature) else unknown for one in observations]
    return np.array(given, dtype=float)


def solve(rows: Rows, known: Known, effort: np.ndarray, spread: np.ndarray, reach: float = math.inf) -> Solution:
    """Return what explains the effort (m, n) in Nm; spread: (m, n) Nm, its standard error as the poses state it.

    reach: standard errors, from which on a residual counts less: its weight falls as in Cauchy's distribution.
    """
    at, unknowns, sigma, weight = rows.layout, known.start, spread, np.ones_like(effort)
    anchor = np.vstack((np.diag(1.0 / known.error), known.product))

    def off(values: np.ndarray) -> np.ndarray:
        return np.append((rows.predicted(values) - effort) / sigma, anchor @ (values - known.start))

    def by_unknowns(values: np.ndarray) -> np.ndarray:
        return np.vstack(((rows.jacobian(values) / sigma[..., None]).reshape(-1, at.total), anchor))

    def covariance_at(values: np.ndarray) -> np.ndarray:
        scaled = by_unknowns(values) * known.error
        return known.error[:, None] * np.linalg.inv(scaled.T @ scaled) * known.error

    for _ in range(FIT.steps):
        bounds = known.least, np.inf
        unknowns = least_squares(off, unknowns, by_unknowns, bounds, x_scale=known.error, max_nfev=FIT.most).x
        unknowns = np.where(unknowns - known.least < NEAR * known.error, known.least, unknowns)
        covariance = covariance_at(unknowns)
        poses, residual = rows.jacobian(unknowns) / sigma[..., None], effort - rows.predicted(unknowns)
        left = np.eye(effort.shape[1]) - poses @ covariance @ np.swapaxes(poses, 1, 2)  # (m, n, n)
        held_out = sigma * np.linalg.solve(left, (residual / sigma)[..., None])[..., 0]
        freedom = (weight * np.einsum("mjj->mj", left)).sum(axis=0)
        squares = (weight * (residual / spread) ** 2).sum(axis=0)
        common = FIT.pooling * squares.sum() / freedom.sum()
        usual = spread * np.sqrt(np.maximum((squares + common) / (freedom + FIT.pooling), FIT.least_factor))
        sigma = np.hypot(usual, residual / reach)
        weight = (usual / sigma) ** 2
    # A turn that is fitted may seem to show what the poses as measured do not: M1, of a joint whose axis is vertical.
    measured = unknowns.copy()
    measured[at.tilt], measured[at.turn] = 0.0, 0.0
    hidden = np.diag(covariance_at(measured)) > FIT.hidden * known.error**2
    hidden[at.angle.start :] = False  # what is known of these before is true of every arm
    return Solution(unknowns, covariance, hidden, residual, held_out, usual, freedom)


def with_springs(rows: Rows, known: Known, effort: np.ndarray, spread: np.ndarray, slack: float = math.inf) -> Solution:
    """Return what explains the effort with those springs alone that stand out of their error.

    What the poses do not show is as it was before.

    known: of which the error of the other springs becomes 0. effort, spread: as for `solve`. slack: Nm, standard error
    of the offset of a joint without a spring, if it is less than before.
    """
    at = rows.layout
    while True:
        solution = solve(rows, known, effort, spread)
        size = solution.unknowns[at.spring] / solution.error[at.spring]
        size[known.error[at.spring] <= EXACT] = np.inf
        if size.min() > FIT.asked:
            # Student's distribution: for few poses two standard errors would cover less than 95 %.
            return solution._replace(
                covariance=solution.covariance * (1.0 + 1.25 / (solution.freedom.min() + 6.0)) ** 2
            )
        least = np.argmin(size)  # the others may now stand out
        known.error[at.spring][least] = EXACT
        known.error[at.offset][least] = min(known.error[at.offset][least], slack)
    hidden = solution.hidden
    unknowns = np.where(hidden | (known.error <= EXACT), known.start, solution.unknowns)
    # Student's distribution: for few poses two standard errors would cover less than 95 %.
    covariance = solution.covariance * (1.0 + 1.25 / (solution.freedom.min() + 6.0)) ** 2
    covariance[hidden] = covariance[:, hidden] = 0.0
    moments = np.flatnonzero(hidden[at.moment])
    covariance[moments, moments] = known.error[moments] ** 2
    return solution._replace(unknowns=unknowns, covariance=covariance)


def without_outliers(
    rows: Rows, known: Known, effort: np.ndarray, spread: np.ndarray
) -> tuple[np.ndarray, tuple[tuple[int, str], ...]]:
    """Return which poses (m,) fit one arm, and index and reason of each that does not.

    effort, spread: as for `solve`. Raises DataError if more than a third does not fit.
    """
    fit = solve(rows, known, effort, spread, FIT.reach)
    least = np.maximum(FIT.least_outlier, FIT.share_of_peak * np.abs(effort).max(axis=0))
    size = np.abs(fit.residual) / np.maximum(FIT.outlier * fit.sigma, least)
    keep = size.max(axis=1) < 1.0
    rejected = tuple(
        (pose, f"effort of joint {joint + 1} is {fit.residual[pose, joint]:+.2f} Nm off what the other poses predict")
        for pose, joint in enumerate(size.argmax(axis=1).tolist())
        if not keep[pose]
    )
    if len(rejected) > len(keep) // 3:
        reasons = "; ".join(f"pose {pose + 1}: {why}" for pose, why in rejected)
        raise DataError(f"the poses do not fit one arm: {reasons}. {DISTURBED}")
    return keep, rejected
