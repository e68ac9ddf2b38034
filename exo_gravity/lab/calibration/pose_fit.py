# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Weighted least squares for the unknowns of an arm in held poses.

The unknowns are the moments of an arm of n joints (moment_model.py) in kg m, the logarithm of its torque scales, the
offsets in Nm, the angles by which a known weight seems to lie beside its link, the rotation of gravity's direction from
the measured to the true one (an IMU is mounted, and a stand placed, to no better than a degree), and small turns of the
joints' places. The commanded effort is `torque(moments + load) / scale + offset`: nearly
linear, so a few Gauss-Newton steps solve it. Each step leaves out the combinations of unknowns that the poses do not
show: those whose standard error exceeds `NATURAL`. Angles and turns are known to some degrees before: what the poses do
not show of them stays within that, and is part of the errors.

Two further unknowns of each joint, the extras, may be 0. A spring across it, in Nm/rad (where it is slack is part of
the offset), is 0 unless the poses ask for it: `asked_for` decides by an information criterion, so that an arm without
springs loses no exactness to them. The slope of its scale over the motor's temperature is fitted from every arm that
was seen cold and warm, within what magnets lose: every motor has one.

Errors are larger in some joints than the observations state (gear friction is not the same in every pose), so each
joint gets a factor of its own, estimated from its residuals and pooled with the others where poses are few.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.errors import DataError
from exo_gravity.lab.calibration.moment_model import TURN, TURNS, MomentModel
from exo_gravity.lab.calibration.tracking import Observation

# kg m, logarithm, Nm, rad, rad, Nm/rad, 1/K, rad: a combination of unknowns that may be wrong by this much is not
# known.
NATURAL = (0.1, 0.3, 0.3, 0.3, 0.1, 0.1, 0.005, 0.1)


@dataclass(frozen=True, eq=False)
class FitLayout:
    """Where each of the unknowns of an arm stands."""

    moment: slice  #: kg m
    scale: slice  #: logarithms
    offset: slice  #: Nm
    angle: slice  #: rad
    tilt: slice  #: rad, the rotation vector of gravity in the base frame
    spring: slice  #: Nm/rad
    slope: slice  #: 1/K, of the torque scale over the motor's temperature
    turn: slice  #: rad, of the joints' places: about each joint's axis, its zero, and about two directions across it
    joints: int  #: how many the arm has
    natural: np.ndarray  #: `NATURAL` of each unknown, (count,)

    @property
    def moments(self) -> int:
        """How many the arm has."""
        return int(self.moment.stop)

    @property
    def count(self) -> int:
        """How many unknowns there are."""
        return int(self.turn.stop)

    @property
    def extras(self) -> tuple[int, ...]:
        """The unknowns that are 0 unless the poses ask for them."""
        return tuple(range(self.spring.start, self.slope.stop))

    def start(self, moments: np.ndarray) -> np.ndarray:
        """Return the unknowns (count,) with these moments, and nothing else."""
        return np.append(moments, np.zeros(self.count - self.moments))


def layout_of(model: MomentModel) -> FitLayout:
    """Return where the unknowns of an arm stand."""
    joints = model.count
    sizes = len(model.names), joints, joints, 2, 3, joints, joints, TURNS * joints
    ends = np.cumsum((0, *sizes)).tolist()
    moment, scale, offset, angle, tilt, spring, slope, turn = map(slice, ends[:-1], ends[1:])
    natural = np.repeat(NATURAL, sizes)
    return FitLayout(moment, scale, offset, angle, tilt, spring, slope, turn, joints, natural)


