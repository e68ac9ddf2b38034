"""The clock of the stamps: a slow one makes every turn too small; a second publisher halves the time between samples.

A sensor's rate is steady. So after a start the time between two stamps must stay a multiple of what it has been, which
must be near the given rate. What it has been is a mean without the times far from the median: a busy computer loses
samples, or stamps one late, so that the next seems early. A clock that is a little slow from the start shows in the age
of its stamps, by which the compensator withdraws.
"""

from __future__ import annotations

from statistics import fmean, median

from exo_gravity.core.errors import ParameterError

LEARN_TIME = 0.8  # s; less than the time to settle
MAX_DEVIATION = 0.5  # share of the median; more is a lost or a late sample
RATE_BOUNDS = (0.85, 1.18)  # share of the given rate
AVERAGE_TIME = 0.1  # s
MAX_CHANGE = 0.03  # share by which the period may change
JITTER = 1.5  # times the mean deviation of the periods that are further allowed


class StampCheck:
    """Follows the stamps of one IMU."""

    def __init__(self, rate: float) -> None:
        self._given = 1.0 / rate
        self.restart()

    def restart(self) -> None:
        """Learn anew from the next sample on."""
        self._period = self._given
        self._is_learning = True
        self._share, self._jitter = 1.0, 0.0  # of the periods: mean, and mean deviation from it
        self._age = 0.0  # s since the start
        self._learned: list[float] = []  # the times between two stamps since the start, s

    def check(self, time: float, dt: float) -> None:
        """Check the stamp `time` (s), `dt` s after the last one. Raises ParameterError."""
        periods = max(1, round(dt / self._period))
        share = dt / self._period / periods
        k = min(1.0, dt / AVERAGE_TIME)
        self._jitter += k * (abs(share - self._share) - self._jitter)
        self._share += k * (share - self._share)
        if self._is_learning:
            self._age += dt
            if dt > 0.0:
                self._learned.append(dt)
            if self._age >= LEARN_TIME:
                self._learn()
        elif abs(self._share - 1.0) > MAX_CHANGE + JITTER * self._jitter:
            expected = "evenly spaced as before: its clock has changed, or a second IMU publishes"
            raise ParameterError("stamp", round(time, 4), expected)

    def _learn(self) -> None:
        """Take the period from the stamps since the start. Raises ParameterError if it is not the given one."""
        middle = median(self._learned)
        period = fmean([dt for dt in self._learned if abs(dt - middle) <= MAX_DEVIATION * middle] or [middle])
        count_rate = len(self._learned) / self._age
        low, high = RATE_BOUNDS
        if not low <= self._given / period <= high or count_rate * self._given > high:
            expected = f"about the {count_rate:.0f} Hz of the stamps, unless a second IMU publishes"
            raise ParameterError("rate", round(1.0 / self._given, 1), expected)
        self._period, self._share, self._is_learning = period, 1.0, False
