# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Held poses -> the arm's moments, the torque scale of each motor, and what the poses do not show.

The commanded effort that holds the arm in a pose is, without friction, which averages out over both directions,

    effort = (torque(moments + load) + spring theta) / scale + offset

where torque is the arm's regressor (moment_model.py) times its moments, in kg m. One weighted least squares (`solve`)
fits all of it: moments, the logarithm of the scales, offsets in Nm, the angles by which a known weight seems to lie
beside its link, the rotation of gravity's direction from the measured to the true one (an IMU is mounted, and a stand
placed, to no better than a degree), a spring across each joint in Nm/rad (where it is slack is part of the offset), the
slope of each scale over the motor's temperature, and small turns of the joints' places.

Each unknown is known before, with a standard error: the moments as the file has them, the others as 0. What the poses
do not show of it stays within that, and is part of the errors. A spring stays where it stands out of its error, and a
slope where the arm was seen cold and warm. A first fit, in which large residuals weigh less, finds the poses that
somebody touched. The plain fit leaves them out. Errors are larger in some joints than the observations state (gear
friction is not the same in every pose), so each joint gets a factor of its own, estimated from its residuals and pooled
with the others where poses are few.

A turn about a joint's axis is an error of its encoder's zero, one across it an axis askew. It shows where the joints
beyond turn about another axis. The zero of the last joint does not, nor that of one whose next axis is parallel: they
look like a moment across the link. A turn of the first joint is one of the whole arm: with an IMU it is part of its
mounting.

The fit knows more of an arm than its file: offsets where there is no spring, the turn of gravity without an IMU to
mount, and on the paper's arm, whose closed forms have fixed axes, axes that are askew. So the file's moments are those
with which its law comes nearest, in new poses, to the torque t of the whole fit (`held`). What they leave of it, b, is
known. With the Jacobian J of the torque, and the covariance C of the unknowns, the error in a new pose is normal about
b, of variance J C J^T and the part of the residuals that their stated noise does not explain. What b leaves is no
noise: it is much the same in many poses. So the band is that which contains 95 % of all errors in all poses, and not a
multiple of their root mean square, which would contain more. A common factor of moments and torque scales is in C,
however large, and cancels in J: it holds the arm all the same.

No pose shows that friction differs between the two directions, whose mean counts as gravity's torque. A gear that loses
more while it drives its load than while it is driven makes a share of that torque look like more torque or less. How
friction grows with the torque is measured; `UNEQUAL` of it, as a standard error, is in the band. It was chosen on 28
devices of another make (3, 4 and 7 joints), where 95 % bands contained 74 to 100 % by joint, and without it 62 to
100 %. On 28 others they contained 86 to 100 %, and without it 70 to 99 %. Unequal Coulomb friction shows as an
offset.

A result that no arm can have is refused, with the pose that is missing. Held poses do not show a common factor of all
scales and moments without a known weight; nor can they tell a moment across link 3 or 4 from an error of that joint's
zero.

Over its speed, a joint's friction is Coulomb, viscous and Stribeck:

    F(v) = coulomb + viscous v + stribeck exp(-(v / v_s)^2)         B. Armstrong-Helouvry et al., Automatica 30 (1994)

and a share of the torque that the gear carries. With v_s = 0.05 rad/s this is linear; the last two parts stay where
they stand out of their errors.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares, lsq_linear

from exo_gravity.core.arm.springs import MAX_REST, MAX_STIFFNESS
from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import COVER, Vector
from exo_gravity.lab.calibration.moment_model import TURN, TURNS, MomentModel
from exo_gravity.lab.calibration.tracking import Observation


@dataclass(frozen=True)
class Fit:
    """The errors that the fit expects."""

    least_spread: float = 0.003  #: Nm; about half a code of an AK motor's 12-bit torque
    share: float = 0.4  #: of a moment: masses and torque scales that are each off by 30 %
    moment: float = 0.02  #: kg m, in addition: off-axis moments of which the file knows nothing
    scale: float = 0.3  #: of a torque scale; users report 0.75
    offset: float = 0.3  #: Nm
    beside: float = 0.05  #: rad, of the direction in which a known weight hangs from its joint; 3 degrees
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
    error[at.scale], error[at.offset], error[at.angle] = FIT.scale, FIT.offset, FIT.beside
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
    beside: np.ndarray  #: (m, k, a) kg m per rad, derivative of these moments by the angles of the weight
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


