"""The rate of counted events."""

from __future__ import annotations


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
