"""The joints' acceleration from the motors' velocity: its derivative behind two low-passes.

One code of 12-bit velocity, 0.022 rad/s, moves the result by 0.022 BANDWIDTH / e = 0.65 rad/s^2 at most: 0.06 Nm on
0.1 kg m^2. The result lags by 2 / BANDWIDTH = 25 ms.
"""

from __future__ import annotations

from collections.abc import Sequence

BANDWIDTH = 80.0  # rad/s


class AccelerationFilter:
    """The velocity behind one low-pass, and behind two."""

    def __init__(self) -> None:
        self._once: list[float] = []
        self._twice: list[float] = []

    def update(self, velocity: Sequence[float], dt: float) -> Sequence[float]:
        """Return the acceleration (4,) in rad/s^2 for the `velocity` (4,) in rad/s, `dt` s after the last call.

        dt: 0 starts anew, with the acceleration 0. Its gain is below 1 at any frequency and any dt.
        """
        if dt <= 0.0 or not self._once:
            self._once, self._twice = list(velocity), list(velocity)
            return [0.0] * len(velocity)
        share = dt * BANDWIDTH / (1.0 + dt * BANDWIDTH)
        once = [a + share * (v - a) for v, a in zip(velocity, self._once, strict=True)]
        rate = share / dt
        acceleration = [rate * (a - b) for a, b in zip(once, self._twice, strict=True)]
        self._twice = [b + dt * a for b, a in zip(self._twice, acceleration, strict=True)]
        self._once = once
        return acceleration