def solve(
    rows: Rows, known: Known, effort: np.ndarray, spread: np.ndarray, reach: float = math.inf, steps: int = FIT.steps
) -> Solution:
    """Return what explains the effort (m, n) in Nm; spread: (m, n) Nm, its standard error as the poses state it.

    reach: standard errors, from which on a residual counts less: its weight falls as in Cauchy's distribution.
    steps: of the joints' factors, and of the weights; with one, the stated errors count as they are.
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

    for _ in range(steps):
        bounds = known.least, np.inf
        unknowns = least_squares(off, unknowns, by_unknowns, bounds, x_scale=known.error, max_nfev=FIT.most).x
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
    hidden = np.diag(covariance) > FIT.hidden * known.error**2
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
            break
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


@dataclass(frozen=True)
class Information:
    """What counts as known, where poses are compared by what they show."""

    moment: float = 0.1  #: kg m, standard error of any moment before,
    other: float = 0.3  #: and of other unknowns, in their units
    noise: float = 0.03  #: Nm in any pose
    noise_share: float = 0.02  #: of the torque
    shown: float = 0.03  #: of what noise hides, from which the poses together show an unknown


SHOWS = Information()


def next_pose(
    taken: Sequence[Vector], candidates: np.ndarray, direction: Vector, moments: Vector, model: MomentModel
) -> int:
    """Return the index of the candidate that adds the most information to the poses `taken`, by D-optimality.

    Of equal ones the first, on every computer: in an upright stand the angle of joint 1 changes nothing.

    taken: (n,) rad each, none at the start.
    candidates: (m, n) rad.
    direction: (3,), gravity's unit vector in the base frame.
    moments: (k,) kg m, a guess.
    """
    known = _before(model)
    seen = _sensitivity(np.reshape(taken, (-1, model.count)), direction, moments, model).reshape(-1, len(known))
    information = np.diag(known**-2.0) + seen.T @ seen
    rows = _sensitivity(candidates, direction, moments, model)
    added = np.eye(model.count) + rows @ np.linalg.inv(information) @ rows.transpose(0, 2, 1)
    return int(np.argmax(np.linalg.slogdet(added)[1].round(6)))


def _before(model: MomentModel) -> np.ndarray:
    """Return the standard errors of an arm's moments, torque scales and offsets before a pose is chosen."""
    return np.repeat((SHOWS.moment, SHOWS.other), (len(model.names), 2 * model.count))


def _sensitivity(theta: np.ndarray, direction: Vector, moments: Vector, model: MomentModel) -> np.ndarray:
    """Return the derivative of the efforts in the poses (m, n) by these unknowns, by their noise: (m, n, count)."""
    rows = rows_at(model, theta, np.broadcast_to(direction, (len(theta), 3)))
    unknowns = np.append(moments, np.zeros(rows.layout.total - len(model.names)))
    noise = np.hypot(SHOWS.noise, SHOWS.noise_share * rows.predicted(unknowns))
    return np.asarray(rows.jacobian(unknowns)[..., : rows.layout.offset.stop] / noise[..., None])


POSES = 100  # new ones, at random
LEAN = 0.15  # rad, standard deviation of the trunk's pitch and roll in these
UNEQUAL = 0.25  # of the friction that grows with the torque: by how much it differs between both directions
NORMAL = np.array([NormalDist().inv_cdf((number + 0.5) / 400.0) for number in range(400)])  # in place of random numbers


class InFile(NamedTuple):
    """The file of a fit of n joints and k moments."""

    unknowns: np.ndarray  #: (count,) as the file has them, with its moments
    error: np.ndarray  #: (n,) Nm; COVER times this contains 95 % of the errors of its torque in new poses


