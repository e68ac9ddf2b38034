"""Hybrid learning of an ANFIS that converges: variable projection with SciPy's least squares.

In each epoch, Jang's hybrid learning solves the consequents by least squares and moves the premises down the gradient.
Variable projection completes this split: the consequents are a function of the premises (the least-squares solution),
so the error depends on the premises alone, and a trust-region method minimises it (Golub and Pereyra 1973; Jacobian
after Kaufman 1975). 100 evaluations achieve what thousands of epochs do not.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.progress import Progress
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from exo_gravity.core.errors import DataError
from exo_gravity.core.model.anfis import JOINTS, Anfis, AnfisLaw, scaled
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.tools.anfis.data import Samples
from exo_gravity.tools.anfis.projection import OnEvaluation, Projection

RIDGE = 1e-6  # keeps consequents that the data do not determine near 0; noisy data need more
# In units of half the training box. Narrow functions overfit the sampled positions: at a width of 0.4 the held-out
# error is up to ten times that at 0.8.
NARROWEST, WIDEST = 0.8, 4.0
FARTHEST = 2.0  # largest distance of a centre from the middle of the box, in the same units

MAX_EVALUATIONS = 100


@dataclass(frozen=True, eq=False)
class Trained:
    """A model of one output: its RMSE on the training data, evaluations of the premises, and training time in s."""

    model: Anfis
    rmse: float
    evaluations: int
    seconds: float


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
