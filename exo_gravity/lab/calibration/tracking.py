# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How the calibration moves the arm, slowly along straight lines in joint space, and what a pose's sweeps show.

All joints sweep through a pose there and back. At the same angle the torque of the way there is gravity plus friction,
that of the way back gravity minus friction.

The arm follows a slow reference by expected gravity torque, friction, and a PID controller in joint space. Its output
is an acceleration, which the arm's approximate mass matrix turns into torques: so each joint has the natural
frequency that it is given, however they are coupled.

Behind an elastic joint the links no longer hold the rotor: above their resonance the controller moves the rotor alone,
which has 1 to 20 % of the inertia that the gains are for. An AK60-6 on 1,000 Nm/rad rings at 170 Hz, beyond what 250 Hz
sample. So the gains are low, and pass a low-pass filter which leaves nothing of them at the rotor's frequencies. Where
a motor vibrates all the same, its own become lower.
"""

import math
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.numbers import Torque, Vector


@dataclass(frozen=True)
class MotionTuning:
    """How the arm moves along a line and through a pose."""

    speed: float = 0.3  #: rad/s, the most of any joint
    acceleration: float = 0.5  #: rad/s^2
    amplitude: float = 0.06  #: rad, of a sweep on each side of its pose
    window: float = 0.55  #: of a sweep's amplitude: the part on both sides of the pose that is measured
    followed: float = 0.5  #: of this part, that each joint must follow in a valid sweep
    lead: float = 0.3  #: s at rest before each motion, in which the joints are brought to the edge of moving
    bins: int = 4  #: of each sweep: neighbouring samples share the slow oscillations of the controller
    #: Nm: standard error that is left of the 12-bit torque command (7.3 mNm per code) after averaging
    resolution: float = 0.002


@dataclass(frozen=True)
class TrackerTuning:
    """The PID controller and the friction compensation of `Tracker`."""

    #: kg m^2 at each joint: with it 1 kg on link 4 at 100 Hz is carried without sticking (measured)
    added: float = 0.005
    #: natural frequency in rad/s per control cycle per s; two cycles of delay cost 27 degrees
    frequency_per_rate: float = 0.12
    max_frequency: float = 8.0  #: rad/s
    calm: float = 0.6  #: s for which a motor may vibrate, before its frequency becomes
    softer: float = 0.7  #: of what it was
    slowest: float = 0.1  #: rad/s: the speed falls to it with the frequency, as the integral part is slower, too
    least_frequency: float = 2.5  #: rad/s: 0.6 kg m^2 on 150 Nm/rad oscillate with 5, at 10 Hz (measured)
    #: times the frequency, where the low-pass filter of the gains begins: three of them in a row cost 35 degrees where
    #: the gain is 1, and leave 3 % of it at twice the frequency that the filter begins with
    filtered_from: float = 10.0
    filter_order: int = 3  #: of first-order filters in a row
    swing: float = 0.07  #: rad/s off a motor's mean speed, on both sides: three steps of its 12 bits
    mean_speed: float = 0.04  #: s, time constant of that mean
    slowest_swing: float = 0.06  #: s from one side to the other; the controller's own motion is slower
    swings: int = 6  #: in a row, which are a vibration: a joint that leaves its friction swings twice
    integral_share: float = 0.4  #: of the frequency, at which the integral part acts; unstable from 2 on
    #: times the smallest inertia in any direction, that the integral part adds in all. Without it, two joints that
    #: stick on opposite sides of their path would cancel each other's integral where the inertia of both is small.
    floor: float = 2.0
    usual_friction: float = 0.15  #: Nm, until it is measured
    friction_rate: float = 6.0  #: of the friction, per s: at once, a joint that rests within its friction would jump
    ahead: float = 0.003  #: rad ahead of the reference, from which on no more friction is compensated;
    faster: float = 0.03  #: rad/s, the same of the speed
    slow_error: float = 0.04  #: rad behind the reference, from which on it slows down,
    stop_error: float = 0.08  #: and at which it waits
    full_friction_speed: float = 0.03  #: rad/s of the reference, from which on friction is compensated fully


MOTION, TRACKER = MotionTuning(), TrackerTuning()


class Observation(NamedTuple):
    """One pose, passed in both directions of motion."""

    theta: Vector  #: (n,) rad
    direction: Vector  #: (3,), gravity's unit vector in the base frame
    effort: Vector  #: (n,) Nm as commanded, mean of both directions
    friction: Vector  #: (n,) Nm, half of their difference
    spread: Vector  #: (n,) Nm, standard error of `effort`
    load_mass: float = 0.0  #: kg, a weight on link 4; 0 for none
    load_lever: float = 0.0  #: m, its distance from the elbow
    speed: float | Vector = 0.0  #: rad/s at which the joints passed the pose, one for all or (n,)
    temperature: Vector = ()  #: (n,) degC of the motors; () if not known


class Sweep(NamedTuple):
    """The n samples of one way through a pose."""

    position: np.ndarray  #: (n, 4) rad
    effort: np.ndarray  #: (n, 4) Nm; the part beyond what is expected at each angle can be given in its place
    direction: np.ndarray  #: (n, 3), gravity's unit vectors in the base frame


class Station(NamedTuple):
    """A pose that is measured while all joints sweep through it `cycles` times, there and back."""

    theta: tuple[float, ...]  #: (n,) rad
    speed: float = 0.1  #: rad/s, of the sweep
    amplitude: float = MOTION.amplitude  #: rad, on each side of the pose
    cycles: int = 2

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the sweep begins and where it turns back, (n,) rad each."""
        return np.array(self.theta) - self.amplitude, np.array(self.theta) + self.amplitude