def held(model: MomentModel, new: Rows, solution: Solution, misfit: np.ndarray, grows: np.ndarray) -> InFile:
    """Return what the file holds of a fit, and how well.

    new: the poses in which its torque is judged.
    misfit: (n,) Nm as commanded, root mean square of what noise does not explain of the residuals.
    grows: (n,), by how much of the torque friction grows.
    """
    at, unknowns = new.layout, solution.unknowns
    scale, kept = np.exp(unknowns[at.scale]), unknowns.copy()
    kept[at.offset] *= unknowns[at.spring] > 0.0
    kept[at.tilt] *= model.keeps_tilt
    turns = kept[at.turn].reshape(-1, TURNS)
    turns[:, 1:] *= model.is_described
    free = np.flatnonzero(~solution.hidden[at.moment])
    lowest = np.full(at.moment.stop, -np.inf)
    lowest[list(model.at_least_0)] = 0.0
    left = scale * (new.predicted(unknowns) - new.predicted(kept))
    by_moments = (scale[:, None] * new.jacobian(kept))[..., free].reshape(-1, len(free))
    kept[free] += lsq_linear(by_moments, left.ravel(), (lowest[free] - kept[free], np.inf)).x
    left = scale * (new.predicted(unknowns) - new.predicted(kept))
    jacobian = scale[:, None] * new.jacobian(unknowns)
    variance = np.einsum("qnt,tu,qnu->qn", jacobian, solution.covariance, jacobian, optimize=True)
    unequal = UNEQUAL * grows * new.predicted(unknowns)
    errors = left + np.sqrt(variance + scale**2 * (misfit**2 + unequal**2)) * NORMAL[:, None, None]
    return InFile(kept, np.quantile(np.abs(errors), 0.95, axis=(0, 1)) / COVER)


def new_poses(model: MomentModel) -> Rows:
    """Return poses at random without a weight, under tilts of the trunk if an IMU measures them."""
    random = np.random.default_rng(2)
    theta = random.choice(model.suggested, POSES)
    leans = random.normal(0.0, LEAN * model.keeps_tilt, (POSES, 2)).tolist()
    down = np.array([model.down(Tilt.of(SIDES[0], pitch, roll)) for pitch, roll in leans])
    return rows_at(model, theta, down, model.turned(theta))


@dataclass(frozen=True)
class Acceptance:
    """What a result must keep within."""

    scales: tuple[float, float] = (0.3, 3.0)  #: true torque per commanded torque; users report 0.75
    misfit: float = 0.1  #: of the peak effort
    least_misfit: float = 0.1  #: Nm
    slope: float = 0.005  #: 1/K; magnets lose 0.001 to 0.002
    turn: float = 6.0  #: deg of a zero or an axis; more is no error of what was measured or drawn
    least_torque: float = 0.3  #: Nm, root mean square of a joint in any pose, from which it is compared with the file's


ACCEPTED = Acceptance()


@dataclass(frozen=True)
class FrictionFit:
    """How friction is fitted over the speed."""

    least_ratio: float = 2.0  #: of the fastest to the slowest speed
    least_load: float = 0.5  #: Nm between the least and the most that a gear carried, from which its part can show
    resolution: float = 0.003  #: Nm: least standard error of a friction that was measured once
    stribeck_speed: float = 0.05  #: rad/s
    asked: float = 4.0  #: standard errors, beyond which there is Stribeck friction, or some that grows with the torque


FRICTION = FrictionFit()


TO_THE_SIDE = "lean the stand by 10 to 14 degrees to the arm's side, where the arm still hangs close to its home"


