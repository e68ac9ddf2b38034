"""Hybrid learning of an ANFIS that converges: variable projection with SciPy's least squares.

In each epoch, Jang's hybrid learning solves the consequents by least squares and moves the premises down the gradient.
Variable projection completes this split: the consequents are a function of the premises (the least-squares solution),
so the error depends on the premises alone, and a trust-region method minimises it (Golub and Pereyra 1973; Jacobian
after Kaufman 1975). 100 evaluations achieve what thousands of epochs do not.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.progress import Progress
from scipy.linalg import qr, solve_triangular
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from exo_gravity.core.errors import DataError
from exo_gravity.core.model.anfis import JOINTS, Anfis, AnfisLaw, grades, scaled
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.tools.anfis.samples import Samples

RIDGE = 1e-6  # keeps consequents that the data do not determine near 0; noisy data need more
# In units of half the training box. Narrow functions overfit the sampled positions: at a width of 0.4 the held-out
# error is up to ten times that at 0.8.
NARROWEST, WIDEST = 0.8, 4.0
FARTHEST = 2.0  # largest distance of a centre from the middle of the box, in the same units

MAX_EVALUATIONS = 100

OnEvaluation = Callable[[int, float], None]  # (number of the evaluation, RMSE)


@dataclass(frozen=True, eq=False)
class Trained:
    """A model of one output, trained."""

    model: Anfis
    #: On the training data, in the output's unit.
    rmse: float
    #: Of the premises.
    evaluations: int
    #: Training time in s.
    seconds: float


class Projection:
    """The residual as a function of the premises alone: all centres, then the logarithms of all widths."""

    def __init__(
        self, inputs: np.ndarray, output: np.ndarray, functions: int, ridge: float, on_evaluation: OnEvaluation
    ) -> None:
        self.inputs, self.functions, self.ridge = inputs, functions, ridge
        self.extended = np.column_stack((np.ones(len(inputs)), inputs))
        consequents = functions ** inputs.shape[1] * self.extended.shape[1]
        self.target = np.concatenate((output, np.zeros(consequents)))
        self.evaluations = 0
        self.on_evaluation = on_evaluation
        self._solved: np.ndarray | None = None  # the premises that the attributes below belong to
        self._residual = self.target

    def residual(self, premises: np.ndarray) -> np.ndarray:
        """Return the residual of the samples, then of the ridge."""
        self._solve(premises)
        return self._residual

    def jacobian(self, premises: np.ndarray) -> np.ndarray:
        """Return Kaufman's Jacobian: the derivative at fixed consequents, minus what the consequents compensate for."""
        self._solve(premises)
        derivative = self._derivative()
        projected = np.zeros((len(self.target), derivative.shape[1]))
        projected[: len(derivative)] = derivative
        projected -= self._basis @ (self._basis[: len(derivative)].T @ derivative)
        return np.asarray(-projected)

    def model(self, premises: np.ndarray) -> Anfis:
        """Return the model with these premises and their consequents."""
        self._solve(premises)
        return Anfis(self._centre, self._sigma, self._consequent[None])

    def _solve(self, premises: np.ndarray) -> None:
        """Solve the consequents for these premises, unless the last call did."""
        if self._solved is not None and np.array_equal(premises, self._solved):
            return
        centre, width = premises.reshape(2, 1, self.inputs.shape[1], self.functions)
        self._centre, self._sigma = centre, np.exp(width)
        self._share = grades(self._centre, self._sigma, self.inputs)[0]  # (n, d, k)
        strength = self._share[:, 0]
        for axis in range(1, self.inputs.shape[1]):
            strength = (strength[:, :, None] * self._share[:, axis, None, :]).reshape(len(strength), -1)
        design = (strength[:, :, None] * self.extended[:, None, :]).reshape(len(strength), -1)
        # The ridge as extra rows keeps full rank: no pivoting, and no squared condition number.
        self._basis, triangle = qr(
            np.vstack((design, self.ridge * np.eye(design.shape[1]))), mode="economic", check_finite=False
        )
        in_basis = self._basis.T @ self.target
        self._residual = self.target - self._basis @ in_basis
        self._consequent = solve_triangular(triangle, in_basis).reshape(-1, self.extended.shape[1])
        self._solved = premises.copy()
        self.evaluations += 1
        samples = self._residual[: len(self.inputs)]
        self.on_evaluation(self.evaluations, float(np.sqrt(np.mean(samples**2))))

    def _derivative(self) -> np.ndarray:
        """Return d output / d premises (n, 2 d k) at fixed consequents.

        With e = -((u - centre) / sigma)^2 / 2 the grades are a softmax: d output / d e_q = grade_q (G_q - output),
        where G_q is the output of the rules with function q alone.
        """
        count, dimension, functions = self._share.shape
        rule = (self.extended @ self._consequent.T).reshape(count, *(functions,) * dimension)
        distance = (self.inputs[:, :, None] - self._centre) / self._sigma
        by_centre, by_width = np.empty((2, count, dimension, functions))
        for axis in range(dimension):
            alone = np.moveaxis(rule, axis + 1, 1)
            for other in reversed([i for i in range(dimension) if i != axis]):
                share = self._share[:, other].reshape(count, *(1,) * (alone.ndim - 2), functions)
                alone = (alone * share).sum(axis=-1)
            share = self._share[:, axis]
            by_exponent = share * (alone - (share * alone).sum(axis=1, keepdims=True))
            by_centre[:, axis] = by_exponent * distance[:, axis] / self._sigma[0, axis]
            by_width[:, axis] = by_exponent * distance[:, axis] ** 2
        return np.hstack((by_centre.reshape(count, -1), by_width.reshape(count, -1)))


