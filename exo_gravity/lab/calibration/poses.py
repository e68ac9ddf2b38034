# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Which poses the calibration visits: given ones, or the most informative ones that the motors can hold.

What holds the arm is expected with a mean and a standard deviation for every pose: by the fit of what the tour, and
earlier ones, have measured so far. It starts from the parameter file's arm with a wide uncertainty.
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
from exo_gravity.lab.calibration.pose_fit import EXACT, columns, known_of, layout_of, rows_at, solve
from exo_gravity.lab.calibration.tracking import MOTION, Observation, Station


@dataclass(frozen=True)
class GuessTuning:
    """What the expected torque does not explain."""

    unexplained: float = 0.05  #: Nm: standard deviation of what no unknown explains,
    share: float = 0.03  #: of the torque, in addition: zeros and axes that are off
    #: of a joint: 30 % off in mass, centre of gravity and torque scale are 0.38 to 2.4 in one link, less in a whole arm
    strength: tuple[float, float] = (0.5, 2.0)


GUESS = GuessTuning()


@dataclass(frozen=True)
class PoseChoice:
    """Which poses may be visited, and which of them shows most."""

    candidates: int = 800  #: random poses, of which those above the horizontal are left out
    most_upwards: float = 0.3  #: sine of the largest angle above the horizontal, of links 3 and 4
    effort_share: float = 0.85  #: of max_effort that a pose may need
    deviations: float = 2.0  #: of the expected torque, that a pose must leave room for; less where none does
    least_deviation: float = 1e-9  #: Nm
    usual_friction: float = 0.5  #: Nm, until it is measured
    waypoints: int = 4  #: of the way to a pose, at which the motors must hold the arm too
    first_edge: float = 0.1  #: rad in addition, at the first pose
    edge: float = 0.02  #: rad between a sweep's end and the soft wall
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
    load: a weight in kg, and its distance from the last joint in m.
    seen: what this tour and earlier ones of the same arm have shown.

    moments: (k,) kg m, with the weight.
    """

    def __init__(
        self, model: MomentModel, load: tuple[float, float] = (0.0, 0.0), seen: Sequence[Observation] = ()
    ) -> None:
        self.model, self._load, self._at = model, load, layout_of(model, 0)
        known = known_of(model, None, False)
        for part in (self._at.angle, self._at.tilt, self._at.slope):
            known.error[part] = EXACT
        self._unknowns, self._covariance = known.start, np.diag(known.error**2)
        if seen:
            theta, direction, effort, spread = columns(seen)
            hung = np.array([model.load(one.load_mass, one.load_lever) for one in seen])
            rows = rows_at(model, theta, direction)._replace(load=hung)
            unexplained = np.hypot(GUESS.unexplained, GUESS.share * effort)
            fit = solve(rows, known, effort, np.hypot(spread, unexplained))
            self._unknowns, self._covariance = fit.unknowns, fit.covariance
        self.moments = self._unknowns[self._at.moment] + model.load(*load)
        self._share = np.exp(-self._unknowns[self._at.scale])  # commanded torque by torque
        self._arm = model.holding(self.moments)
        parts = (self._share, self._unknowns[self._at.spring], self._unknowns[self._at.offset])
        self._joints = list(zip(*(part.tolist() for part in parts), strict=True))
        self._strength = self._of_file()

    def _of_file(self) -> np.ndarray:
        """Return the commanded torque of each joint (n,) by that of the file's arm: its masses and its torque scale."""
        rows = np.moveaxis(self.model.along_axes(self.model.suggested), -1, 0)  # gravity from three sides
        rows = rows.reshape(-1, *rows.shape[2:])
        file, now = rows @ (self.model.moments + self.model.load(*self._load)), self._share * (rows @ self.moments)
        least = len(rows) * GUESS.unexplained**2  # of a joint that carries nothing
        strength = (np.sum(now * file, axis=0) + least) / (np.sum(file**2, axis=0) + least)
        return np.asarray(np.clip(strength, *GUESS.strength))

    def torque(self, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the expected torque (n,) in Nm at `theta` (n,) rad, in plain floats for the control loop."""
        joints = zip(self._arm.torque(theta, tilt), theta, self._joints, strict=True)
        return tuple([share * (own + k * angle) + offset for own, angle, (share, k, offset) in joints])

    def torques(self, theta: np.ndarray, direction: Vector) -> tuple[np.ndarray, np.ndarray]:
        """Return the expected torque and its standard deviation, both (m, n) Nm, at `theta` (m, n) rad.

        direction: (3,), gravity's unit vector in the base frame.
        """
        rows = rows_at(self.model, theta, np.broadcast_to(direction, (len(theta), 3)))
        rows = rows._replace(load=rows.load + self.model.load(*self._load))
        jacobian = rows.jacobian(self._unknowns)
        variance = np.einsum("mnt,mnt->mn", jacobian @ self._covariance, jacobian)
        return rows.predicted(self._unknowns), np.sqrt(np.maximum(variance, 0.0))

    def matrix(self, theta: Sequence[float]) -> np.ndarray:
        """Return an approximate mass matrix (n, n) in kg m^2 of the file's arm, each row times the joint's strength.

        theta: (n,) rad.

        A torque that the joints share in another proportion than their motors give it turns light links against each
        other: with 1 kg and the arm abducted, joints 1 and 3 together carry 1 kg m^2, but 0.005 against each other.
        """
        return self._strength[:, None] * self.model.matrix(theta, self._load)


class Itinerary:
    """Visits given stations, then others until `count` poses are measured, each the one that shows the most.

    given: by default the hanging arm.
    again: how many of the first poses are visited again at the end, to see whether anything has changed.
    """

    def __init__(self, limits: Limits, count: int, given: Sequence[Station] = (), again: int = 0) -> None:
        self._limits, self._most, self._again = limits, count, again
        self._home = hanging(limits)
        self._candidates: np.ndarray | None = None  # of the arm of which the torque is guessed
        stations = given or [self._home]
        self.count, self._given = max(count, len(stations)) + again, iter(stations)

    def next(
        self, taken: np.ndarray, position: np.ndarray, guess: TorqueGuess, down: np.ndarray, friction: Vector
    ) -> Station | None:
        """Return the next of the given stations, then the best of the candidates that can be held and reached.

        taken: (m, n) rad, the poses measured so far.
        position: (n,) rad, where the arm is.
        down: (3,), gravity's unit vector in the base frame.
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
        room = self._room(self._candidates, position, guess, down, friction)
        if room.max() < 0.0:
            raise DataError("no further pose can be held within max_effort: is it too small for the arm?")
        possible = np.flatnonzero(room >= min(CHOICE.deviations, math.floor(room.max())))
        seen = list(taken) or [self._home.theta]
        index = possible[next_pose(seen, self._candidates[possible], down, guess.moments, guess.model)]
        pose = self._candidates[index]
        self._candidates = np.delete(self._candidates, index, axis=0)  # chosen once, even if a joint sticks there
        return Station(tuple(pose.tolist()))

    def _room(
        self, poses: np.ndarray, start: np.ndarray, guess: TorqueGuess, down: np.ndarray, friction: Vector
    ) -> np.ndarray:
        """Return the room (m,) that the motors have to hold `poses`, reach them from `start`, and leave them for home.

        It is in standard deviations of the expected torque, below 0 where they have none. friction: (n,) Nm, against
        which the arm is moved.
        """
        shares = np.linspace(0.0, 1.0, CHOICE.waypoints + 1)[1:, None, None]
        sweep = MOTION.amplitude * np.array((-1.0, 1.0))[:, None, None]
        start, home = start + shares * (poses - start), self._limits.home + shares * (poses - self._limits.home)
        ways = np.vstack((start, poses + sweep, home))
        mean, deviation = guess.torques(ways.reshape(-1, len(self._limits.home)), down)
        slide = [own or CHOICE.usual_friction for own in friction]
        most = CHOICE.effort_share * np.array(self._limits.max_effort) - slide
        room = (most - np.abs(mean)) / np.maximum(deviation, CHOICE.least_deviation)
        return np.asarray(room.min(axis=1).reshape(len(ways), -1).min(axis=0))


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
    poses, known = model.suggested, _before(model)
    shown = _sensitivity(poses, direction, model.moments, model) * known * hidden[: len(known)]
    best = poses[int(np.argmax((shown**2).sum(axis=(1, 2))))]
    return f"[{', '.join(f'{math.degrees(angle):.0f}' for angle in best)}] degrees"


def shown_by(model: MomentModel, poses: np.ndarray, direction: Vector) -> np.ndarray:
    """Return which of the moments, torque scales and offsets `poses` (m, n) rad could show."""
    shown = _sensitivity(poses, direction, model.moments, model) * _before(model)
    return np.asarray(np.sqrt((shown**2).sum(axis=(0, 1))) > CHOICE.shown * math.sqrt(len(poses)))


def _before(model: MomentModel) -> np.ndarray:
    """Return the standard errors of an arm's moments, torque scales and offsets before a pose is chosen."""
    return np.repeat((CHOICE.moment, CHOICE.other), (len(model.names), 2 * model.count))


def _sensitivity(theta: np.ndarray, direction: Vector, moments: Vector, model: MomentModel) -> np.ndarray:
    """Return the derivative of the efforts in the poses (m, n) by these unknowns, by their noise: (m, n, count)."""
    rows = rows_at(model, theta, np.broadcast_to(direction, (len(theta), 3)))
    unknowns = np.append(moments, np.zeros(rows.layout.total - len(model.names)))
    noise = np.hypot(CHOICE.noise, CHOICE.noise_share * rows.predicted(unknowns))
    return np.asarray(rows.jacobian(unknowns)[..., : rows.layout.offset.stop] / noise[..., None])
