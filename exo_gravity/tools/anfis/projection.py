"""Variable projection: the error of an ANFIS as a function of its premises alone, with its Jacobian.

The consequents are the least-squares solution for given premises (Golub and Pereyra 1973). The Jacobian is Kaufman's
(1975).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import qr, solve_triangular

from exo_gravity.core.model.anfis import Anfis, grades

OnEvaluation = Callable[[int, float], None]  # (number of the evaluation, RMSE)


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
