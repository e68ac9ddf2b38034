"""How the calibration moves the arm, slowly along straight lines in joint space, and what a pose's sweeps show.

All joints sweep through a pose there and back. At the same angle the torque of the way there is gravity plus friction,
that of the way back gravity minus friction. Over its speed, a joint's friction is Coulomb, viscous and Stribeck:

    F(v) = coulomb + viscous v + stribeck exp(-(v / v_s)^2)          B. Armstrong-Helouvry et al., Automatica 30 (1994)

For a given Stribeck speed v_s this is linear in the other three, so v_s is searched on a grid.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import JOINT_COUNT, Vector

MAX_SPEED = 0.3  # rad/s, of any joint
ACCELERATION = 0.5  # rad/s^2
AMPLITUDE = 0.06  # rad, of a sweep on each side of its pose
WINDOW = 0.55  # of a sweep's amplitude: the part on both sides of the pose that is measured
FOLLOWED = 0.5  # of this part, that each joint must follow in a valid sweep
LEAD = 0.3  # s at rest before each motion, in which the joints are brought to the edge of moving
BINS = 4  # of each sweep: neighbouring samples share the slow oscillations of the controller
RESOLUTION = 0.002  # Nm: standard error that is left of the 12-bit torque command (7.3 mNm per code) after averaging
STRIBECK_SPEEDS = np.geomspace(0.01, 0.2, 30)  # rad/s
SIGNIFICANT = 3.0  # standard errors, from which on a Stribeck part is kept
LEAST_RATIO = 2.0  # of the fastest to the slowest speed
FRICTION_RESOLUTION = 0.003  # Nm: standard error of a friction that was measured once


class Observation(NamedTuple):
    """One pose, passed in both directions of motion."""

    theta: Vector  #: (4,) rad
    direction: Vector  #: (3,), gravity's unit vector in the base frame
    effort: Vector  #: (4,) Nm as commanded, mean of both directions
    friction: Vector  #: (4,) Nm, half of their difference
    spread: Vector  #: (4,) Nm, standard error of `effort`
    load_mass: float = 0.0  #: kg, a weight on link 4; 0 for none
    load_lever: float = 0.0  #: m, its distance from the elbow
    speed: float | Vector = 0.0  #: rad/s at which the joints passed the pose, one for all or (4,)


class Sweep(NamedTuple):
    """The n samples of one way through a pose."""

    position: np.ndarray  #: (n, 4) rad
    effort: np.ndarray  #: (n, 4) Nm; the part beyond what is expected at each angle can be given in its place
    direction: np.ndarray  #: (n, 3), gravity's unit vectors in the base frame


class Station(NamedTuple):
    """A pose that is measured while all joints sweep through it `cycles` times, there and back."""

    theta: tuple[float, ...]  #: (4,) rad
    speed: float = 0.1  #: rad/s, of the sweep
    amplitude: float = AMPLITUDE  #: rad, on each side of the pose
    cycles: int = 2

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the sweep begins and where it turns back, (4,) rad each."""
        return np.array(self.theta) - self.amplitude, np.array(self.theta) + self.amplitude

    @property
    def duration(self) -> float:
        """Time in s that the sweeps take."""
        return 2 * self.cycles * (Line(*self.ends, self.speed).duration + LEAD)


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
        time = min(max(time, 0.0), self.duration)
        rising, falling = min(time, self._ramp), max(0.0, time - self.duration + self._ramp)
        travelled = ACCELERATION * (rising**2 - falling**2) / 2 + self._speed * (time - rising)
        return self._start + travelled * self._heading, ACCELERATION * (rising - falling) * self._heading

    def is_measured(self, time: float) -> bool:
        """Return whether the motion is in its middle, within WINDOW of the half length at steady speed."""
        is_steady = self._ramp <= time <= self.duration - self._ramp
        return is_steady and abs(time - self.duration / 2.0) * self._speed <= WINDOW * self._length / 2.0