@dataclass(frozen=True, eq=False)
class Identified:
    """The result of `identify` from m observations of n joints. Two standard errors cover 95 %, also for few poses."""

    moments: np.ndarray  #: (k,) kg m in the order of the model's names
    #: (k,) kg m, their standard errors, infinite where the poses do not show a moment, which is then the file's
    error: np.ndarray
    scale: np.ndarray  #: (n,), true torque per commanded torque
    scale_error: np.ndarray  #: (n,), standard errors, infinite where not known
    offset: np.ndarray  #: (n,) Nm as commanded
    friction: np.ndarray  #: (n,) Nm as commanded
    residual: np.ndarray  #: (m, n) Nm, effort minus prediction
    held_out: np.ndarray  #: (m, n) Nm, the same predicted without that pose
    unknown: tuple[str, ...]  #: sentences on what the poses do not show, and what would
    rejected: tuple[tuple[int, str], ...]  #: index and reason of each observation that is not used
    #: No weight was hung: the product of the compared scales is taken as 1, moments are in commanded torque.
    relative: bool
    tilt: np.ndarray  #: (3,) rad in the base frame, rotation of gravity from the measured to the true direction
    tilt_covariance: np.ndarray  #: (3, 3); one lean of the stand does not show the turn about gravity, two do
    stiffness: np.ndarray  #: (n,) Nm/rad of the springs across the joints, 0 where the poses ask for none
    stiffness_error: np.ndarray  #: (n,), standard errors, 0 where no spring was fitted
    #: (n,) rad, where they are slack as the encoders say: a joint with a spring has its offset in it
    rest: np.ndarray
    slope: np.ndarray  #: (n,) 1/K of the scales over the motors' temperatures, 0 where the poses ask for none
    slope_error: np.ndarray  #: (n,), standard errors, 0 where no slope was fitted
    temperature: np.ndarray  #: (n,) degC, mean of the motors, at which `scale` is true; NaN where not known
    #: (n, 3) rad by which the joints' places are turned: about the axis, by which a joint is farther than its encoder
    #: says, and about two directions across it
    turn: np.ndarray
    turn_error: np.ndarray  #: likewise, standard errors
    in_file: np.ndarray  #: (k,) kg m, the moments with which a parameter file holds the arm best
    remainder: np.ndarray  #: (m, n) Nm, effort minus the prediction of that file
    torque_error: np.ndarray  #: (n,) Nm, standard error of that file's torque in other poses


def identify(observations: Sequence[Observation], model: MomentModel, places: Places | None = None) -> Identified:
    """Return what the observations show of an arm.

    places: how exactly its zeros and axes are known; by default as usual.

    Raises DataError if the result would be unphysical, naming the missing pose, and if an observation is impossible.
    """
    at, (theta, down, effort, spread) = layout_of(model), columns(observations)
    weights = [(one.load_mass, one.load_lever) for one in observations]
    load, beside = (np.array([of(*weight) for weight in weights]) for of in (model.load, model.load_beside))
    temperature, is_relative = temperatures(observations), not np.any(load)
    warmth = np.nan_to_num(temperature - temperature.mean(axis=0))
    rows = rows_at(model, theta, down, model.turned(theta))._replace(warmth=warmth, load=load, beside=beside)
    known = known_of(model, places or Places(), is_relative)
    known.error[at.slope][np.ptp(warmth, axis=0) < FIT.least_warming] = EXACT
    spread = np.hypot(spread, FIT.least_spread)
    keep, rejected = without_outliers(rows, known, effort, spread)
    used, seen, spread = rows.only(keep), effort[keep], spread[keep]
    solution = with_springs(used, known, seen, spread)
    typical, peak = np.median(np.abs(solution.residual), axis=0), np.abs(seen).max(axis=0)
    for joint in np.flatnonzero(typical > np.maximum(ACCEPTED.misfit * peak, ACCEPTED.least_misfit)):
        misfit = f"joint {joint + 1} is {typical[joint]:.2f} Nm off in half of the poses"
        raise DataError(f"the poses do not fit one arm: {misfit}. {DISTURBED}")
    joints = model.compared
    unseen = FIT.common * known.error[at.scale][joints] / math.sqrt(max(1, len(joints)))
    if not is_relative and np.all(solution.error[at.scale][joints] > unseen):
        raise DataError("the weight shows no common factor: hang a heavier one, or hold it with a horizontal forearm")
    _check_known(solution.hidden, len(observations), model)
    unknowns, error = solution.unknowns, solution.error
    moments, scale = unknowns[at.moment], np.exp(unknowns[at.scale])
    _check_scales(moments, scale, down[-1], model)
    _check_joints(unknowns, at)
    stiffness, slope = unknowns[at.spring], unknowns[at.slope]
    slack = -unknowns[at.offset] * scale / np.where(stiffness > 0.0, stiffness, np.inf)
    beyond_noise = np.maximum(solution.sigma**2 - spread**2, 0.0)
    friction = np.array([observation.friction for observation in observations])
    carried = np.abs(effort) - np.abs(effort).mean(axis=0)
    grows = np.maximum((carried * friction).sum(axis=0) / np.maximum((carried**2).sum(axis=0), 1e-12), 0.0)
    file = held(model, new_poses(model), solution, np.sqrt(beyond_noise.mean(axis=0)), grows)
    residual = effort - rows.predicted(unknowns)
    held_out = residual.copy()
    held_out[keep] = solution.held_out
    return Identified(
        moments, error[at.moment], scale, scale * error[at.scale], unknowns[at.offset],
        np.median(friction, axis=0), residual, held_out,
        tuple(_unknown(unknowns, solution.hidden, is_relative, model)), rejected,
        is_relative, unknowns[at.tilt], solution.covariance[at.tilt, at.tilt], stiffness,
        error[at.spring] * (stiffness > 0.0), np.clip(slack, -MAX_REST, MAX_REST), slope,
        error[at.slope] * (slope != 0.0),
        temperature.mean(axis=0),
        unknowns[at.turn].reshape(-1, TURNS), error[at.turn].reshape(-1, TURNS),
        file.unknowns[at.moment], effort - rows.predicted(file.unknowns), file.error,
    )  # fmt: skip


