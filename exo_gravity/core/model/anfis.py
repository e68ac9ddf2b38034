"""ANFIS: an adaptive-network-based fuzzy inference system, first-order Takagi-Sugeno on a grid partition.

Jang, IEEE Transactions on Systems, Man, and Cybernetics 23 (1993) 665-685. Each of the d inputs has k membership
functions, here Gaussians: mu = exp(-((u - centre) / sigma)^2 / 2). Each of their k^d combinations is a rule. The firing
strength w of a rule is the product of its memberships, its consequent is f = p_0 + p_1 u_1 + ... + p_d u_d, and the
output is sum(w f) / sum(w). On a grid partition sum(w) is the product of one sum per input. The memberships of each
input can therefore be normalised separately, and the sum over the rules taken one input at a time.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from exo_gravity.core.errors import DataError

MAX_RULES = 10_000  # 6 inputs of 4 functions give 4,096; more is probably a mistake, and would exhaust the memory


@dataclass(frozen=True, eq=False, init=False)
class Anfis:
    """m models with one output each, on the same d inputs, with k membership functions per input.

    centre, sigma: (m, d, k), the premises, in the inputs' units; sigma > 0.
    consequent: (m, k^d, d + 1), p_0..p_d of each rule; the function of the last input varies fastest.
    Raises DataError unless the shapes agree and every number is finite.
    """

    centre: np.ndarray
    sigma: np.ndarray
    consequent: np.ndarray

    def __init__(self, centre: ArrayLike, sigma: ArrayLike, consequent: ArrayLike) -> None:
        for field, value in zip(fields(self), (centre, sigma, consequent), strict=True):
            object.__setattr__(self, field.name, _array(field.name, value))
        models, inputs, functions = self.centre.shape
        rules = functions**inputs
        if not 0 < rules <= MAX_RULES:
            given = f"{inputs} inputs with {functions} functions each"
            raise DataError(f"ANFIS: {given}: must make 1 to {MAX_RULES} rules")
        for name, expected in (("sigma", self.centre.shape), ("consequent", (models, rules, inputs + 1))):
            if getattr(self, name).shape != expected:
                raise DataError(f"ANFIS: shape of {name} = {getattr(self, name).shape}: must be {expected}")
        if np.any(self.sigma <= 0):
            raise DataError(f"ANFIS: sigma = {self.sigma.min():g}: must be greater than 0")

    @property
    def rules(self) -> int:
        """Rules per model."""
        return int(self.consequent.shape[1])

    @property
    def parameters(self) -> int:
        """Parameters per model: premises and consequents."""
        return sum(a[0].size for a in (self.centre, self.sigma, self.consequent))

    def output(self, inputs: np.ndarray) -> np.ndarray:
        """Return the outputs (n, m) for inputs (n, d)."""
        value = inputs @ self.consequent[:, :, 1:].transpose(0, 2, 1) + self.consequent[:, None, :, 0]  # f, (m, n, k^d)
        share = grades(self.centre, self.sigma, inputs)
        models, count, dimension, functions = share.shape
        for axis in reversed(range(dimension)):
            value = value.reshape(models, count, -1, functions) @ share[:, :, axis, :, None]
            value = value[..., 0]
        output: np.ndarray = value[..., 0].T
        return output


def grades(centre: np.ndarray, sigma: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Return the normalised memberships (m, n, d, k) of inputs (n, d); over k they sum to 1.

    centre, sigma: (m, d, k). Exponents are taken relative to the largest one, which avoids 0 / 0 far from all centres.
    """
    exponent = -0.5 * np.square((inputs[:, :, None] - centre[:, None]) / sigma[:, None])
    membership = np.exp(exponent - exponent.max(axis=-1, keepdims=True))
    normalised: np.ndarray = membership / membership.sum(axis=-1, keepdims=True)
    return normalised


def _array(name: str, value: ArrayLike) -> np.ndarray:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise DataError(f"ANFIS: {name}: must be a rectangular array of numbers") from None
    if array.ndim != 3:
        raise DataError(f"ANFIS: shape of {name} = {array.shape}: must have 3 axes")
    if not np.all(np.isfinite(array)):
        raise DataError(f"ANFIS: {name} has NaN or infinite entries: must be finite")
    array.setflags(write=False)
    return array
