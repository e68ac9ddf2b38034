"""Numbers in joint order, and their checks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from exo_gravity.core.errors import ParameterError

Vector = Sequence[float] | np.ndarray  # numbers in joint order, or the components of a vector

JOINT_COUNT = 4


def four_floats(name: str, values: Vector, low: float, high: float, unit: str = "") -> np.ndarray:
    """Return `values` as a read-only array (4,), or raise ParameterError unless they are 4 numbers in [low, high]."""
    return floats(name, values, JOINT_COUNT, low, high, unit)


def floats(name: str, values: Vector, count: int, low: float, high: float, unit: str = "") -> np.ndarray:
    """Return `values` as a read-only array, or raise ParameterError unless they are `count` numbers in [low, high]."""
    expected = f"{count} numbers from {low:g} to {high:g}{' ' + unit if unit else ''}"
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(name, values, expected) from None
    # NaN fails both comparisons, so this check rejects it too.
    if array.shape != (count,) or not np.all((array >= low) & (array <= high)):
        raise ParameterError(name, values, expected)
    array.setflags(write=False)
    return array


def one_float(name: str, value: float, low: float, high: float, unit: str = "") -> float:
    """Return `value` as a float, or raise ParameterError unless it is one number in [low, high]."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not low <= number <= high:
        raise ParameterError(name, value, f"a number from {low:g} to {high:g}{' ' + unit if unit else ''}")
    return number
