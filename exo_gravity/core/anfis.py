"""ANFIS: an adaptive-network-based fuzzy inference system, first-order Takagi-Sugeno on a grid partition.

Jang, IEEE Transactions on Systems, Man, and Cybernetics 23 (1993) 665-685. Each of d inputs has k membership functions,
here Gaussians: mu = exp(-((u - centre) / sigma)^2 / 2). Each of the k^d combinations of them is a rule: its firing
strength w is the product of its memberships, its consequent is f = p_0 + p_1 u_1 + ... + p_d u_d, and the output is
sum(w f) / sum(w). On a grid partition sum(w) is the product of the inputs' own sums, so each input is normalised by
itself, and the sum over rules is taken one input after the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from exo_gravity.core.errors import DataError

MAX_RULES = 10_000  # 6 inputs of 4 functions have 4,096; more is a slip, and would fill the memory


@dataclass(frozen=True, eq=False)
class Anfis:
    """m models of one output each, on the same d inputs, with k membership functions per input.

    centre, sigma: (m, d, k), the premises, in units of the inputs; sigma > 0.
    consequent: (m, k^d, d + 1), p_0..p_d of each rule; the function of the last input changes fastest.
    Raises DataError unless the shapes agree and every number is finite.
    """

    centre: np.ndarray
    sigma: np.ndarray
    consequent: np.ndarray

    def __post_init__(self):
        for name in self.__dataclass_fields__:
            try:
                array = np.array(getattr(self, name), dtype=float)
            except (TypeError, ValueError):
                raise DataError(f"ANFIS: {name} must be a full array of numbers") from None
            if array.ndim != 3 or not np.all(np.isfinite(array)):
                raise DataError(f"ANFIS: {name} of shape {array.shape}: must have 3 axes and finite numbers")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        models, inputs, functions = self.centre.shape
        rules = functions**inputs
        if not 0 < rules <= MAX_RULES:
            raise DataError(f"ANFIS: {inputs} inputs of {functions} functions: must be 1 to {MAX_RULES} rules")
        for name, expected in (("sigma", self.centre.shape), ("consequent", (models, rules, inputs + 1))):
            if getattr(self, name).shape != expected:
                raise DataError(f"ANFIS: {name} of shape {getattr(self, name).shape}: must be {expected}")
        if np.any(self.sigma <= 0):
            raise DataError(f"ANFIS: sigma = {self.sigma.min():g}: must be greater than 0")

    @property
    def rules(self) -> int:
        """Rules per model."""
        return self.consequent.shape[1]

    @property
    def parameters(self) -> int:
        """Numbers per model: premises and consequents."""
        return sum(a[0].size for a in (self.centre, self.sigma, self.consequent))

    def output(self, inputs: np.ndarray) -> np.ndarray:
        """Return the outputs (n, m) for inputs (n, d)."""
        value = inputs @ self.consequent[:, :, 1:].transpose(0, 2, 1) + self.consequent[:, None, :, 0]  # f, (m, n, k^d)
        share = grades(self.centre, self.sigma, inputs)
        models, count, dimension, functions = share.shape
        for axis in reversed(range(dimension)):
            value = value.reshape(models, count, -1, functions) @ share[:, :, axis, :, None]
            value = value[..., 0]
        return value[..., 0].T


def grades(centre: np.ndarray, sigma: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Return the normalised memberships (m, n, d, k) of inputs (n, d): over k they sum to 1.

    centre, sigma: (m, d, k). They are taken relative to the largest, so that far from all centres none is 0 / 0.
    """
    exponent = -0.5 * np.square((inputs[:, :, None] - centre[:, None]) / sigma[:, None])
    share = np.exp(exponent - exponent.max(axis=-1, keepdims=True))
    return share / share.sum(axis=-1, keepdims=True)