class Line:
    """The motion from `start` to `end`, (n,) rad; the joint with the longest way turns at `speed` rad/s at most.

    duration: s. way: (n,), in which each joint turns, -1, 0 or 1. speed: rad/s, of the joint with the longest way.
    """

    def __init__(self, start: np.ndarray, end: np.ndarray, speed: float = MOTION.speed) -> None:
        self._start = np.asarray(start, dtype=float)
        way = np.asarray(end, dtype=float) - self._start
        self._length = float(np.abs(way).max())
        self._heading, self.way = way / self._length if self._length else way, np.sign(way)
        self.speed = min(speed, MOTION.speed, math.sqrt(self._length * MOTION.acceleration))
        self._ramp = self.speed / MOTION.acceleration
        self.duration = self._length / self.speed + self._ramp if self._length else 0.0

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position (n,) rad and velocity (n,) rad/s at `time` s after the start."""
        time = min(max(time, 0.0), self.duration)
        rising, falling = min(time, self._ramp), max(0.0, time - self.duration + self._ramp)
        travelled = MOTION.acceleration * (rising**2 - falling**2) / 2 + self.speed * (time - rising)
        return self._start + travelled * self._heading, MOTION.acceleration * (rising - falling) * self._heading

    def is_measured(self, time: float) -> bool:
        """Return whether the motion is in its middle, within `window` of the half length at steady speed."""
        is_steady = self._ramp <= time <= self.duration - self._ramp
        return is_steady and abs(time - self.duration / 2.0) * self.speed <= MOTION.window * self._length / 2.0


def average(sweeps: Sequence[Sweep]) -> tuple[Observation, np.ndarray]:
    """Return what `sweeps` show at a pose, and the largest change (n,) in Nm of the effort from one cycle to another.

    They alternate between there and back. What is expected at an angle should be subtracted from the effort: the rest
    does not change along a sweep (gravity does, and by up to 0.3 % more than in proportion).
    """
    count = sweeps[0].effort.shape[-1]
    bins = np.zeros((len(sweeps), MOTION.bins, count))  # mean effort in order of the angle
    for number, sweep in enumerate(sweeps):
        effort = sweep.effort[::-1] if number % 2 else sweep.effort
        bins[number] = [part.mean(axis=0) for part in np.array_split(effort, MOTION.bins)]
    there, back = bins[0::2], bins[1::2]
    gravity = (there + back) / 2.0
    cycles = gravity.mean(axis=1)
    friction = (there - back).mean(axis=(0, 1)) / 2.0
    scatter = gravity.reshape(-1, count).std(axis=0, ddof=1) / np.sqrt(max(1.0, gravity[..., 0].size / 2.0))
    theta = np.mean([sweep.position.mean(axis=0) for sweep in sweeps], axis=0)
    direction = mean_direction(np.concatenate([sweep.direction for sweep in sweeps]))
    seen = Observation(theta, direction, cycles.mean(axis=0), friction, np.hypot(scatter, MOTION.resolution))
    return seen, np.ptp(cycles, axis=0)


def mean_direction(directions: np.ndarray) -> np.ndarray:
    """Return the mean (3,) of unit vectors (n, 3), of length 1."""
    mean = directions.mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def followed(sweeps: Sequence[Sweep], station: Station) -> np.ndarray:
    """Return the share (n,) of the measured way that each joint went in every one of `sweeps` through `station`."""
    ways = np.min([np.abs(sweep.position[-1] - sweep.position[0]) for sweep in sweeps], axis=0)
    return np.asarray(ways / (2.0 * MOTION.window * station.amplitude))


class Vibration:
    """Sees motors whose speeds swing from side to side faster than any joint is moved. count: of motors.

    speed: (n,) rad/s, their mean.
    """

    def __init__(self, count: int) -> None:
        self.speed = np.zeros(count)
        self._side = np.zeros(count)
        self._since = np.zeros(count)  # s
        self._swings = np.zeros(count)

    def step(self, dt: float, velocity: Vector) -> np.ndarray:
        """Return which motors (n,) vibrate; velocity: (n,) rad/s, `dt` s after the last."""
        self.speed = self.speed + (1.0 - math.exp(-dt / TRACKER.mean_speed)) * (velocity - self.speed)
        off = velocity - self.speed
        side = np.where(np.abs(off) > TRACKER.swing, np.sign(off), 0.0)
        is_turned = side * self._side < 0.0
        self._side = np.where(side, side, self._side)
        self._since = np.where(is_turned, 0.0, self._since + dt)
        goes_on = self._since <= TRACKER.slowest_swing
        self._swings = np.where(goes_on, self._swings + is_turned, 0.0)
        return np.asarray(self._swings >= TRACKER.swings)


class Tracker:
    """Moves all joints along lines, one after the other, and takes the samples of sweeps.

    rate: control cycles per s.
    max_effort: (n,) Nm.

    lines: to follow, each taken when it begins; the owner sets them before the first step.
    friction: (n,) Nm, compensated in the direction of motion, as far as the owner knows it.
    saturated: (n,) s for which each joint has wanted more than its `max_effort`.
    error: (n,) rad by which the arm is behind its path.
    correction: (n,) Nm, what the controller added to gravity and friction in the last step.
    frequency: (n,) rad/s, of each joint under the present gains.
    vibration: of the motors. vibrating: (n,) s for which each joint's motor has vibrated under these gains.
    is_softened: whether gains were lowered because a motor vibrated.
    """

    def __init__(self, rate: float, max_effort: Sequence[float]) -> None:
        count = len(max_effort)
        self.friction = np.full(count, TRACKER.usual_friction)
        self.saturated = np.zeros(count)
        self.error = np.zeros(count)
        self.correction = np.zeros(count)
        self.vibrating = np.zeros(count)
        self.is_softened = False
        self.vibration = Vibration(count)
        self.frequency = np.full(count, min(TRACKER.max_frequency, TRACKER.frequency_per_rate * rate))
        self._filter = np.zeros((TRACKER.filter_order, count))  # Nm, what each filter passes
        self._max_effort = np.array(max_effort)
        self._integral = np.zeros(count)
        self._slide = np.zeros(count)  # Nm that compensate friction
        self._effort: Torque = (0.0,) * count
        self.lines: Iterator[Line] = iter(())
        self._line = Line(self.error, self.error)
        self._time = math.inf  # s, on the present line; it is over
        self._samples: list[tuple[Vector, np.ndarray, Vector]] | None = None  # of the present sweep

    def sweep(self, station: Station) -> Generator[Line, None, list[Sweep]]:
        """Yield the ways through `station`, there and back; return their samples, without the expected torque."""
        sweeps, (low, high) = list[Sweep](), station.ends
        for ends in ((low, high), (high, low)):
            self._samples = []
            yield Line(*ends, station.speed)
            sweeps.append(Sweep(*map(np.array, zip(*self._samples, strict=True))))
        self._samples = None
        return sweeps

    def shift(self, change: np.ndarray) -> None:
        """Take over a `change` (n,) Nm of the expected torque, so that the effort does not step."""
        self._integral -= change

    def step(
        self, dt: float, position: Vector, velocity: Vector, expected: Torque, direction: Vector, matrix: np.ndarray
    ) -> Torque:
        """Return the effort (n,) in Nm, `dt` s after the last one.

        position, velocity: (n,), rad and rad/s. expected: (n,) Nm, gravity's torque. direction: (3,), of gravity, for
        the samples. matrix: (4, 4) kg m^2, the approximate mass matrix.
        """
        if self._time > self._line.duration:
            self._line, self._time = next(self.lines), -MOTION.lead
        goal, heading = self._line.at(self._time)
        self.error = goal - position
        # The path does not wait for a joint that is ahead: it would not come back against its friction.
        behind = float(np.where(self._line.way, self.error * self._line.way, np.abs(self.error)).max())
        pace = max(0.0, min(1.0, (TRACKER.stop_error - behind) / (TRACKER.stop_error - TRACKER.slow_error)))
        fastest = max(TRACKER.slowest, MOTION.speed * float(self.frequency.min()) / TRACKER.max_frequency)
        pace = min(pace, fastest / self._line.speed) if self._line.duration else pace
        self._time += pace * dt
        if self._samples is not None and self._line.is_measured(self._time):
            # The effort of the last cycle brought the arm here.
            self._samples.append((position, np.subtract(self._effort, expected), direction))
        # Friction is compensated before the motion begins: a joint that breaks away late would jump.
        coming = self._line.at(self._time + MOTION.lead)[1] if self._time < MOTION.lead else heading
        speed_error = pace * heading - velocity
        self.vibrating = np.where(self.vibration.step(dt, velocity), self.vibrating + dt, 0.0)
        too_stiff = (self.vibrating > TRACKER.calm) & (self.frequency > TRACKER.least_frequency)
        self.frequency = np.where(too_stiff, TRACKER.softer, 1.0) * self.frequency
        self.vibrating[too_stiff] = 0.0
        self.is_softened |= bool(np.any(too_stiff))
        self._compensate_friction(dt, coming, speed_error)
        self._effort = self._controlled(dt, speed_error, expected, matrix + TRACKER.added * np.eye(len(matrix)))
        return self._effort

    def _compensate_friction(self, dt: float, heading: np.ndarray, speed_error: np.ndarray) -> None:
        """Compensate friction by and by towards `heading` (n,) rad/s, and no further in a joint that is ahead."""
        most, way = TRACKER.friction_rate * self.friction * dt, np.sign(heading)
        wanted = self.friction * np.clip(heading / TRACKER.full_friction_speed, -1.0, 1.0)
        change = np.clip(wanted - self._slide, -most, most)
        is_ahead = (self.error * way < -TRACKER.ahead) | (speed_error * way < -TRACKER.faster)
        self._slide += np.where(is_ahead & (change * way > 0.0), 0.0, change)

    def _controlled(self, dt: float, speed_error: np.ndarray, expected: Torque, matrix: np.ndarray) -> Torque:
        frequency, weakest = self.frequency, float(np.linalg.eigvals(matrix).real.min())
        root, stiff = np.sqrt(frequency), frequency * (matrix @ (frequency * self.error))
        push = self._filtered(dt, stiff + 2.0 * root * (matrix @ (root * speed_error)))
        floor = TRACKER.floor * weakest * self.error * frequency**2
        integral = self._integral + TRACKER.integral_share * frequency * dt * (stiff + floor)
        torque = expected + self._slide + push + integral
        is_saturated = np.abs(torque) > self._max_effort
        self.saturated = np.where(is_saturated, self.saturated + dt, 0.0)
        # Without this the integral would wind up.
        self._integral = np.where(is_saturated & (torque * self.error > 0.0), self._integral, integral)
        self.correction = push + self._integral
        return tuple(np.clip(torque, -self._max_effort, self._max_effort).tolist())

    def _filtered(self, dt: float, push: np.ndarray) -> np.ndarray:
        """Return `push` (n,) Nm without what a rotor could vibrate with."""
        passed = 1.0 - np.exp(-TRACKER.filtered_from * self.frequency * dt)
        for stage in self._filter:
            stage += passed * (push - stage)
            push = stage
        return push.copy()
