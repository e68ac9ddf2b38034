# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An ANFIS of joints 2 to 4 of an upright arm: the samples it is trained on, and a hybrid learning that converges.

Samples are torques in Nm at gain 1, not scaled. A measured torque lacks what stiction carries: approach each pose from
both sides.

In each epoch, Jang's hybrid learning solves the consequents by least squares and moves the premises down the gradient.
Variable projection completes this split: the consequents are a function of the premises (the least-squares solution),
so the error depends on the premises alone, and a trust-region method minimises it (Golub and Pereyra 1973; Jacobian
after Kaufman 1975). 100 evaluations achieve what thousands of epochs do not.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.lab.anfis import INPUTS, UPRIGHT, Anfis, AnfisLaw, grades, scaled
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.calibration.recorded import recording_of, tilts_of
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.lab.inputs.references import gravload
from exo_gravity.lab.trial.analysis import analyse

GRID = (13, 9, 9)  # positions of joints 2, 3, 4: 1,053 as in the paper
HELD_OUT = 5  # every fifth hold
RIDGE = 1e-6  # keeps consequents that the data do not determine near 0; noisy data need more
# In units of half the training box. Narrow functions overfit the sampled positions: at a width of 0.4 the held-out
# error is up to ten times that at 0.8.
NARROWEST, WIDEST = 0.8, 4.0
FARTHEST = 2.0  # largest distance of a centre from the middle of the box, in the same units
MAX_EVALUATIONS = 100


@dataclass(frozen=True, eq=False)
class Samples:
    """Training and held-out samples of joints 2 to 4."""

    angle: np.ndarray  #: (n, 3) rad in the box low..high
    torque: np.ndarray  #: (n, 3) Nm
    held_out_angle: np.ndarray
    held_out_torque: np.ndarray
    low: np.ndarray  #: (3,) rad
    high: np.ndarray
    source: str  #: what the samples are from, in words


def axes_of(configured: ConfiguredArm, counts: Sequence[int]) -> list[np.ndarray]:
    """Return `counts` (3,) angles in rad of joints 2 to 4, evenly spaced from one limit of the joint to the other."""
    box = zip(configured.low[1:], configured.high[1:], counts, strict=True)
    return [np.linspace(low, high, count) for low, high, count in box]


def from_gravload(configured: ConfiguredArm) -> Samples:
    """Return the upright arm's torques by the Robotics Toolbox at the paper's positions, and half-way between them."""
    axes = axes_of(configured, GRID)
    reference = gravload(replace(configured.paper_arm, gain=np.ones(4)))
    middles = [(axis[1:] + axis[:-1]) / 2 for axis in axes]
    theta, between = (np.array(list(product((0.0,), *angles))) for angles in (axes, middles))
    torque, torque_between = (reference(at, np.tile((0.0, 0.0, 1.0), (len(at), 1)))[:, 1:] for at in (theta, between))
    box, source = (configured.low[1:], configured.high[1:]), f"gravload of the Robotics Toolbox, {len(theta)} positions"
    return Samples(theta[:, 1:], torque, between[:, 1:], torque_between, *box, source)


def from_bag(path: str | Path, configured: ConfiguredArm, functions: int) -> Samples:
    """Return the mean measured torque of each hold of a rosbag2 with an upright trunk; every fifth is held out.

    The box spans the held poses within the joint limits. Raises DataError, one sentence, if they are too few for
    `functions` membership functions per input.
    """
    bag = read_bag(path)
    recording = recording_of(bag, configured)
    tilts = zip(bag.tilt[:, 0].tolist(), tilts_of(bag, configured.side), strict=True)
    tilted = np.array([now for now, tilt in tilts if not tilt.axis_angle <= UPRIGHT])
    holds = [h for h in analyse(recording).holds if not np.any((tilted >= h.start) & (tilted <= h.end))]
    spans = [(recording.time >= hold.start) & (recording.time <= hold.end) for hold in holds]
    angle = np.reshape([hold.pose for hold in holds], (-1, JOINT_COUNT))
    torque = np.reshape([recording.effort[span].mean(axis=0) for span in spans], (-1, JOINT_COUNT))
    kept = np.all(np.isfinite(torque) & (angle >= configured.low) & (angle <= configured.high), axis=1)
    angle, torque = angle[kept, 1:], torque[kept, 1:]
    checked = np.arange(len(angle)) % HELD_OUT == HELD_OUT - 1
    if len(angle) < HELD_OUT:
        raise DataError(f"{path}: {len(angle)} holds with an upright trunk: must be at least {HELD_OUT}")
    low, high = angle.min(axis=0), angle.max(axis=0)
    _check_coverage(scaled(angle[~checked], low, high), functions)
    source = f"recording {Path(path).name}, {len(angle)} holds"
    return Samples(angle[~checked], torque[~checked], angle[checked], torque[checked], low, high, source)


def _check_coverage(inputs: np.ndarray, functions: int) -> None:
    """Raise DataError if a cell of the grid partition has no sample to determine its rule."""
    cell = np.minimum(((inputs + 1) / 2 * functions).astype(int), functions - 1)
    empty = sorted(set(product(range(functions), repeat=len(INPUTS))) - set(map(tuple, cell.tolist())))
    if empty:
        where = ", ".join(f"{name} {part + 1}/{functions}" for name, part in zip(INPUTS, empty[0], strict=True))
        raise DataError(
            f"{len(empty)} of the {functions ** len(INPUTS)} cells of the box that the poses span have no hold "
            f"(the first: {where}): record holds there"
        )


@dataclass(frozen=True, eq=False)
class Trained:
    """A model of one output, trained."""

    model: Anfis
    rmse: float  #: on the training data, in the output's unit
    evaluations: int  #: of the premises
    seconds: float  #: training time