@dataclass(frozen=True)
class Fit:
    """The errors that the fit expects, and what it makes of larger ones."""

    least_spread: float = 0.003  #: Nm; about half a code of an AK motor's 12-bit torque
    beside_error: float = 0.05  #: rad, of a weight's place; 3 degrees
    #: rad about each axis, of gravity's measured direction: an IMU's mounting, mostly its heading
    tilt_error: float = 0.05
    zero_error: float = 0.015  #: rad, of an encoder's zero in a file: at most 1.5 degrees, over sqrt(3)
    #: rad, of a joint's axis in each direction across it: it is at most 1.5 degrees askew, as on printed and welded
    #: brackets, over sqrt(6)
    axis_error: float = 0.0107
    scale_error: float = 0.15  #: of a torque scale of which nothing is known; users report 0.75
    huber: float = 2.0  #: standard errors beyond which a residual's weight falls
    pooling: float = 2.0  #: degrees of freedom with which all joints together inform the error of each
    steps: int = 40  #: of Gauss-Newton, at most
    #: sum of squares that a pose causes, from which it is left out: of good poses, one in 500,000
    outlier: float = 32.0
    #: Nm, and this share of the peak effort: a smaller error does no harm, nor does a hand cause it
    least_outlier: float = 0.03
    share_of_peak: float = 0.01  #: of the effort, likewise
    slope_error: float = 0.001  #: 1/K: magnets lose 0.001 to 0.002, and the file's slope is corrected
    least_warming: float = 5.0  #: K between the coldest and the warmest pose, from which a slope can show
    hidden: float = 0.1  #: share of an unknown, in combinations that are not known, from which it is not known itself


FIT = Fit()


class Places(NamedTuple):
    """How exactly the places of an arm's joints are known before a tour, as standard errors in rad."""

    zero: float = FIT.zero_error  #: of the encoders' zeros
    axis: float = FIT.axis_error  #: of the axes, in each direction across them


MEDIAN_BELOW = 0.64  # by which the median of a sum of as many squares is below their number
MEDIAN_SQUARE = 0.455  # of a standard normal variable
DISTURBED = "Was it touched, does a joint slip or touch a stop?"
EXACT = 1e-6  # error of a value that is held


