"""The one place where the sum of all terms is limited: bounded, rate-limited, ramped in and out.

A change of parameters never steps the torque: the difference it makes fades over `ramp_time`, as in
`core.compensation.compensator`. Whatever is wrong with the sum, gravity compensation goes on beneath it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.model.gravity import NO_TORQUE, Torque
from exo_gravity.core.params import check_owned, owned

LONGEST_STEP = 0.01  # s counted by the rate limit after a pause


@dataclass(frozen=True)
class Shaping:
    """Parameters of the group `terms`. Raises ParameterError."""

    max_effort: Sequence[float] = owned(
        (2.0, 4.0, 2.0, 2.0), "largest torque of all terms on top of gravity compensation", (0.0, 10.0), "Nm"
    )
    max_effort_rate: float = owned(50.0, "fastest change of that torque", (1.0, 200.0), "Nm/s")
    ramp_time: float = owned(1.0, "time over which a change of the terms takes effect", (0.2, 10.0), "s")

    def __post_init__(self) -> None:
        check_owned(self)


class Shaper:
    """Limits the sum of the terms. output: the last torque, (4,) Nm. refusal: why a sum was not used, or ''."""

    def __init__(self, shaping: Shaping) -> None:
        self.shaping = shaping
        self.output = NO_TORQUE
        self.refusal = ""
        self._remainder = NO_TORQUE  # at the time of the last change
        self._left = 0.0  # share of it

    def restart(self) -> None:
        """Begin again from no torque."""
        self.output, self._remainder, self._left = NO_TORQUE, NO_TORQUE, 0.0

    def change(self, before: Torque, after: Torque) -> None:
        """Bridge a change of the sum from `before` to `after`, (4,) Nm each, between two calls of `shape`."""
        left = self._left
        self._remainder = tuple([b - a + left * r for b, a, r in zip(before, after, self._remainder, strict=True)])
        self._left = 1.0

    @property
    def idle(self) -> bool:
        """Whether neither a torque nor the rest of a change is left."""
        return self._left <= 0.0 and self.output == NO_TORQUE

    def shape(self, torque: Torque, dt: float) -> Torque:
        """Return the limited torque (4,) in Nm for the sum of the terms `torque` (4,), `dt` s after the last call."""
        a, b, c, d = torque
        self.refusal = "" if math.isfinite(a + b + c + d) else "torque of the terms is not finite"
        if self.refusal:
            torque, self._left = NO_TORQUE, 0.0
        if self._left > 0.0:
            self._left = left = max(0.0, self._left - dt / self.shaping.ramp_time)
            torque = tuple([t + left * r for t, r in zip(torque, self._remainder, strict=True)])
        step = self.shaping.max_effort_rate * min(dt, LONGEST_STEP)
        shaped = []
        for wanted, last, limit in zip(torque, self.output, self.shaping.max_effort, strict=True):
            target = limit if wanted > limit else -limit if wanted < -limit else wanted
            shaped.append(last + step if target > last + step else last - step if target < last - step else target)
        self.output = tuple(shaped)
        return self.output