def average(sweeps: Sequence[Sweep]) -> tuple[Observation, np.ndarray]:
    """Return what `sweeps` show at a pose, and the largest change (4,) in Nm of the effort from one cycle to another.

    They alternate between there and back. What is expected at an angle should be subtracted from the effort: the rest
    does not change along a sweep (gravity does, and by up to 0.3 % more than in proportion).
    """
    bins = np.zeros((len(sweeps), BINS, JOINT_COUNT))  # mean effort in order of the angle
    for number, sweep in enumerate(sweeps):
        effort = sweep.effort[::-1] if number % 2 else sweep.effort
        bins[number] = [part.mean(axis=0) for part in np.array_split(effort, BINS)]
    there, back = bins[0::2], bins[1::2]
    gravity = (there + back) / 2.0
    cycles = gravity.mean(axis=1)
    friction = (there - back).mean(axis=(0, 1)) / 2.0
    scatter = gravity.reshape(-1, JOINT_COUNT).std(axis=0, ddof=1) / np.sqrt(max(1.0, gravity[..., 0].size / 2.0))
    theta = np.mean([sweep.position.mean(axis=0) for sweep in sweeps], axis=0)
    direction = mean_direction(np.concatenate([sweep.direction for sweep in sweeps]))
    seen = Observation(theta, direction, cycles.mean(axis=0), friction, np.hypot(scatter, RESOLUTION))
    return seen, np.ptp(cycles, axis=0)


def mean_direction(directions: np.ndarray) -> np.ndarray:
    """Return the mean (3,) of unit vectors (n, 3), of length 1."""
    mean = directions.mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def followed(sweeps: Sequence[Sweep], station: Station) -> np.ndarray:
    """Return the share (4,) of the measured way that each joint went in every one of `sweeps` through `station`."""
    ways = np.min([np.abs(sweep.position[-1] - sweep.position[0]) for sweep in sweeps], axis=0)
    return np.asarray(ways / (2.0 * WINDOW * station.amplitude))


class FrictionCurve(NamedTuple):
    """Friction of a joint over its speed."""

    speed: np.ndarray  #: (n,) rad/s
    torque: np.ndarray  #: (n,) Nm, measured
    fitted: np.ndarray  #: (n,) Nm
    coulomb: float  #: Nm
    viscous: float  #: Nm s/rad
    stribeck: float  #: Nm, 0 if the data show none
    stribeck_speed: float  #: rad/s, 0 without Stribeck friction
    error: tuple[float, ...]  #: (3,), standard errors of coulomb, viscous and stribeck


def fit_friction(speed: np.ndarray, torque: np.ndarray) -> FrictionCurve:
    """Return the friction that fits `torque` (n,) in Nm at `speed` (n,) rad/s.

    Raises DataError for fewer than 3 speeds, or less than a factor of 2 between them.
    """
    speeds = len(np.unique(speed))
    if speeds < 3:
        raise DataError(f"friction was measured at {speeds} speeds, must be at least 3")
    if speed.max() < LEAST_RATIO * speed.min():
        measured = f"from {speed.min():.2f} to {speed.max():.2f} rad/s"
        raise DataError(f"friction was measured {measured}, the fastest must be {LEAST_RATIO:g} times the slowest")
    fits = [_fit(speed, torque, own) for own in STRIBECK_SPEEDS.tolist()]
    best = min(fits, key=lambda fit: float(np.sum((fit.fitted - torque) ** 2)))
    return best if speeds > 3 and best.stribeck > SIGNIFICANT * best.error[2] else _fit(speed, torque)


def _fit(speed: np.ndarray, torque: np.ndarray, stribeck_speed: float = 0.0) -> FrictionCurve:
    """Return the fit with this Stribeck speed, 0 for a fit without Stribeck friction."""
    falling = np.exp(-((speed / stribeck_speed) ** 2)) if stribeck_speed else np.zeros_like(speed)
    matrix = np.stack((np.ones_like(speed), speed, falling), axis=1)
    values, _, rank, _ = np.linalg.lstsq(matrix, torque, rcond=None)
    fitted = matrix @ values
    scatter = float(np.sum((fitted - torque) ** 2)) / max(1, len(speed) - int(rank))
    errors = np.sqrt(max(scatter, FRICTION_RESOLUTION**2) * np.diag(np.linalg.pinv(matrix.T @ matrix)))
    return FrictionCurve(speed, torque, fitted, *values.tolist(), stribeck_speed, tuple(errors.tolist()))
