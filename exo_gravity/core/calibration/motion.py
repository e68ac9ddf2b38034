"""How the calibration moves the arm, slowly along straight lines in joint space, and what a pose's sweeps show.

All joints sweep through a pose there and back. At the same angle the torque of the way there is gravity plus friction,
that of the way back gravity minus friction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.numbers import JOINT_COUNT

MAX_SPEED = 0.3  # rad/s, of any joint
ACCELERATION = 0.5  # rad/s^2
AMPLITUDE = 0.06  # rad, of a sweep on each side of its pose
WINDOW = 0.55  # of a sweep's amplitude: the part on both sides of the pose that is measured
LEAD = 0.3  # s at rest before each motion, in which the joints are brought to the edge of moving
BINS = 4  # of each sweep: neighbouring samples share the slow oscillations of the controller
RESOLUTION = 0.002  # Nm: standard error that is left of the 12-bit torque command (7.3 mNm per code) after averaging
FOLLOWED = 0.5  # of the way of the reference, that each joint must follow in a valid sweep
MAX_FAILURES = 3  # pairs of sweeps in which a joint may stick: each shows the controller more of its friction


class Station(NamedTuple):
    """A pose that is measured while all joints sweep through it `cycles` times, there and back."""

    theta: tuple[float, ...]  #: (4,) rad
    speed: float = 0.1  #: rad/s, of the sweep
    amplitude: float = AMPLITUDE  #: rad, on each side of the pose
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


Sweep = tuple[np.ndarray, np.ndarray]  # position (n, 4) rad and effort (n, 4) Nm of its samples


class Average(NamedTuple):
    """What sweeps show at a pose."""

    theta: np.ndarray  #: (4,) rad
    effort: np.ndarray  #: (4,) Nm
    friction: np.ndarray  #: (4,) Nm
    spread: np.ndarray  #: (4,) Nm, standard error of `effort`
    unrest: np.ndarray  #: (4,) Nm, largest change of the effort from one cycle to another


def average(sweeps: Sequence[Sweep], slope: np.ndarray, bend: np.ndarray | None = None) -> Average:
    """Return the average of `sweeps`, which alternate between there and back.

    slope: (4, 4) Nm/rad, change of the expected torque with each angle, which relates efforts at different angles.
    bend: (4,) Nm/rad^2, second derivative while all joints turn alike. Without it a sweep of 0.07 rad shows up to 0.3 %
    less than the torque at its middle.
    """
    theta = np.mean([position.mean(axis=0) for position, _ in sweeps], axis=0)
    bins = np.zeros((len(sweeps), BINS, JOINT_COUNT))  # mean effort in order of the angle, reduced to `theta`
    for number, (position, effort) in enumerate(sweeps):
        away = position - theta
        reduced = effort - away @ slope.T
        if bend is not None:
            reduced -= np.outer(away.mean(axis=1) ** 2 / 2.0, bend)
        in_order = reduced[::-1] if number % 2 else reduced
        bins[number] = [part.mean(axis=0) for part in np.array_split(in_order, BINS)]
    there, back = bins[0::2], bins[1::2]
    gravity = (there + back) / 2.0
    cycles = gravity.mean(axis=1)
    friction = (there - back).mean(axis=(0, 1)) / 2.0
    independent = max(1.0, gravity[..., 0].size / 2.0)
    scatter = gravity.reshape(-1, JOINT_COUNT).std(axis=0, ddof=1) / np.sqrt(independent)
    return Average(theta, cycles.mean(axis=0), friction, np.hypot(scatter, RESOLUTION), np.ptp(cycles, axis=0))


class Visit:
    """Collects the samples of the sweeps through `station`, there and back, until enough of them were good.

    slope: (4, 4) Nm/rad, change of the expected torque with the angles; bend: its curvature, as for `average`.
    stuck_joints: those that did not follow one of the last two sweeps, with the part of the way that they did.
    """

    def __init__(self, station: Station, slope: np.ndarray, bend: np.ndarray) -> None:
        self.station = station
        self.stuck_joints: dict[int, float] = {}
        self._failures = 0
        self._slope, self._bend = slope, bend
        self._sweeps: list[Sweep] = []
        self._samples: list[tuple[Sequence[float], Torque]] = []
        self._directions: list[tuple[float, float, float]] = []

    @property
    def line(self) -> Line:
        """The next sweep."""
        ends = (self.station.low, self.station.high)
        return Line(*(ends if len(self._sweeps) % 2 == 0 else ends[::-1]), self.station.speed)

    @property
    def is_complete(self) -> bool:
        """Whether enough sweeps were good."""
        return len(self._sweeps) == 2 * self.station.cycles

    @property
    def has_failed(self) -> bool:
        """Whether joints stuck too often here."""
        return self._failures > MAX_FAILURES

    def note(self, position: Sequence[float], effort: Torque, direction: tuple[float, float, float]) -> None:
        """Take a sample: the `effort` (4,) Nm that brought the arm to `position` (4,) rad; `direction` of gravity."""
        self._samples.append((tuple(position), effort))
        self._directions.append(direction)

    def end_sweep(self) -> np.ndarray | None:
        """End a sweep. Return the friction (4,) in Nm that it and the one before show, None after a way there."""
        position, effort = (np.array(column) for column in zip(*self._samples, strict=True))
        self._sweeps.append((position, effort))
        self._samples = []
        if len(self._sweeps) % 2:
            return None
        ways = [np.abs(way[-1] - way[0]) for way, _ in self._sweeps[-2:]]
        shares = np.min(ways, axis=0) / (2.0 * WINDOW * self.station.amplitude)
        self.stuck_joints = {joint: float(share) for joint, share in enumerate(shares) if share < FOLLOWED}
        return average(self._sweeps[-2:], self._slope, self._bend).friction

    def start_again(self, failed: bool) -> None:
        """Discard the sweeps so far; failed: because a joint did not follow."""
        self._failures += failed
        self._sweeps, self._directions = [], []

    def result(self) -> tuple[Average, np.ndarray]:
        """Return the average of the sweeps, and the mean direction (3,) of gravity during them."""
        direction = np.mean(self._directions, axis=0)
        return average(self._sweeps, self._slope, self._bend), direction / np.linalg.norm(direction)
