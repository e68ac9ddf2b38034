"""Weighted least squares for the unknowns of an arm in held poses.

The unknowns are the eight moments in kg m, the logarithm of the four torque scales, the four offsets in Nm, the factor
by which moments and scales are too large in common, by which a known weight seems too heavy, three angles by which the
weight seems to lie off the links (a zero of joint 3 or 4 that is off by a degree moves a weight by more than a light
forearm's own moment), and the rotation of gravity's direction from the measured to the true one: an IMU is mounted, and
a stand placed, to no better than a degree. The commanded effort is `torque(moments + factor * load) / scale + offset`:
nearly linear, so a few Gauss-Newton steps solve it. Each step leaves out the combinations of unknowns that the poses do
not show: those whose standard error exceeds `NATURAL`.

Errors are larger in some joints than the observations state (gear friction is not the same in every pose), so each
joint gets a factor of its own, estimated from its residuals and pooled with the others where poses are few.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from exo_gravity.core.errors import DataError
from exo_gravity.core.model.moments import MOMENTS, regressor
from exo_gravity.core.numbers import JOINT_COUNT

MOMENT = slice(0, 8)
SCALE = slice(8, 12)
OFFSET = slice(12, 16)
FACTOR = 16
ANGLE = slice(17, 20)  # of the load along Y3, Y4 and Z
TILT = slice(20, 23)  # rotation vector of gravity in the base frame
COUNT = 23
# kg m, logarithm, Nm, 1, rad, rad: a combination of unknowns that may be wrong by this much is not known.
NATURAL = np.repeat((0.1, 0.3, 0.3, 0.3, 0.3, 0.1), (len(MOMENTS), JOINT_COUNT, JOINT_COUNT, 1, 3, 3))
# kg m, of a robot arm with the motors of this package; only the share of noise and scale in a pose depends on it.
TYPICAL_MOMENTS = (0.08, 0.15, 0.2, 0.026, 0.0, 0.0, 0.0, 0.0)
START = np.array((0.0, *TYPICAL_MOMENTS[1:4], *np.zeros(12), 1.0, *np.zeros(6)))  # of the search
HUBER = 2.0  # standard errors beyond which a residual's weight falls
POOLING = 6.0  # degrees of freedom with which all joints together inform the error of each
STEPS = 40
MEDIAN_SQUARE = 0.455  # of a standard normal variable
MEDIAN_CAUSED = 3.36  # of the sum of four such squares
LEAST_OUTLIER = 0.03  # Nm, and this share of the peak effort: a smaller error does no harm, nor does a hand cause it
SHARE_OF_PEAK = 0.01
DISTURBED = "Was it touched, does a joint slip or touch a stop?"
COMMON = 0.002  # of torque: error of all sweeps of a joint in one tour, which their scatter does not show
OUTLIER = 32.0  # such a sum from which a pose is left out: of good poses, one in 500,000


@dataclass(frozen=True, eq=False)
class Rows:
    """What is fitted, for n poses."""

    regressor: np.ndarray  #: (n, 4, 8) Nm per kg m
    turned: np.ndarray  #: (n, 4, 8, 3), change of `regressor` with each component of the tilt
    load: np.ndarray  #: (n, 8) kg m, moments of the weight
    beside: np.ndarray  #: (n, 8, 3), change of `load` with each angle
    effort: np.ndarray  #: (n, 4) Nm
    sigma: np.ndarray  #: (n, 4) Nm, standard error of `effort`
    free: np.ndarray = field(default_factory=lambda: np.ones(COUNT, dtype=bool))  #: (23,), the unknowns to be solved
    #: (k, 23), linear combinations of the unknowns that are 0, divided by their standard errors
    anchor: np.ndarray = field(default_factory=lambda: np.zeros((0, COUNT)))

    def only(self, keep: np.ndarray) -> Rows:
        """Return the poses that `keep` (n,) selects."""
        names = ("regressor", "turned", "load", "beside", "effort", "sigma")
        return replace(self, **{name: getattr(self, name)[keep] for name in names})

    def predicted(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the commanded effort (n, 4) in Nm."""
        torque = np.einsum("njk,nk->nj", self.regressor + self.turned @ unknowns[TILT], self._moments(unknowns))
        return np.asarray(torque * np.exp(-unknowns[SCALE]) + unknowns[OFFSET])

    def _moments(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the moments (n, 8) in kg m, with the load."""
        return np.asarray(unknowns[MOMENT] + unknowns[FACTOR] * (self.load + self.beside @ unknowns[ANGLE]))

    def jacobian(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the derivative of `predicted` by the unknowns, (n, 4, 23)."""
        result = np.zeros((*self.effort.shape, COUNT))
        share = np.exp(-unknowns[SCALE])[:, None]
        result[..., MOMENT] = (self.regressor + self.turned @ unknowns[TILT]) * share
        joints = np.arange(JOINT_COUNT)
        result[:, joints, SCALE.start + joints] = unknowns[OFFSET] - self.predicted(unknowns)
        result[:, joints, OFFSET.start + joints] = 1.0
        load = self.load + self.beside @ unknowns[ANGLE]
        result[..., FACTOR] = np.einsum("njk,nk->nj", result[..., MOMENT], load)
        result[..., ANGLE] = unknowns[FACTOR] * (result[..., MOMENT] @ self.beside)
        result[..., TILT] = np.einsum("njkt,nk->njt", self.turned, self._moments(unknowns)) * share
        return result


@dataclass(frozen=True, eq=False)
class Solution:
    """The fit of `Rows`."""

    unknowns: np.ndarray  #: (23,)
    covariance: np.ndarray  #: (23, 23) of what is known
    hidden: np.ndarray  #: (23,), share 0..1 of each unknown that is not known
    singular_values: np.ndarray  #: of the poses alone, in units of `NATURAL`, the largest first
    residual: np.ndarray  #: (n, 4) Nm
    hat: np.ndarray  #: (n, 4, n, 4), derivative of the predicted by the measured effort, both divided by sigma
    inverse: np.ndarray  #: (23, 4 n + k), change of the unknowns with each effort and condition, divided by its error

    @property
    def freedom(self) -> np.ndarray:
        """Degrees of freedom of each joint's residuals, (4,)."""
        return np.asarray(1.0 - np.einsum("njnj->nj", self.hat)).sum(axis=0)


def turned_regressor(theta: np.ndarray, direction: np.ndarray, gravity: float) -> np.ndarray:
    """Return the change of `regressor` (n, 4, 8, 3) with a small rotation vector of `direction` (n, 3), in rad."""
    along = np.stack([regressor(theta, axis, gravity) for axis in np.eye(3)], axis=-1)  # linear in the direction
    turn = np.stack([np.cross(axis, direction) for axis in np.eye(3)], axis=-1)
    return np.asarray(np.einsum("njka,nat->njkt", along, turn))


def solve(rows: Rows, start: np.ndarray = START, weight: np.ndarray | None = None) -> Solution:
    """Return the least-squares solution from `start` (23,); weight: (n, 4) of the squared residuals, 1 by default."""
    root = np.sqrt(np.ones_like(rows.effort) if weight is None else weight) / rows.sigma
    unknowns, step = start.copy(), np.full(COUNT, np.inf)
    for _ in range(STEPS):
        jacobian = (rows.jacobian(unknowns) * root[..., None]).reshape(-1, COUNT)
        residual = np.append(root * (rows.effort - rows.predicted(unknowns)), -rows.anchor @ unknowns)
        inverse = _inverse(np.vstack((jacobian, rows.anchor)), rows.free)
        step = inverse @ residual
        # A scale that jumps by more than a factor of 1.6 in one step has left the range of the linear model.
        unknowns = unknowns + step / max(1.0, 2.0 * float(np.abs(step[SCALE]).max()))
        if np.all(np.abs(step) < 1e-9 * NATURAL):
            break
    return _solution(rows, unknowns, root)


def _inverse(whitened: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse (23, m) of `whitened` (m, 23), without what is not known."""
    natural = NATURAL * free
    left, size, right = np.linalg.svd(whitened * natural, full_matrices=False)
    known = size > 1.0
    return np.asarray(natural[:, None] * (right[known].T / size[known]) @ left[:, known].T)


def _solution(rows: Rows, unknowns: np.ndarray, root: np.ndarray) -> Solution:
    jacobian = (rows.jacobian(unknowns) * root[..., None]).reshape(-1, COUNT)
    inverse = _inverse(np.vstack((jacobian, rows.anchor)), rows.free)
    covariance = inverse @ inverse.T
    known = inverse @ np.vstack((jacobian, rows.anchor))  # a projection, up to the units
    hidden = np.where(rows.free, 1.0 - np.diag(known), 0.0)
    free = rows.free & (np.arange(COUNT) < FACTOR)  # a weight that hangs is known, and so is the common factor
    size = np.linalg.svd((jacobian * NATURAL)[:, free], compute_uv=False)
    singular_values = np.append(size, np.zeros(int(free.sum()) - len(size)))
    count = len(rows.effort)
    hat = (jacobian @ inverse[:, : 4 * count]).reshape(count, 4, count, 4)
    residual = rows.effort - rows.predicted(unknowns)
    return Solution(unknowns, covariance, hidden, singular_values, residual, hat, inverse)


def robust(rows: Rows) -> tuple[Rows, Solution]:
    """Return a solution that gives large residuals little weight, and the rows with at least the error they state."""
    solution = solve(rows)
    for _ in range(4):
        squares = (solution.residual / rows.sigma) ** 2
        share = np.maximum(0.2, 1.0 - np.einsum("njnj->nj", solution.hat))
        typical = np.median(squares / share, axis=0) / MEDIAN_SQUARE
        factor = np.maximum(1.0, _pooled(typical, np.maximum(solution.freedom, 0.0)))
        size = np.sqrt(squares / share / factor)
        solution = solve(rows, solution.unknowns, np.minimum(1.0, HUBER / np.maximum(size, 1e-9)))
    return replace(rows, sigma=rows.sigma * np.sqrt(factor)), solution


def final(rows: Rows) -> tuple[Rows, Solution]:
    """Return the plain least-squares solution, and the rows with the error that its residuals show.

    The covariance includes a relative error of `COMMON` that all poses of a joint with the same weight share.
    """
    scaled, solution = rows, solve(rows)
    for _ in range(3):
        freedom = np.maximum(solution.freedom, 0.0)
        squares = ((solution.residual / rows.sigma) ** 2).sum(axis=0)
        factor = _pooled(squares / np.maximum(freedom, 1e-9), freedom)
        scaled = replace(rows, sigma=rows.sigma * np.sqrt(factor))
        solution = solve(scaled, solution.unknowns)
    return scaled, replace(solution, covariance=solution.covariance + _common_error(scaled, solution))


def _common_error(rows: Rows, solution: Solution) -> np.ndarray:
    """Return the covariance (23, 23) that the error `COMMON` of each joint and weight causes."""
    torque = (rows.predicted(solution.unknowns) - solution.unknowns[OFFSET]) / rows.sigma
    loads, group = np.unique(rows.load, axis=0, return_inverse=True)
    shared = np.arange(len(loads))[:, None, None, None] == group.reshape(-1, 1)
    columns = COMMON * torque * shared * np.eye(JOINT_COUNT)[:, None, :]
    change = columns.reshape(-1, torque.size) @ solution.inverse[:, : torque.size].T
    return np.asarray(change.T @ change)


def _pooled(factor: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Return each joint's factor (4,) of the variance, moved towards that of all joints where its data are few."""
    total = freedom.sum()
    common = float(factor @ freedom) / total if total > 1.0 else 1.0
    pooled = (factor * freedom + POOLING * common) / (freedom + POOLING)
    return np.asarray(np.maximum(pooled, 1e-4))


def without_each_pose(solution: Solution, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each pose, what leaving it out shows.

    The residual (n, 4) in Nm of a prediction from the other poses, NaN where they do not suffice; and the part (n,) of
    the sum of squares that this pose causes, about 4 for a pose with usual errors.
    """
    whitened = solution.residual / sigma
    held_out, caused = np.full_like(whitened, np.nan), np.zeros(len(whitened))
    for i, residual in enumerate(whitened):
        left = np.eye(JOINT_COUNT) - solution.hat[i, :, i, :]
        if np.linalg.eigvalsh((left + left.T) / 2.0)[0] > 1e-6:
            held_out[i] = np.linalg.solve(left, residual)
            caused[i] = residual @ held_out[i]
    return held_out * sigma, caused


def without_outliers(rows: Rows) -> tuple[np.ndarray, tuple[tuple[int, str], ...]]:
    """Return which poses (n,) fit one arm, and index and reason of each that does not.

    Raises DataError if more than a third does not fit.
    """
    keep = np.ones(len(rows.effort), dtype=bool)
    rejected: list[tuple[int, str]] = []
    least = np.maximum(LEAST_OUTLIER, SHARE_OF_PEAK * np.abs(rows.effort).max(axis=0))
    while True:
        used, solution = robust(rows.only(keep))
        held_out, caused = without_each_pose(solution, used.sigma)
        matters = np.nanmax(np.abs(held_out) / least, axis=1, initial=0.0) > 1.0
        worst = int(np.argmax(caused * matters))
        if not matters[worst] or caused[worst] < OUTLIER * max(1.0, float(np.median(caused)) / MEDIAN_CAUSED):
            return keep, tuple(rejected)
        joint = int(np.argmax(np.abs(held_out[worst] / used.sigma[worst])))
        index = int(np.flatnonzero(keep)[worst])
        off = f"effort of joint {joint + 1} is {held_out[worst, joint]:+.2f} Nm off what the other poses predict"
        rejected.append((index, off))
        keep[index] = False
        if len(rejected) > len(keep) // 3:
            reasons = "; ".join(f"pose {index + 1}: {why}" for index, why in rejected)
            raise DataError(f"the poses do not fit one arm: {reasons}. {DISTURBED}")
