# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Which poses the calibration visits: given ones, or the most informative ones that the motors can hold.

What holds the arm is expected with a mean and a standard deviation for every pose. Each joint has moments of its own,
in the Nm that its motor is commanded: its unknown torque scale is then part of them. Beside them it has an offset and a
spring: a cable carries as much as a light forearm. They start from the parameter file's arm with a wide uncertainty,
and every measured pose narrows it (a Kalman update), also those of an earlier tour.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import Torque, Vector
from exo_gravity.core.safety.limits import WALL, Limits
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.pose_fit import FIT, layout_of, rows_at
from exo_gravity.lab.calibration.tracking import MOTION, Line, Observation, Station


@dataclass(frozen=True)
class Prior:
    """How unsure the torque is that holds the arm, before a pose is measured."""

    load_share: float = 0.2  #: of the torque of a known weight, as commanded: torque scales that are off by 30 %
    offset: float = 0.05  #: Nm, of a motor, or where a cable is slack
    unexplained: float = 0.05  #: Nm: standard deviation of what none of these explains,
    angle: float = 0.03  #: rad, and of the direction in which it pulls: zeros and axes that are off
    #: of a joint: 30 % off in mass, centre of gravity and torque scale are 0.38 to 2.4 in one link, less in a whole arm
    strength: tuple[float, float] = (0.5, 2.0)


PRIOR = Prior()


@dataclass(frozen=True)
class PoseChoice:
    """Which poses may be visited, and which of them shows most."""

    candidates: int = 800  #: random poses, of which those above the horizontal are left out
    most_upwards: float = 0.3  #: sine of the largest angle above the horizontal, of links 3 and 4
    effort_share: float = 0.85  #: of max_effort that a pose may need
    deviations: float = 2.0  #: of the expected torque, that a pose must leave room for; less where none does
    least_deviation: float = 1e-9  #: Nm
    usual_friction: float = 0.5  #: Nm, until it is measured
    waypoints: int = 8  #: of the way to a pose, at which the motors must hold the arm too
    first_edge: float = 0.1  #: rad in addition, at the first pose
    edge: float = 0.02  #: rad between a sweep's end and the soft wall
    time_share: float = 1.5  #: of the time left for each pose, that the next one may take
    moment: float = 0.1  #: kg m, standard error of any moment before,
    other: float = 0.3  #: and of other unknowns, in their units
    noise: float = 0.03  #: Nm in any pose
    noise_share: float = 0.02  #: of the torque
    shown: float = 0.03  #: of what noise hides, from which the poses together show an unknown


CHOICE = PoseChoice()


@dataclass(frozen=True)
class FrictionSweeps:
    """The sweeps of the hanging arm that show its friction."""

    speeds: tuple[float, ...] = (0.02, 0.05, 0.1, 0.18, MOTION.speed)  #: rad/s, at which friction is measured
    time: float = 1.2  #: s of such a sweep's half at steady speed
    amplitude: tuple[float, float] = (0.05, 0.3)  #: rad, smallest and largest


SWEEPS = FrictionSweeps()


