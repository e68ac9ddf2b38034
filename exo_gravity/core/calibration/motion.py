"""How the calibration moves the arm: straight lines in joint space, slow, with bounded acceleration."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

MAX_SPEED = 0.3  # rad/s, of any joint
ACCELERATION = 0.5  # rad/s^2
WINDOW = 0.55  # of a sweep's amplitude: the part on both sides of the pose that is measured
LEAD = 0.3  # s at rest before each motion, in which the joints are brought to the edge of moving


class Station(NamedTuple):
    """A pose (4,) in rad that is measured while all joints sweep through it `cycles` times, there and back.

    speed: rad/s, of the sweep. amplitude: rad, on each side of the pose.
    """

    theta: tuple[float, ...]
    speed: float = 0.1
    amplitude: float = 0.06
    cycles: int = 2

    @property
    def low(self) -> np.ndarray:
        """Where the sweep begins, (4,) rad."""
        return np.array(self.theta) - self.amplitude

    @property
    def high(self) -> np.ndarray:
        """Where the sweep turns back, (4,) rad."""
        return np.array(self.theta) + self.amplitude

    @property
    def duration(self) -> float:
        """Time in s that the sweeps take."""
        return 2 * self.cycles * (Line(self.low, self.high, self.speed).duration + LEAD)


def durations(ways: np.ndarray) -> np.ndarray:
    """Return the time (n,) in s of motions by `ways` (n, 4) rad, with the rest before them."""
    length = np.abs(ways).max(axis=1)
    speed = np.minimum(MAX_SPEED, np.sqrt(length * ACCELERATION))
    steady = np.divide(length, speed, out=np.zeros_like(length), where=length > 0.0)
    return np.asarray(steady + speed / ACCELERATION + LEAD)


class Line:
    """The motion from `start` to `end`, (4,) rad; the joint with the longest way turns at `speed` rad/s at most.

    duration: s.
    """

    def __init__(self, start: np.ndarray, end: np.ndarray, speed: float = MAX_SPEED) -> None:
        self._start = np.asarray(start, dtype=float)
        way = np.asarray(end, dtype=float) - self._start
        self._length = float(np.abs(way).max())
        self._heading = way / self._length if self._length else way
        self._speed = min(speed, MAX_SPEED, math.sqrt(self._length * ACCELERATION))
        self._ramp = self._speed / ACCELERATION
        self.duration = self._length / self._speed + self._ramp if self._length else 0.0

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position (4,) rad and velocity (4,) rad/s at `time` s after the start."""
        to_end = self.duration - time
        if time <= 0.0 or to_end <= 0.0:
            travelled, speed = (0.0 if time <= 0.0 else self._length), 0.0
        elif time < self._ramp:
            travelled, speed = ACCELERATION * time**2 / 2, ACCELERATION * time
        elif to_end < self._ramp:
            travelled, speed = self._length - ACCELERATION * to_end**2 / 2, ACCELERATION * to_end
        else:
            travelled, speed = self._speed * (time - self._ramp / 2), self._speed
        return self._start + travelled * self._heading, speed * self._heading

    def is_measured(self, time: float) -> bool:
        """Return whether the motion is in its middle, within WINDOW of the half length at steady speed."""
        travelled = self._speed * (time - self._ramp / 2)
        is_steady = self._ramp <= time <= self.duration - self._ramp
        return is_steady and abs(2.0 * travelled / self._length - 1.0) <= WINDOW
