"""Which poses the calibration visits: given ones, or the most informative ones that the motors can hold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from exo_gravity.core.calibration.guess import TorqueGuess
from exo_gravity.core.calibration.identification import next_pose
from exo_gravity.core.calibration.motion import Station, durations
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.limits import WALL_WIDTH, Limits

CANDIDATES = 800
MOST_UPWARDS = 0.3  # sine of the largest angle above the horizontal, of links 3 and 4
SHARE = 0.85  # of max_effort that a pose may need
DEVIATIONS = (2.0, 1.0, 0.0)  # of the expected torque, that a pose must leave room for; less where none does
USUAL_FRICTION = 0.5  # Nm, until it is measured
WAYPOINTS = 8  # of the way to a pose, at which the motors must hold the arm too
FIRST_EDGE = 0.1  # rad in addition, at the first pose
EDGE = 0.02  # rad between a sweep's end and the soft wall
TIME_SHARE = 1.5  # of the time left for each pose, that the next one may take


class Progress(NamedTuple):
    """Where the arm is: position (4,) rad, and the time since the start of the tour in s."""

    position: np.ndarray
    elapsed: float


class Itinerary(Protocol):
    """Chooses the poses of a tour, one after the other."""

    count: int  # of all poses

    def next(
        self, taken: np.ndarray, progress: Progress, guess: TorqueGuess, friction: Sequence[float]
    ) -> Station | None:
        """Return the next station, None after the last. Raises DataError if no pose can be held.

        taken: (n, 4) rad, the poses measured so far. friction: (4,) Nm, 0 if unknown.
        """
        ...


class FixedStations:
    """Visits given stations in order."""

    def __init__(self, stations: Sequence[Station]) -> None:
        self.count = len(stations)
        self._left: Iterator[Station] = iter(stations)

    def next(
        self, taken: np.ndarray, progress: Progress, guess: TorqueGuess, friction: Sequence[float]
    ) -> Station | None:
        """Return the next of the given stations."""
        return next(self._left, None)


@dataclass
class BestPoses:
    """Visits `count` poses, each the one with the most information that is still missing.

    duration: s, of the whole tour, which the choice keeps within. seed: of the candidates.
    """

    limits: Limits
    count: int
    duration: float
    seed: int = 1

    def __post_init__(self) -> None:
        low, high = measurable(self.limits, Station((0.0,) * JOINT_COUNT).amplitude)
        # Friction is not known at first: the first pose keeps a distance from the soft walls.
        self._home = np.clip(self.limits.home, low + FIRST_EDGE, high - FIRST_EDGE)
        self._candidates = candidates(self.limits, self.seed)
        self._is_started = False

    def next(
        self, taken: np.ndarray, progress: Progress, guess: TorqueGuess, friction: Sequence[float]
    ) -> Station | None:
        """Return the best of the candidates that can be held and reached; the first is the hanging arm."""
        if len(taken) >= self.count:
            return None
        if not len(taken) and not self._is_started:
            self._is_started = True
            return Station(tuple(self._home.tolist()))
        in_time = np.flatnonzero(self._is_in_time(len(taken), progress))
        for deviations in DEVIATIONS:
            can = self._is_holdable(self._candidates[in_time], progress.position, guess, friction, deviations)
            possible = in_time[can]
            if len(possible):
                break
        else:
            raise DataError("no further pose can be held within max_effort: is it too small for the arm?")
        seen = list(taken) or [self._home]
        poses = self._candidates[possible]
        index = possible[next_pose(seen, poses, guess.tilt.direction, guess.common_moments, guess.gravity)]
        pose = self._candidates[index]
        self._candidates = np.delete(self._candidates, index, axis=0)  # chosen once, even if a joint sticks there
        return Station(tuple(pose.tolist()))

    def _is_in_time(self, count: int, progress: Progress) -> np.ndarray:
        """Return which candidates (n,) leave enough time for the others and for the way home."""
        sweeps = Station(tuple(self._home.tolist())).duration
        home, way = (durations(self._candidates - pose) for pose in (self._home, progress.position))
        left = self.count - count
        budget = (self.duration - progress.elapsed - home) / left
        fits = way + sweeps <= budget * (TIME_SHARE if left > 1 else 1.0)
        return np.asarray(fits if fits.any() else way + home <= (way + home).min() + 1.0)

    def _is_holdable(
        self, poses: np.ndarray, start: np.ndarray, guess: TorqueGuess, friction: Sequence[float], deviations: float
    ) -> np.ndarray:
        """Return which poses (n,) the motors can hold, reach from `start`, and leave for the hanging arm."""
        shares = np.linspace(0.0, 1.0, WAYPOINTS + 1)[1:, None, None]
        sweep = Station((0.0,) * JOINT_COUNT).amplitude * np.array((-1.0, 1.0))[:, None, None]
        start, home = start + shares * (poses - start), self.limits.home + shares * (poses - self.limits.home)
        result = np.ones(len(poses), dtype=bool)
        for way, room in ((start, deviations), (poses + sweep, deviations), (home, 0.0)):
            can = holdable(way.reshape(-1, JOINT_COUNT), self.limits, guess, friction, room)
            result &= can.reshape(len(way), -1).all(axis=0)
        return result


def candidates(limits: Limits, seed: int = 1) -> np.ndarray:
    """Return random poses (n, 4) in rad within `limits` in which no link points far upwards.

    Above the shoulder gravity tips the arm over: what is wrong with the expected torque grows with each movement.
    """
    low, high = measurable(limits, Station((0.0,) * JOINT_COUNT).amplitude)
    poses = np.random.default_rng(seed).uniform(low, high, (CANDIDATES, JOINT_COUNT))
    down = np.cos(poses[:, 1:2]) * np.cos(np.stack((poses[:, 2], poses[:, 2] + poses[:, 3]), axis=1))
    return np.asarray(poses[down.min(axis=1) >= -MOST_UPWARDS])


def measurable(limits: Limits, amplitude: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest pose (4,) rad around which a sweep of `amplitude` rad stays off the soft walls."""
    margin = WALL_WIDTH + amplitude + EDGE
    return np.array(limits.position_min) + margin, np.array(limits.position_max) - margin


def holdable(
    poses: np.ndarray,
    limits: Limits,
    guess: TorqueGuess,
    friction: Sequence[float],
    deviations: float = DEVIATIONS[0],
) -> np.ndarray:
    """Return at which of `poses` (n, 4) rad the motors can hold the arm, and move it against `friction` (4,) Nm.

    deviations: standard deviations of the expected torque for which there must be room.
    """
    mean, deviation = guess.torques(poses)
    slide = [own or USUAL_FRICTION for own in friction]
    return np.asarray(
        np.all(np.abs(mean) + deviations * deviation + slide <= SHARE * np.array(limits.max_effort), axis=1)
    )