class TorqueGuess:
    """The commanded torque that holds the arm, as far as it is known.

    model: of the arm.
    moments: (k,) kg m, without a weight.
    tilt: of the trunk or the stand.

    strength: (n,), of each joint, the commanded torque by that of the file's arm: its masses and its torque scale.
    """

    def __init__(self, model: MomentModel, moments: Vector, tilt: Tilt) -> None:
        moments = np.asarray(moments, dtype=float)
        deviation = np.append(FIT.share * np.abs(moments) + FIT.moment, (PRIOR.offset, FIT.spring))
        self.model = model
        self.tilt = tilt
        self._mean = np.tile(np.append(moments, (0.0, 0.0)), (model.count, 1))  # of each joint: moments, offset, spring
        self._covariance = np.tile(np.diag(deviation**2), (model.count, 1, 1))
        rows = np.moveaxis(model.along_axes(model.suggested), -1, 0)
        self._rows = rows.reshape(-1, *rows.shape[2:])  # gravity from three sides, in all suggested poses
        self._begin(moments)

    @property
    def common_moments(self) -> np.ndarray:
        """The moments (k,) in kg m as the joints show them that carry them with their own links."""
        return np.array([self._moments[n, k] for k, (n, _) in enumerate(self.model.base)])

    def torque(self, theta: Sequence[float]) -> Torque:
        """Return the expected torque (n,) in Nm at `theta` (n,) rad, in plain floats for the control loop."""
        gravity = [arm.torque(theta, self.tilt)[joint] for joint, arm in enumerate(self._arms)]
        return tuple(own + at + k * angle for own, (at, k), angle in zip(gravity, self._springs, theta, strict=True))

    def torques(self, theta: np.ndarray, direction: Vector | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the expected torque and its standard deviation, both (m, n) Nm, at `theta` (m, n) rad.

        direction: (3,), gravity's unit vector in the base frame; by default as at present.
        """
        rows = self._sensitivity(theta, direction)
        mean = np.einsum("njk,jk->nj", rows, self._mean)
        variance = np.einsum("njk,jkl,njl->nj", rows, self._covariance, rows)
        return mean, np.sqrt(np.maximum(variance, 0.0))

    def learn(self, theta: Vector, effort: Vector, spread: Vector, direction: Vector | None = None) -> None:
        """Take a measured torque `effort` (n,) Nm at `theta` (n,) rad, with its standard error `spread` (n,) Nm.

        direction: as for `torques`.
        """
        rows = self._sensitivity(np.array([theta]), direction)[0]
        unexplained = np.hypot(PRIOR.unexplained, PRIOR.angle * self._size)
        for joint, (row, torque, error) in enumerate(zip(rows, effort, np.hypot(spread, unexplained), strict=True)):
            covariance = self._covariance[joint]
            gain = covariance @ row / (row @ covariance @ row + error**2)
            self._mean[joint] += gain * (torque - row @ self._mean[joint])
            self._covariance[joint] = covariance - np.outer(gain, row @ covariance)
        self._update()

    def hang(self, load: Vector) -> None:
        """Expect a weight, too; load: (k,) kg m, its moments."""
        known = len(self._start)
        self._mean[:, :known] += load
        self._covariance[:, :known, :known] += PRIOR.load_share**2 * np.outer(load, load)  # one scale for all moments
        self._begin(self._start + load)

    @property
    def _moments(self) -> np.ndarray:
        return self._mean[:, :-2]

    def _sensitivity(self, theta: np.ndarray, direction: Vector | None) -> np.ndarray:
        """Return the torque (m, n, k + 2) per unit of moments, offset and spring."""
        rows = self.model.rows(theta, self.model.down(self.tilt) if direction is None else np.asarray(direction))
        return np.concatenate((rows, np.ones_like(rows[..., :1]), theta[..., None]), axis=-1)

    def _begin(self, moments: np.ndarray) -> None:
        """Take `moments` (k,) in kg m for those of the file's arm with its weight."""
        self._start, self._at_start = moments, self._rows @ moments  # kg m, and the Nm that they need
        self._size = np.sqrt(np.mean(self._at_start**2, axis=0))  # (n,) Nm, what a joint usually carries
        self._update()

    def _update(self) -> None:
        """Take over the mean."""
        self._springs = self._mean[:, -2:].tolist()
        self._arms = [self.model.holding(moments) for moments in self._moments]  # each for the torque of one joint
        now = np.einsum("njk,jk->nj", self._rows, self._moments)
        least = len(self._rows) * PRIOR.unexplained**2  # of a joint that carries nothing
        strength = (np.sum(now * self._at_start, axis=0) + least) / (np.sum(self._at_start**2, axis=0) + least)
        self.strength = np.clip(strength, *PRIOR.strength)

    def matrix(self, theta: Sequence[float], load: tuple[float, float]) -> np.ndarray:
        """Return an approximate mass matrix (n, n) in kg m^2 of the file's arm, each row times the joint's strength.

        theta: (n,) rad. load: a weight on the last link in kg, and its distance from the last joint in m.

        A torque that the joints share in another proportion than their motors give it turns light links against each
        other: with 1 kg and the arm abducted, joints 1 and 3 together carry 1 kg m^2, but 0.005 against each other.
        """
        return self.strength[:, None] * self.model.matrix(theta, load)


def guess_for(
    model: MomentModel, tilt: Tilt, load: tuple[float, float] = (0.0, 0.0), earlier: Sequence[Observation] = ()
) -> TorqueGuess:
    """Return what is known of an arm before a tour.

    load: a weight in kg, and its distance from the last joint in m.
    earlier: what other tours of it showed, of which those without a weight count.
    """
    guess = TorqueGuess(model, model.moments, tilt)
    for one in earlier:
        if not one.load_mass:
            guess.learn(one.theta, one.effort, one.spread, one.direction)
    guess.hang(model.load(*load))
    return guess


class Itinerary:
    """Visits given stations, then others until `count` poses are measured, each the one that shows the most.

    given: by default the hanging arm.
    duration: s, of the whole tour, which the choice keeps within.
    again: how many of the first poses are visited again at the end, to see whether anything has changed.
    """

    def __init__(
        self, limits: Limits, count: int, duration: float, given: Sequence[Station] = (), again: int = 0
    ) -> None:
        self._limits, self._most, self._duration = limits, count, duration
        self._home = hanging(limits)
        self._candidates: np.ndarray | None = None  # of the arm of which the torque is guessed
        stations = given or [self._home]
        self._again = again
        self.count, self._given = max(count, len(stations)) + again, iter(stations)

    def next(
        self, taken: np.ndarray, position: np.ndarray, elapsed: float, guess: TorqueGuess, friction: Vector
    ) -> Station | None:
        """Return the next of the given stations, then the best of the candidates that can be held and reached.

        taken: (m, n) rad, the poses measured so far.
        position: (n,) rad, where the arm is.
        elapsed: s since the start of the tour.
        friction: (n,) Nm, 0 if unknown.

        Returns None after the last; raises DataError if no pose can be held.
        """
        station = next(self._given, None)
        if station or len(taken) >= self._most + self._again:
            return station
        if len(taken) >= self._most:
            return Station(tuple(taken[len(taken) - self._most].tolist()))
        if self._candidates is None:
            self._candidates = candidates(self._limits, guess.model)
        way = self._candidates
        in_time = np.flatnonzero(self._is_in_time(way, self._most + self._again - len(taken), position, elapsed))
        room = self._room(way[in_time], position, guess, friction)
        if room.max() < 0.0:
            raise DataError("no further pose can be held within max_effort: is it too small for the arm?")
        possible = in_time[room >= min(CHOICE.deviations, math.floor(room.max()))]
        seen, down = list(taken) or [self._home.theta], guess.model.down(guess.tilt)
        index = possible[next_pose(seen, way[possible], down, guess.common_moments, guess.model)]
        pose = way[index]
        self._candidates = np.delete(way, index, axis=0)  # chosen once, even if a joint sticks there
        return Station(tuple(pose.tolist()))

    def _is_in_time(self, poses: np.ndarray, left: int, position: np.ndarray, elapsed: float) -> np.ndarray:
        """Return which of the `poses` (m, n) leave enough time for the others of the `left`, and for the way home."""
        home, way = (
            np.array([Line(pose, candidate).duration + MOTION.lead for candidate in poses])
            for pose in (np.array(self._home.theta), position)
        )
        budget = (self._duration - elapsed - home) / left
        sweeps = 2 * self._home.cycles * (Line(*self._home.ends, self._home.speed).duration + MOTION.lead)
        fits = way + sweeps <= budget * (CHOICE.time_share if left > 1 else 1.0)
        return np.asarray(fits if fits.any() else way + home <= (way + home).min() + 1.0)

    def _room(self, poses: np.ndarray, start: np.ndarray, guess: TorqueGuess, friction: Vector) -> np.ndarray:
        """Return the room (m,) that the motors have to hold `poses`, reach them from `start`, and leave them for home.

        It is in standard deviations of the expected torque, below 0 where they have none; on the way home the torque is
        known. friction: (n,) Nm, against which the arm is moved.
        """
        shares = np.linspace(0.0, 1.0, CHOICE.waypoints + 1)[1:, None, None]
        sweep = MOTION.amplitude * np.array((-1.0, 1.0))[:, None, None]
        start, home = start + shares * (poses - start), self._limits.home + shares * (poses - self._limits.home)
        mean, deviation = guess.torques(np.vstack((start, poses + sweep, home)).reshape(-1, len(self._limits.home)))
        most = CHOICE.effort_share * np.array(self._limits.max_effort) - [
            own or CHOICE.usual_friction for own in friction
        ]
        room = (
            ((most - np.abs(mean)) / np.maximum(deviation, CHOICE.least_deviation)).min(axis=1).reshape(-1, len(poses))
        )
        is_home = np.arange(len(room))[:, None] >= len(room) - len(home)
        return np.asarray(np.where(is_home & (room >= 0.0), np.inf, room).min(axis=0))


def hanging(limits: Limits, speed: float = 0.1, amplitude: float = MOTION.amplitude) -> Station:
    """Return the hanging arm, farther off the soft walls than other poses: friction is not known there at first."""
    low, high = measurable(limits, amplitude)
    return Station(
        tuple(np.clip(limits.home, low + CHOICE.first_edge, high - CHOICE.first_edge).tolist()), speed, amplitude
    )


def friction_stations(limits: Limits) -> list[Station]:
    """Return sweeps through the hanging arm at each speed; the first lets the controller learn the friction."""
    speeds = (0.1, *SWEEPS.speeds)
    amplitudes = np.clip(np.array(speeds) * SWEEPS.time, *SWEEPS.amplitude).tolist()
    return [hanging(limits, *sweep) for sweep in zip(speeds, amplitudes, strict=True)]


def candidates(limits: Limits, model: MomentModel) -> np.ndarray:
    """Return random poses (m, n) in rad within `limits` in which no link points far upwards.

    Above the shoulder gravity tips the arm over: what is wrong with the expected torque grows with each movement.
    """
    low, high = measurable(limits, MOTION.amplitude)
    poses = np.random.default_rng(1).uniform(low, high, (CHOICE.candidates, model.count))
    home = float(model.upwards(np.array([limits.home]))[0])  # a link may point upwards in every pose
    return np.asarray(poses[model.upwards(poses) <= max(CHOICE.most_upwards, home)])


def measurable(limits: Limits, amplitude: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest pose (n,) rad around which a sweep of `amplitude` rad stays off the soft walls."""
    margin = WALL.width + amplitude + CHOICE.edge
    return np.array(limits.position_min) + margin, np.array(limits.position_max) - margin


def next_pose(
    taken: Sequence[Vector], candidates: np.ndarray, direction: Vector, moments: Vector, model: MomentModel
) -> int:
    """Return the index of the candidate that adds the most information to the poses `taken`, by D-optimality.

    Of equal ones the first, on every computer: in an upright stand the angle of joint 1 changes nothing.

    taken: (n,) rad each, none at the start.
    candidates: (m, n) rad.
    direction: (3,), gravity's unit vector in the base frame.
    moments: (k,) kg m, a guess.
    """
    known = _before(model)
    seen = _sensitivity(np.reshape(taken, (-1, model.count)), direction, moments, model).reshape(-1, len(known))
    information = np.diag(known**-2.0) + seen.T @ seen
    rows = _sensitivity(candidates, direction, moments, model)
    added = np.eye(model.count) + rows @ np.linalg.inv(information) @ rows.transpose(0, 2, 1)
    return int(np.argmax(np.linalg.slogdet(added)[1].round(6)))


def missing_pose(hidden: np.ndarray, direction: Vector, model: MomentModel) -> str:
    """Return, in words, the suggested pose that shows most of the unknowns of which `hidden` (count,) are not known."""
    poses = model.suggested
    shown = _sensitivity(poses, direction, model.moments, model) * _before(model) * hidden
    best = poses[int(np.argmax((shown**2).sum(axis=(1, 2))))]
    return f"[{', '.join(f'{math.degrees(angle):.0f}' for angle in best)}] degrees"


def shown_by(model: MomentModel, poses: np.ndarray, direction: Vector) -> np.ndarray:
    """Return which of the unknowns (count,) `poses` (m, n) rad could show."""
    shown = _sensitivity(poses, direction, model.moments, model) * _before(model)
    return np.asarray(np.sqrt((shown**2).sum(axis=(0, 1))) > CHOICE.shown * math.sqrt(len(poses)))


def _before(model: MomentModel) -> np.ndarray:
    """Return the standard errors (count,) of an arm's unknowns before a pose is chosen."""
    error = np.full(layout_of(model).total, CHOICE.other)
    error[: len(model.names)] = CHOICE.moment
    return error


def _sensitivity(theta: np.ndarray, direction: Vector, moments: Vector, model: MomentModel) -> np.ndarray:
    """Return the derivative of the efforts in the poses (m, n) by the unknowns, by their noise: (m, n, count)."""
    at = layout_of(model)
    unknowns = np.append(moments, np.zeros(at.total - len(model.names)))
    rows = rows_at(model, theta, np.broadcast_to(direction, (len(theta), 3)))
    noise = np.hypot(CHOICE.noise, CHOICE.noise_share * rows.predicted(unknowns))
    return np.asarray(rows.jacobian(unknowns) / noise[..., None] * (np.arange(at.total) < at.tilt.start))