class Rows(NamedTuple):
    """What is fitted, for m poses of an arm with n joints and k moments."""

    along: np.ndarray  #: (m, n, k, 3) Nm per kg m, the torque with gravity along each axis of the base frame
    turned: np.ndarray  #: (m, n, k, 3, t) Nm per kg m and rad, its derivative by the turns that are fitted
    theta: np.ndarray  #: (m, n) rad
    warmth: np.ndarray  #: (m, n) K of the motors, beyond the mean of their poses; 0 where it is not known
    direction: np.ndarray  #: (m, 3), gravity's unit vector in the base frame, as measured
    load: np.ndarray  #: (m, k) kg m, moments of the weight
    beside: np.ndarray  #: (m, k, a) kg m per rad, how these moments change with the angles of a weight
    effort: np.ndarray  #: (m, n) Nm
    sigma: np.ndarray  #: (m, n) Nm, standard error of `effort`
    layout: FitLayout
    start: np.ndarray  #: (count,), the unknowns from which the search begins
    #: (c, count), linear combinations of the unknowns' change from `start` that are 0, divided by their standard errors
    anchor: np.ndarray

    def only(self, keep: np.ndarray) -> "Rows":
        """Return the poses that `keep` (m,) selects."""
        return Rows._make([*(column[keep] for column in self[:9]), *self[9:]])

    def holding(self, indices: Sequence[int]) -> "Rows":
        """Return the rows with these unknowns held at their start."""
        held = np.eye(self.layout.count)[list(indices)] / EXACT
        return self._replace(anchor=np.vstack((self.anchor, held)))

    def with_extras(self, free: Sequence[int]) -> "Rows":
        """Return the rows with all extras but the `free` ones held at 0."""
        return self.holding([index for index in self.layout.extras if index not in free])

    def predicted(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the commanded effort (m, n) in Nm."""
        _, torque, given = self._parts(unknowns)
        return np.asarray(torque * given + unknowns[self.layout.offset])

    def jacobian(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the derivative of `predicted` by the unknowns, (m, n, count)."""
        at, (rows, torque, given) = self.layout, self._parts(unknowns)
        own = np.eye(at.joints)[None]  # what belongs to a joint changes that joint's effort alone
        effort = torque * given
        angles, moments = rows @ self.beside, self._moments(unknowns)
        turns = np.einsum("mi,ita->mta", self.direction, TURN)
        tilted = np.einsum("mnka,mta,mk->mnt", self.along, turns, moments, optimize=True)
        by_turns = np.einsum("mnkat,ma,mk->mnt", self.turned, self.direction, moments, optimize=True)
        warming = self.warmth / (1.0 + unknowns[at.slope] * self.warmth)
        parts = (
            rows * given[..., None],
            -own * effort[..., None],
            np.broadcast_to(own, (len(effort), at.joints, at.joints)),
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


class Solution(NamedTuple):
    """The fit of `Rows`."""

    unknowns: np.ndarray  #: (count,)
    covariance: np.ndarray  #: (count, count) of what is known
    hidden: np.ndarray  #: (count,), share 0..1 of each unknown that is not known
    singular_values: np.ndarray  #: of the poses alone, in units of `NATURAL`, the largest first
    residual: np.ndarray  #: (m, n) Nm
    left: np.ndarray  #: (m, n), part of each residual's variance that the fit leaves, 0..1
    freedom: np.ndarray  #: (n,), degrees of freedom of each joint's residuals
    hat: np.ndarray  #: (m, n, m, n), derivative of the predicted by the measured effort, both divided by sigma


def rows_of(observations: Sequence[Observation], model: MomentModel, places: Places) -> Rows:
    """Return the observations of an arm as arrays, with what is held. Raises DataError that names the observation."""
    if not observations:
        raise DataError("no pose was observed")
    theta, direction, effort, spread = found = columns(observations)
    for name, values in zip(("theta", "direction", "effort", "spread"), found, strict=True):
        for index in np.flatnonzero(~np.isfinite(values).all(axis=1))[:1]:
            raise DataError(f"pose {index + 1}: {name} = {values[index].tolist()}: must be finite numbers")
    at = layout_of(model)
    weights = [(one.load_mass, one.load_lever) for one in observations]
    load, beside = (np.array([of(*weight) for weight in weights]) for of in (model.load, model.load_beside))
    unit = np.eye(at.count)
    # Without a weight a common factor of scales and moments does not show.
    product = unit[at.scale][model.compared].sum(axis=0, keepdims=True) * (not np.any(load))
    tilt = unit[at.tilt] / (FIT.tilt_error if model.shows_tilt else EXACT)
    scales = unit[at.scale] / FIT.scale_error if model.is_described else unit[:0]
    turned_by = np.resize((places.zero, places.axis, places.axis), TURNS * model.count)
    if model.shows_tilt:
        turned_by[:TURNS] = 0.0  # the whole arm turns with its first joint, which is the same as gravity turned
    turns = unit[at.turn] / np.maximum(turned_by, EXACT)[:, None]
    slopes = unit[at.slope] / FIT.slope_error
    anchor = np.vstack((unit[at.angle] / FIT.beside_error, tilt, scales, slopes, turns, product / EXACT))
    along, sigma = model.along_axes(theta), np.hypot(spread, FIT.least_spread)
    turned = model.turned(theta)
    temperature = temperatures(observations)
    warmth = np.nan_to_num(temperature - temperature.mean(axis=0))
    start = at.start(model.moments)
    return Rows(along, turned, theta, warmth, direction, load, beside, effort, sigma, at, start, anchor)


def unmeasured(model: MomentModel, theta: np.ndarray, direction: np.ndarray, start: np.ndarray) -> Rows:
    """Return rows without efforts, weights, and effect of the turns.

    theta: (m, n) rad. direction: (m, 3). start: (count,).
    """
    at, along, none = layout_of(model), model.along_axes(theta), np.zeros_like(theta)
    turned, load = np.zeros((*along.shape, TURNS * model.count)), np.zeros((len(theta), at.moments))
    beside = np.zeros((*load.shape, 2))
    return Rows(along, turned, theta, none, direction, load, beside, none, none, at, start, np.zeros((0, at.count)))


def temperatures(observations: Sequence[Observation]) -> np.ndarray:
    """Return the motors' temperatures (m, n) in degC, NaN where one is not known."""
    unknown = np.full(len(observations[0].theta), np.nan)
    given = [one.temperature if len(one.temperature) else unknown for one in observations]
    return np.array(given, dtype=float)


def columns(observations: Sequence[Observation]) -> list[np.ndarray]:
    """Return theta (m, n) rad, direction (m, 3), effort and spread (m, n) Nm of the observations."""
    return [np.array([one[i] for one in observations], dtype=float) for i in (0, 1, 2, 4)]


def solve(rows: Rows, start: np.ndarray | None = None, weight: np.ndarray | float = 1.0) -> Solution:
    """Return the least-squares solution from `start` (count,); weight: (m, n) of the squared residuals."""
    at, natural = rows.layout, rows.layout.natural
    root = np.sqrt(weight) / rows.sigma
    unknowns = rows.start if start is None else start
    for _ in range(FIT.steps):
        poses = (rows.jacobian(unknowns) * root[..., None]).reshape(-1, at.count)
        whitened = np.vstack((poses, rows.anchor))
        left, size, right = np.linalg.svd(whitened * natural, full_matrices=False)
        known = size > 1.0
        inverse = natural[:, None] * (right[known].T / size[known]) @ left[:, known].T
        residual = rows.effort - rows.predicted(unknowns)
        step = inverse @ np.append(root * residual, -rows.anchor @ (unknowns - rows.start))
        if np.all(np.abs(step) < 1e-9 * natural):
            break
        # Beyond a factor of 1.6 of a scale, or 0.2 rad of a turn, in one step the linear model does not reach.
        turn = float(np.abs(np.append(step[at.tilt], step[at.turn])).max())
        unknowns = unknowns + step / max(1.0, 2.0 * float(np.abs(step[at.scale]).max()), 5.0 * turn)
    # A turn that is fitted may seem to show what the poses as measured do not: M1, of a joint whose axis is vertical.
    measured = unknowns.copy()
    measured[at.tilt], measured[at.turn] = 0.0, 0.0
    shown = np.vstack(((rows.jacobian(measured) * root[..., None]).reshape(-1, at.count), rows.anchor)) * natural
    _, share, ways = np.linalg.svd(shown, full_matrices=False)
    hidden = 1.0 - np.square(ways[share > 1.0]).sum(axis=0)
    size = np.linalg.svd((poses * natural)[:, : at.angle.start], compute_uv=False)
    singular_values = np.pad(size, (0, at.angle.start - len(size)))
    hat = (poses @ inverse[:, : residual.size]).reshape(2 * residual.shape)
    left_over = 1.0 - np.einsum("njnj->nj", hat)
    freedom = np.maximum(left_over.sum(axis=0), 0.0)
    covariance = inverse @ inverse.T
    return Solution(unknowns, covariance, hidden, singular_values, residual, left_over, freedom, hat)


def robust(rows: Rows) -> tuple[Rows, Solution]:
    """Return a solution that gives large residuals little weight, and the rows with at least the error they state."""
    solution = solve(rows)
    for _ in range(4):
        squares = (solution.residual / rows.sigma) ** 2
        squares /= np.maximum(0.2, solution.left)
        factor = np.maximum(1.0, _pooled(np.median(squares, axis=0) / MEDIAN_SQUARE, solution.freedom))
        size = np.sqrt(squares / factor)
        solution = solve(rows, solution.unknowns, np.minimum(1.0, FIT.huber / np.maximum(size, 1e-9)))
    return rows._replace(sigma=rows.sigma * np.sqrt(factor)), solution


def final(rows: Rows) -> tuple[Rows, Solution]:
    """Return the plain least-squares solution, and the rows with the error that its residuals show."""
    scaled, solution = rows, solve(rows)
    for _ in range(3):
        squares = ((solution.residual / rows.sigma) ** 2).sum(axis=0)
        factor = _pooled(squares / np.maximum(solution.freedom, 1e-9), solution.freedom)
        scaled = rows._replace(sigma=rows.sigma * np.sqrt(factor))
        solution = solve(scaled, solution.unknowns)
    return scaled, solution


def bounded(rows: Rows, positive: Sequence[int]) -> tuple[Rows, Solution]:
    """Return the solution, and the rows with their estimated errors.

    positive: numbers of moments that are at least 0, because the least certain of them may come out below.
    """
    used, solution = final(rows)
    for index in positive:
        if solution.unknowns[index] < 0.0 and solution.hidden[index] <= FIT.hidden:
            error = solution.covariance[index, index]
            at_0 = np.where(np.arange(len(rows.start)) == index, 0.0, rows.start)
            used, solution = final(rows._replace(start=at_0).holding([index]))
            solution.unknowns[index], solution.covariance[index, index] = 0.0, error
    return used, solution


def asked_for(rows: Rows, among: Sequence[int], fit: Callable[[Rows], tuple[Rows, Solution]]) -> tuple[int, ...]:
    """Return which of the extras `among` are fitted: all slopes, and the springs that the poses ask for.

    As `fit` (`robust` or `final`) judges them, backwards: the spring that explains least goes, until each one lowers
    the sum of squares by more than ln of the number of efforts (G. Schwarz, Ann. Statist. 6, 1978). A spring that would
    push is none. None stays that hides another unknown.
    """
    at = rows.layout
    springs, slopes = [n for n in among if n < at.spring.stop], [n for n in among if n >= at.slope.start]
    penalty = math.log(rows.effort.size)
    is_shown = fit(rows.with_extras(slopes))[1].hidden <= FIT.hidden if springs else np.ones(at.count, dtype=bool)
    while springs:
        solution = fit(rows.with_extras(springs + slopes))[1]
        value, variance = solution.unknowns[springs], np.diag(solution.covariance)[springs]
        is_none = (value < 0.0) | (solution.hidden[springs] > FIT.hidden)
        gain = np.where(is_none, 0.0, value**2 / np.maximum(variance, 1e-30))
        least = int(np.argmin(gain))
        if gain[least] > penalty and not np.any(is_shown & (solution.hidden > FIT.hidden)):
            break
        del springs[least]
    return (*springs, *slopes)


def possible_extras(rows: Rows) -> tuple[int, ...]:
    """Return the extras that the poses can show at all."""
    warms = np.ptp(rows.warmth, axis=0) >= FIT.least_warming
    spring, slope = rows.layout.spring, rows.layout.slope
    slopes = [index for index, is_warm in zip(range(slope.start, slope.stop), warms.tolist(), strict=True) if is_warm]
    return (*range(spring.start, spring.stop), *slopes)


def _pooled(factor: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Return each joint's factor (n,) of the variance, moved towards that of all joints where its data are few."""
    total = freedom.sum()
    common = float(factor @ freedom) / total if total > 1.0 else 1.0
    pooled = (factor * freedom + FIT.pooling * common) / (freedom + FIT.pooling)
    return np.asarray(np.maximum(pooled, 1e-4))


def without_each_pose(solution: Solution, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each pose, what leaving it out shows.

    The residual (m, n) in Nm of a prediction from the other poses, NaN where they do not suffice; and the part (m,) of
    the sum of squares that this pose causes, about as many as joints for a pose with usual errors.
    """
    whitened = solution.residual / sigma
    held_out, caused = np.full_like(whitened, np.nan), np.zeros(len(whitened))
    for i, residual in enumerate(whitened):
        left = np.eye(len(residual)) - solution.hat[i, :, i, :]
        if np.linalg.eigvalsh((left + left.T) / 2.0)[0] > 1e-6:
            held_out[i] = np.linalg.solve(left, residual)
            caused[i] = residual @ held_out[i]
    return held_out * sigma, caused


def without_outliers(rows: Rows) -> tuple[np.ndarray, tuple[tuple[int, str], ...]]:
    """Return which poses (m,) fit one arm, and index and reason of each that does not.

    Raises DataError if more than a third does not fit.
    """
    keep = np.ones(len(rows.effort), dtype=bool)
    rejected: list[tuple[int, str]] = []
    least = np.maximum(FIT.least_outlier, FIT.share_of_peak * np.abs(rows.effort).max(axis=0))
    while True:
        used, solution = robust(rows.only(keep))
        held_out, caused = without_each_pose(solution, used.sigma)
        matters = np.nanmax(np.abs(held_out) / least, axis=1, initial=0.0) > 1.0
        worst = int(np.argmax(caused * matters))
        usual = rows.layout.joints - MEDIAN_BELOW
        if not matters[worst] or caused[worst] < FIT.outlier * max(1.0, float(np.median(caused)) / usual):
            return keep, tuple(rejected)
        joint = int(np.argmax(np.abs(held_out[worst] / used.sigma[worst])))
        index = int(np.flatnonzero(keep)[worst])
        off = f"effort of joint {joint + 1} is {held_out[worst, joint]:+.2f} Nm off what the other poses predict"
        rejected.append((index, off))
        keep[index] = False
        if len(rejected) > len(keep) // 3:
            reasons = "; ".join(f"pose {index + 1}: {why}" for index, why in rejected)
            raise DataError(f"the poses do not fit one arm: {reasons}. {DISTURBED}")