def train(
    inputs: np.ndarray,
    output: np.ndarray,
    functions: int = 4,
    *,
    ridge: float = RIDGE,
    max_evaluations: int = MAX_EVALUATIONS,
    on_evaluation: OnEvaluation = lambda evaluation, rmse: None,
) -> Trained:
    """Return an ANFIS of `functions` Gaussians per input, trained on inputs (n, d) in -1..1 and output (n,).

    on_evaluation(evaluation, RMSE) is called after each evaluation of the premises. Raises DataError if there are fewer
    samples than consequents.
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
    problem = Projection(inputs, output, functions, ridge, on_evaluation)
    found = least_squares(
        problem.residual, start, problem.jacobian, (low, high), max_nfev=max_evaluations, ftol=1e-4, xtol=1e-8
    )
    model = problem.model(found.x)
    rmse = float(np.sqrt(np.mean((model.output(inputs)[:, 0] - output) ** 2)))
    return Trained(model, rmse, problem.evaluations, time.perf_counter() - started)


def train_law(
    samples: Samples, arm: ArmModel, functions: int = 4, ridge: float = RIDGE
) -> tuple[AnfisLaw, list[Trained]]:
    """Return the law for `arm` trained on `samples`, and the training results of joints 2, 3 and 4."""
    inputs = scaled(samples.angle, samples.low, samples.high)
    results = []
    for joint, torque in zip(JOINTS, samples.torque.T, strict=True):
        with Progress(console=Console(stderr=True), transient=True) as progress:
            show = _progress_line(progress, joint)
            # Threads gain nothing on matrices this small, and wait for each other on busy cores: 73 s instead of 2 s.
            with threadpool_limits(1):
                results.append(
                    train(inputs, torque, functions, ridge=ridge, max_evaluations=MAX_EVALUATIONS, on_evaluation=show)
                )
    parts = (np.concatenate([getattr(r.model, part) for r in results]) for part in ("centre", "sigma", "consequent"))
    model = Anfis(*parts)
    held_out = model.output(scaled(samples.held_out_angle, samples.low, samples.high)) - samples.held_out_torque
    error = {
        "training": [result.rmse for result in results],
        "held_out": np.sqrt(np.mean(held_out**2, axis=0)).tolist(),
    }
    box = tuple(samples.low.tolist()), tuple(samples.high.tolist())
    return AnfisLaw(model, *box, arm.first_moment[1:], arm.gravity, samples.source, error), results


def _progress_line(progress: Progress, joint: str) -> OnEvaluation:
    task = progress.add_task("", total=MAX_EVALUATIONS)

    def show(evaluation: int, rmse: float) -> None:
        progress.update(task, completed=evaluation, description=f"training joint {joint}: RMSE {rmse:.2e} Nm")

    return show
