"""How fast something that is counted happens."""

from __future__ import annotations


class Rate:
    """How fast a counter runs: `update` it whenever it suits, and it tells the rate over the last second or more."""

    def __init__(self):
        self.value = 0.0
        self._time, self._count = 0.0, -1

    def update(self, now: float, count: int) -> float:
        """Take the `count` at `now` s; return counts per second, 0 until a second has passed."""
        if self._count < 0 or count < self._count:  # it began anew
            self.value, self._time, self._count = 0.0, now, count
        elif now - self._time >= 1.0:
            self.value = (count - self._count) / (now - self._time)
            self._time, self._count = now, count
        return self.value
