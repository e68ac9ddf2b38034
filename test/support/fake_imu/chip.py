"""What the modelled chips share: time, motion, and 16-bit numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

G = 9.80665

Axes = tuple[float, float, float]


@dataclass
class Motion:
    """What the sensor undergoes: functions of time in s, in the sensor's axes."""

    angular_velocity: Callable[[float], Axes] = lambda time: (0.0, 0.0, 0.0)  # deg/s
    acceleration: Callable[[float], Axes] = lambda time: (0.0, 0.0, 1.0)  # g, +1 upward at rest
    temperature: float = 30.0  # degrees Celsius


@dataclass
class Sampler:
    """The instants at which a chip samples, by its own clock, which runs `fast` times as fast as it should."""

    clock: Callable[[], float]
    fast: float = 1.0
    instants: list[float] = field(default_factory=list)  # of every sample that was taken
    _last: float = 0.0

    def restart(self) -> None:
        """Take the next sample one period from now."""
        self._last = self.clock()

    def due(self, rate: float) -> list[float]:
        """Return the instants since the last call, for a nominal `rate` in Hz; 0 for none."""
        if rate <= 0.0:
            self.restart()
            return []
        period, due = 1.0 / (rate * self.fast), []
        while self._last + period <= self.clock():
            self._last += period
            due.append(self._last)
        self.instants += due
        return due


def number(value: float) -> int:
    """Return `value` as the nearest 16-bit number that a converter can give."""
    return min(max(round(value), -32768), 32767)


def high_first(values: list[int]) -> list[int]:
    """Return the bytes of 16-bit numbers, high byte first."""
    return [byte for value in values for byte in value.to_bytes(2, "big", signed=True)]


def low_first(values: list[int]) -> list[int]:
    """Return the bytes of 16-bit numbers, low byte first."""
    return [byte for value in values for byte in value.to_bytes(2, "little", signed=True)]