def _check_known(hidden: np.ndarray, count: int, model: MomentModel) -> None:
    """Raise DataError that names what is missing if `count` poses do not show `hidden` (count,) that others would."""
    upright = model.down(Tilt.of(SIDES[0]))  # what shows only while the base leans needs no pose
    poses, known = model.suggested, _before(model)
    shown = (_sensitivity(poses, upright, model.moments, model) * known) ** 2
    missing = hidden[: len(known)] & (np.sqrt(shown.sum(axis=(0, 1))) > SHOWS.shown * math.sqrt(len(poses)))
    if np.any(missing):
        names = ", ".join(name for name, is_missing in zip(_names(model), missing, strict=False) if is_missing)
        best = np.degrees(poses[int(np.argmax((shown * missing).sum(axis=(1, 2))))])
        pose = f"[{', '.join(f'{angle:.0f}' for angle in best)}] degrees"
        raise DataError(f"{count} poses do not show {names}: add the pose {pose}")


def _names(model: MomentModel) -> tuple[str, ...]:
    """Return the names of moments, scales and offsets."""
    joints = range(1, model.count + 1)
    return (*model.names, *(f"{what} {n}" for what in ("torque scale", "offset") for n in joints))


def _check_joints(unknowns: np.ndarray, at: FitLayout) -> None:
    """Raise DataError unless a device can have the zeros, axes, springs and slopes of these unknowns (count,)."""
    zero, *across = np.degrees(unknowns[at.turn]).reshape(-1, TURNS).T
    stiff, changed = "does a spring carry the arm, or does it touch a stop?", "was the arm changed between the tours?"
    for what, found, most, advice in (
        ("its zero is {:+.1f} degrees off", zero, ACCEPTED.turn, "set it by a jig or a stop, or check the URDF"),
        ("its axis is {:+.1f} degrees off", np.hypot(*across), ACCEPTED.turn, "check the URDF"),
        ("a spring of {:.2f} Nm/rad", unknowns[at.spring], MAX_STIFFNESS, stiff),
        ("torque scale changes by {:+.4f} per K", unknowns[at.slope], ACCEPTED.slope, changed),
    ):
        for joint in np.flatnonzero(np.abs(found) > most):
            raise DataError(f"joint {joint + 1}: {what.format(found[joint])}: must be within {most:g}: {advice}")


def _check_scales(moments: np.ndarray, scale: np.ndarray, direction: Vector, model: MomentModel) -> None:
    """Raise DataError unless motors can have the scales (n,), and each joint needs about the torque of the file's arm.

    moments: (k,) kg m.
    """
    low, high = ACCEPTED.scales
    for joint in np.flatnonzero((scale < low) | (scale > high)):
        expected = f"from {low:g} to {high:g}: is joint {joint + 1}'s direction or motor type wrong, or did it slip?"
        raise DataError(f"torque scale {joint + 1} = {scale[joint]:.3g}: must be {expected}")
    rows = model.rows(model.suggested, np.asarray(direction))
    found, given = rows @ moments, rows @ model.moments
    size = (given**2).sum(axis=0)
    for joint in np.flatnonzero(np.sqrt(size / len(rows)) > ACCEPTED.least_torque):
        share = float((found[:, joint] * given[:, joint]).sum() / size[joint])
        if not low <= share <= high:
            expected = f"from {low:g} to {high:g}: are its direction, its zero and the file's masses right?"
            raise DataError(f"joint {joint + 1} needs {share:.2g} times the torque of the file: must be {expected}")


