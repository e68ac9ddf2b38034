# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Numbers in joint order, their checks, and the rate of a counter."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from exo_gravity.core.errors import ParameterError

Vector = Sequence[float] | np.ndarray  # numbers in joint order, or the components of a vector

JOINT_COUNT = 4  # of the paper's arm, whose values are the defaults
MAX_JOINTS = 32  # of one arm
Torque = tuple[float, ...]  # (n,) Nm in joint order
NO_TORQUE: Torque = (0.0,) * JOINT_COUNT
COVER = 1.96  # standard deviations of a 95 % band


def clamp(value: float, limit: float) -> float:
    """Return `value` within -`limit`..`limit`."""
    return max(-limit, min(limit, value))


def rate_limited(wanted: float, last: float, step: float) -> float:
    """Return `wanted` within `step` of `last`."""
    return max(last - step, min(last + step, wanted))


def for_joints(
    tuning: Sequence[float], count: int, chosen: Callable[[Sequence[float]], float] = min
) -> tuple[float, ...]:
    """Return `tuning` for an arm of `count` joints: as it is if it has so many, else its least for every joint.

    chosen: what every joint has in place of the least.
    """
    return tuple(tuning) if len(tuning) == count else (chosen(tuning),) * count


def four_floats(name: str, values: Vector, low: float, high: float, unit: str = "") -> np.ndarray:
    """Return `values` as a read-only array (4,), or raise ParameterError unless they are 4 numbers in [low, high]."""
    return floats(name, values, JOINT_COUNT, low, high, unit)


def floats(name: str, values: Vector, count: int, low: float, high: float, unit: str = "") -> np.ndarray:
    """Return `values` as a read-only array, or raise ParameterError unless they are `count` numbers in [low, high]."""
    expected = f"{count} numbers from {low:g} to {high:g}{' ' + unit if unit else ''}"
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
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
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not low <= number <= high:
        raise ParameterError(name, value, f"a number from {low:g} to {high:g}{' ' + unit if unit else ''}")
    return number


class Rate:
    """Rate of a counter, averaged over a second or more; `update` may be called at any interval."""

    def __init__(self) -> None:
        self.value = 0.0
        self._time, self._count = 0.0, -1

    def update(self, now: float, count: int) -> float:
        """Record the `count` at `now` s and return counts per second, 0 during the first second."""
        if self._count < 0 or count < self._count:  # first call, or the counter restarted
            self.value, self._time, self._count = 0.0, now, count
        elif now - self._time >= 1.0:
            self.value = (count - self._count) / (now - self._time)
            self._time, self._count = now, count
        return self.value