class Projection:
    """The residual as a function of the premises alone: all centres, then the logarithms of all widths."""

    def __init__(self, inputs: np.ndarray, output: np.ndarray, functions: int, ridge: float) -> None:
        self.inputs, self.functions = inputs, functions
        self.extended = np.column_stack((np.ones(len(inputs)), inputs))
        consequents = functions ** inputs.shape[1] * self.extended.shape[1]
        # The ridge as extra rows keeps full rank: no pivoting, and no squared condition number.
        self.ridge = ridge * np.eye(consequents)
        self.target = np.concatenate((output, np.zeros(consequents)))
        self._solved: np.ndarray | None = None  # the premises that the attributes set by `_solve` belong to

    def residual(self, premises: np.ndarray) -> np.ndarray:
        """Return the residual of the samples, then of the ridge."""
        self._solve(premises)
        return self._residual

    def jacobian(self, premises: np.ndarray) -> np.ndarray:
        """Return Kaufman's Jacobian: the derivative at fixed consequents, minus what the consequents compensate for.

        With e = -((u - centre) / sigma)^2 / 2 the grades are a softmax: d output / d e_q is the sum of
        strength (f - output) over the rules with function q.
        """
        self._solve(premises)
        count, dimension = self.inputs.shape
        rule = self.extended @ self._consequent.T
        output = (self._strength * rule).sum(axis=1, keepdims=True)
        excess = (self._strength * (rule - output)).reshape(count, *(self.functions,) * dimension)
        axes = range(1, dimension + 1)
        by_exponent = np.stack([excess.sum(axis=tuple(a for a in axes if a != axis)) for axis in axes], axis=1)
        distance = (self.inputs[:, :, None] - self._centre) / self._sigma
        parts = by_exponent * distance / self._sigma, by_exponent * distance**2
        derivative = np.hstack([part.reshape(count, -1) for part in parts])
        jacobian = self._basis @ (self._basis[:count].T @ derivative)
        jacobian[:count] -= derivative
        return np.asarray(jacobian)

    def model(self, premises: np.ndarray) -> Anfis:
        """Return the model with these premises and their consequents."""
        self._solve(premises)
        return Anfis(self._centre, self._sigma, self._consequent[None])

    def _solve(self, premises: np.ndarray) -> None:
        """Solve the consequents for these premises, unless the last call did."""
        if self._solved is not None and np.array_equal(premises, self._solved):
            return
        count, dimension = self.inputs.shape
        self._centre, width = premises.reshape(2, 1, dimension, self.functions)
        self._sigma = np.exp(width)
        share = grades(self._centre, self._sigma, self.inputs)[0]  # (n, d, k)
        strength = share[:, 0]
        for axis in range(1, dimension):
            strength = (strength[:, :, None] * share[:, axis, None, :]).reshape(count, -1)
        self._strength = strength
        design = (strength[:, :, None] * self.extended[:, None, :]).reshape(count, -1)
        self._basis, triangle = qr(np.vstack((design, self.ridge)), mode="economic", check_finite=False)
        in_basis = self._basis.T @ self.target
        self._residual = self.target - self._basis @ in_basis
        self._consequent = solve_triangular(triangle, in_basis).reshape(-1, self.extended.shape[1])
        self._solved = premises.copy()


def train(
    inputs: np.ndarray, output: np.ndarray, functions: int = 4, ridge: float = RIDGE, most: int = MAX_EVALUATIONS
) -> Trained:
    """Return an ANFIS of `functions` Gaussians per input, trained on inputs (n, d) in -1..1 and output (n,).

    most: evaluations of the premises.

    Raises DataError if there are fewer samples than consequents.
    """
    dimension = inputs.shape[1]
    consequents = functions**dimension * (dimension + 1)
    if len(inputs) < consequents:
        raise DataError(f"{len(inputs)} samples: must be at least {consequents}, the number of consequents")
    started = time.perf_counter()
    count = dimension * functions
    low = np.repeat((-FARTHEST, np.log(NARROWEST)), count)
    high = np.repeat((FARTHEST, np.log(WIDEST)), count)
    centre = np.tile(np.linspace(-1.0, 1.0, functions), dimension)
    start = np.concatenate((centre, np.full(count, np.log(1.05 * NARROWEST))))
    problem = Projection(inputs, output, functions, ridge)
    found = least_squares(problem.residual, start, problem.jacobian, (low, high), max_nfev=most, ftol=1e-4, xtol=1e-8)
    model = problem.model(found.x)
    return Trained(model, float(rms(model.output(inputs)[:, 0] - output)), found.nfev, time.perf_counter() - started)


def train_law(
    samples: Samples, arm: ArmModel, functions: int = 4, ridge: float = RIDGE
) -> tuple[AnfisLaw, list[Trained]]:
    """Return the law for `arm` trained on `samples`, and the training results of joints 2, 3 and 4."""
    inputs = scaled(samples.angle, samples.low, samples.high)
    # Threads gain nothing on matrices this small, and wait for each other on busy cores: 73 s instead of 2 s.
    with threadpool_limits(1):
        results = [train(inputs, torque, functions, ridge) for torque in samples.torque.T]
    parts = (np.concatenate([getattr(r.model, part) for r in results]) for part in ("centre", "sigma", "consequent"))
    model = Anfis(*parts)
    held_out = model.output(scaled(samples.held_out_angle, samples.low, samples.high)) - samples.held_out_torque
    error = {"training": [result.rmse for result in results], "held_out": rms(held_out).tolist()}
    box = tuple(samples.low.tolist()), tuple(samples.high.tolist())
    return AnfisLaw(model, *box, arm.first_moment[1:], arm.gravity, samples.source, error), results


def rms(values: np.ndarray) -> np.ndarray:
    """Return the root mean square of each column."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))