def _unknown(unknowns: np.ndarray, hidden: np.ndarray, relative: bool, model: MomentModel) -> Iterator[str]:
    """Yield what the poses do not show, and what would, in sentences; unknowns and `hidden`: (count,)."""
    if relative:
        yield f"A common factor of all torque scales and moments: hang a known weight on link {model.count}."
    names = ", ".join(name for name, is_hidden in zip(_names(model), hidden, strict=False) if is_hidden)
    idle = ", ".join(f"joint {n + 1}" for n in np.flatnonzero(~model.upright.any(axis=1)))
    if names and idle:
        yield f"{names}: {idle} carries nothing while its axis is vertical: {TO_THE_SIDE}."
    elif names:
        yield f"{names}: no pose shows them while the base stands as it does; the file's values are kept."
    for across, along in model.across:
        angle = math.degrees(math.atan2(unknowns[across], unknowns[along]))
        looks = f"it looks like one of {angle:+.1f} degrees; check the zero with a level or at a stop."
        yield f"{model.names[across]} of link {along + 1} from an error of joint {along + 1}'s zero: {looks}"


class FrictionCurve(NamedTuple):
    """Friction of a joint over its speed, and over the torque that its gear carries."""

    speed: np.ndarray  #: (n,) rad/s
    torque: np.ndarray  #: (n,) Nm, measured
    carried: np.ndarray  #: (n,) Nm that the gear carried
    fitted: np.ndarray  #: (n,) Nm
    coulomb: float  #: Nm
    viscous: float  #: Nm s/rad
    stribeck: float  #: Nm, 0 if the data show none
    load: float  #: share of what is carried, 0 if the data show none
    error: tuple[float, ...]  #: (4,), standard errors of coulomb, viscous, stribeck and load


def fit_friction(speed: np.ndarray, torque: np.ndarray, error: np.ndarray, carried: np.ndarray) -> FrictionCurve:
    """Return the friction that fits `torque` (n,) in Nm at `speed` (n,) rad/s, with standard errors `error` (n,) in Nm.

    carried: (n,) Nm that the gear carried meanwhile.

    A Stribeck part, and one that grows with what is carried, stay where they stand out of their errors.

    Raises DataError for fewer than 3 speeds, or less than a factor of 2 between them.
    """
    speeds, carried = len(np.unique(speed)), np.abs(carried)
    if speeds < 3:
        raise DataError(f"friction was measured at {speeds} speeds, must be at least 3")
    if speed.max() < FRICTION.least_ratio * speed.min():
        measured = f"from {speed.min():.2f} to {speed.max():.2f} rad/s"
        raise DataError(
            f"friction was measured {measured}, the fastest must be {FRICTION.least_ratio:g} times the slowest"
        )
    falling = np.exp(-((speed / FRICTION.stribeck_speed) ** 2))
    matrix = np.stack((np.ones_like(speed), speed, falling, carried), axis=1)
    used = np.array((True, True, speeds > 3, np.ptp(carried) > FRICTION.least_load))
    noise = math.hypot(float(np.sqrt(np.mean(np.square(error)))), FRICTION.resolution)
    while True:
        values, errors = np.zeros(4), np.zeros(4)
        inverse = np.linalg.pinv(matrix[:, used])
        values[used] = inverse @ torque
        scatter = np.linalg.norm(torque - matrix @ values) / math.sqrt(max(1, len(speed) - np.count_nonzero(used)))
        errors[used] = max(noise, scatter) * np.linalg.norm(inverse, axis=1)
        size = np.where(used, values / np.maximum(errors, 1e-12), np.inf)[2:]
        if size.min() > FRICTION.asked:
            coulomb, viscous, stribeck, load = values.tolist()
            parts = (coulomb, viscous, stribeck, load, tuple(errors.tolist()))
            return FrictionCurve(speed, torque, carried, matrix @ values, *parts)
        used[2 + np.argmin(size)] = False
