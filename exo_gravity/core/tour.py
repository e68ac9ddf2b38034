"""The tour of a calibration: moves the arm slowly from pose to pose and measures what each of them needs to be held.

Pure: time is an argument. At each pose all joints sweep through it there and back: the mean of both directions is
gravity, half of the difference is friction. What was measured improves the expected torque, which carries the arm and
tells a hand on it from its weight. The tour begins and ends at the hanging arm; after trouble it withdraws its efforts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm import JOINT_COUNT
from exo_gravity.core.errors import DataError
from exo_gravity.core.gravity import Torque
from exo_gravity.core.identification import Observation
from exo_gravity.core.limits import Limits
from exo_gravity.core.tilt import Tilt
from exo_gravity.core.tour_average import Sweep, average
from exo_gravity.core.tour_control import MassMatrix, Tracker
from exo_gravity.core.tour_guess import TorqueGuess
from exo_gravity.core.tour_motion import Line, Station
from exo_gravity.core.tour_poses import Itinerary
from exo_gravity.core.tour_watch import Watch

SETTLING = 0.4  # s at rest before the first sweep of a pose
# rad behind the reference, from which on it slows down, and at which it stops and waits for the arm.
SLOW_ERROR, STOP_ERROR = 0.04, 0.08
STEADY_SPEED = 0.05  # rad/s of a sweep, from which on its friction is that of the motion between poses
DEVIATION_PERIOD = 0.1  # s between two estimates of how uncertain the expected torque is
ANGLE_STEP = 0.01  # rad, for the slope of the expected torque


class Measured(NamedTuple):
    """What was measured at a station; speed: rad/s, of the sweeps."""

    observation: Observation
    speed: float


class Tour:
    """One tour. Call `wait` for each joint state until the arm is carried, then `step`.

    measured: so far. trouble: why it ended early, or ''. done: whether the arm hangs again after the last pose.
    progress: what it does, as a sentence. elapsed: s since the first step.
    """

    def __init__(
        self, limits: Limits, guess: TorqueGuess, itinerary: Itinerary, rate: float, load: tuple[float, float] = (0, 0)
    ) -> None:
        self.measured: list[Measured] = []
        self.trouble = ""
        self.done = False
        self.progress = "waiting for the arm to be carried"
        self.elapsed = 0.0
        self._limits = limits
        self._guess = guess
        self._itinerary = itinerary
        self._load = load
        self._tracker = Tracker(rate, limits.max_effort)
        self._masses = self._mass_matrix()
        self._watch: Watch | None = None
        self._now = -math.inf
        self._line = Line(np.zeros(JOINT_COUNT), np.zeros(JOINT_COUNT))
        self._line_time = 0.0  # s
        self._pause = 0.0  # s after the line
        self._station: Station | None = None
        self._sweeps: list[Sweep] = []
        self._samples: list[tuple[Sequence[float], Torque]] = []
        self._directions: list[tuple[float, float, float]] = []
        self._knows_friction = False
        self._uncertain: Sequence[float] = (0.0,) * JOINT_COUNT
        self._uncertain_time = -math.inf
        self._effort: Torque = (0.0,) * JOINT_COUNT

    def wait(self, position: Sequence[float], tilt: Tilt) -> Torque:
        """Return the expected torque (4,) in Nm at `position` (4,) rad, while the arm is not yet carried."""
        self._guess.tilt = tilt
        return self._guess.torque(position)

    def step(self, now: float, position: Sequence[float], velocity: Sequence[float], tilt: Tilt) -> Torque | None:
        """Return the effort (4,) in Nm at `now` s, None after trouble.

        position, velocity: (4,), rad and rad/s. tilt: of the trunk or the stand.
        """
        if self.trouble:
            return None
        if self._watch is None:
            self._watch = Watch(self._limits.joint_names, self._limits.max_effort, tilt)
            self._now = now
            self._guess.tilt = tilt
            self._go_on(np.array(position))
        dt, self._now = now - self._now, now
        self.elapsed += dt
        self._guess.tilt = tilt
        if self._line_time > self._line.duration + self._pause:
            self._next_line()
        goal, heading = self._line.at(self._line_time)
        error = goal - position
        behind = float(np.abs(error).max())
        pace = max(0.0, min(1.0, (STOP_ERROR - behind) / (STOP_ERROR - SLOW_ERROR)))
        self._line_time += pace * dt
        self.trouble = self.trouble or self._watch.motion(dt, position, velocity, goal.tolist(), tilt)
        if not self.trouble:
            self._note(position, tilt)
            self._move(dt, position, velocity, error, heading, pace)
            self.trouble = self._check_torque(dt, position)
        return None if self.trouble else self._effort

    def _move(
        self,
        dt: float,
        position: Sequence[float],
        velocity: Sequence[float],
        error: np.ndarray,
        heading: np.ndarray,
        pace: float,
    ) -> None:
        expected, matrix = self._guess.torque(position), self._masses.at(position)
        self._effort = self._tracker.step(dt, error, pace * heading - velocity, heading, expected, matrix)

    def _check_torque(self, dt: float, position: Sequence[float]) -> str:
        watch, tracker = self._watch, self._tracker
        if watch is None:
            return ""
        if self._now - self._uncertain_time > DEVIATION_PERIOD:
            self._uncertain_time = self._now
            self._uncertain = self._guess.torques(np.array([position]))[1][0].tolist()
        return watch.saturation(tracker.saturated.tolist()) or watch.torque(
            dt, tracker.correction.tolist(), self._uncertain, tracker.friction.tolist()
        )

    def _note(self, position: Sequence[float], tilt: Tilt) -> None:
        """Keep the effort of the last cycle, which brought the arm to `position`."""
        if self._station and self._is_sweeping and self._line.is_measured(self._line_time):
            self._samples.append((tuple(position), self._effort))
            self._directions.append(tilt.direction)

    @property
    def _is_sweeping(self) -> bool:
        return self._pause == 0.0

    def _next_line(self) -> None:
        """Begin the next sweep, or after the last one the way to the next pose."""
        end = self._line.at(math.inf)[0]
        if self._station is None:
            if not self.done:
                self.done, self.progress = True, "done"
            return
        if self._is_sweeping:
            self._end_sweep()
            if self.trouble:
                return
        if len(self._sweeps) < 2 * self._station.cycles:
            target = self._station.low if len(self._sweeps) % 2 else self._station.high
            self._start(Line(end, target, self._station.speed), 0.0)
            return
        self._finish_station(self._station)
        if not self.trouble:
            self._go_on(end)

    def _end_sweep(self) -> None:
        position, effort = (np.array(column) for column in zip(*self._samples, strict=True))
        self._sweeps.append(Sweep(len(self._sweeps) % 2 == 0, position, effort))
        self._samples = []
        if not self._knows_friction and len(self._sweeps) == 2:
            # The first sweeps, without compensation of friction, only serve to find it.
            self._learn_friction(average(self._sweeps, self._slope()).friction)
            self._sweeps, self._directions = [], []

    def _learn_friction(self, friction: np.ndarray) -> None:
        self._tracker.friction = np.maximum(0.0, friction)
        self._knows_friction = True

    def _finish_station(self, station: Station) -> None:
        result = average(self._sweeps, self._slope())
        mean = np.mean(self._directions, axis=0)
        self._sweeps, self._directions = [], []
        if self._watch:
            rows = (result.unrest.tolist(), result.effort.tolist(), result.friction.tolist())
            self.trouble = self._watch.unrest(*rows)
        if self.trouble:
            return
        observation = Observation(
            result.theta,
            mean / np.linalg.norm(mean),
            result.effort,
            result.friction,
            result.spread,
            load_mass=self._load[0],
            load_lever=self._load[1],
        )
        self.measured.append(Measured(observation, station.speed))
        if station.speed >= STEADY_SPEED:
            self._learn_friction(result.friction)
        here = result.theta.tolist()
        before = self._guess.torque(here)
        self._guess.learn(result.theta, result.effort, result.spread)
        self._tracker.shift(np.subtract(self._guess.torque(here), before))
        self._masses = self._mass_matrix()

    def _mass_matrix(self) -> MassMatrix:
        return MassMatrix(self._guess.length, self._guess.common_moments[:JOINT_COUNT])

    def _slope(self) -> np.ndarray:
        """Return how the expected torque changes with the angles at the present pose, (4, 4) Nm/rad."""
        theta = np.array(self._station.theta if self._station else self._limits.home)
        steps = ANGLE_STEP * np.eye(JOINT_COUNT)
        after, before = (self._guess.torques(theta + sign * steps)[0] for sign in (1.0, -1.0))
        return np.asarray((after - before).T / (2.0 * ANGLE_STEP))

    def _go_on(self, position: np.ndarray) -> None:
        """Begin the way from `position` to the next pose, or home after the last."""
        taken = np.array([measured.observation.theta for measured in self.measured])
        try:
            self._station = self._itinerary.next(taken, self._guess, self._tracker.friction.tolist(), self.elapsed)
        except DataError as error:
            self.trouble = str(error)
            return
        number = f"{len(self.measured) + 1} of {self._itinerary.count}"
        if self._station:
            angles = " ".join(f"{math.degrees(angle):.0f}" for angle in self._station.theta)
            self.progress = f"pose {number}: {angles} deg"
            self._start(Line(position, self._station.low), SETTLING)
        else:
            self.progress = "back to the hanging arm"
            self._start(Line(position, np.array(self._limits.home)), SETTLING)

    def _start(self, line: Line, pause: float) -> None:
        self._line, self._line_time, self._pause = line, 0.0, pause
