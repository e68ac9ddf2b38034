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

from exo_gravity.core.calibration.guess import TorqueGuess
from exo_gravity.core.calibration.identification import Observation
from exo_gravity.core.calibration.motion import LEAD, Line, Station
from exo_gravity.core.calibration.poses import Itinerary, Progress
from exo_gravity.core.calibration.tracking import MassMatrix, Tracker
from exo_gravity.core.calibration.visit import FOLLOWED, Visit
from exo_gravity.core.calibration.watch import Watch
from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.limits import Limits

SETTLING = 0.1  # s at rest after the way to a pose
# rad behind the reference, from which on it slows down, and at which it stops and waits for the arm.
SLOW_ERROR, STOP_ERROR = 0.04, 0.08
MAX_SKIPPED = 2  # poses in which a joint may stick
STEADY_SPEED = 0.05  # rad/s of a sweep, from which on its friction is that of the motion between poses
REFRESH_PERIOD = 0.1  # s between two estimates of the mass matrix, and of how uncertain the expected torque is
ANGLE_STEP = 0.01  # rad, for the slope of the expected torque


class Measured(NamedTuple):
    """What was measured at a station; speed: rad/s, of the sweeps."""

    observation: Observation
    speed: float


class Tour:
    """One tour. Call `wait` for each joint state until the arm is carried, then `step`; and `plan` again and again.

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
        self._most = np.array(limits.max_effort)
        self._tracker = Tracker(rate, limits.max_effort)
        self._masses = self._mass_matrix()
        self._matrix = np.eye(JOINT_COUNT)
        self._watch = Watch(limits.joint_names, limits.max_effort, guess.tilt)
        self._now = -math.inf
        self._line = Line(np.zeros(JOINT_COUNT), np.zeros(JOINT_COUNT))
        self._line_time = 0.0  # s
        self._pause = 0.0  # s after the line
        self._skipped = 0  # poses
        self._awaits_plan = False
        self._plan: tuple[Station | None, str] | None = None  # the next pose, None for home, or why there is none
        self._is_sweeping = False
        self._visit: Visit | None = None
        self._friction = [0.0] * JOINT_COUNT  # Nm, 0 until it is measured
        self._uncertain: Sequence[float] = (0.0,) * JOINT_COUNT
        self._refreshed = -math.inf
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
        if self.done:  # the bridge lets the arm down: it is no longer watched
            torque = self._guess.torque(position) + self._tracker.correction
            return tuple(np.clip(torque, -self._most, self._most).tolist())
        if self._now == -math.inf:
            self._watch = Watch(self._limits.joint_names, self._limits.max_effort, tilt)
            self._now = now
            self._guess.tilt = tilt
            self._await_plan(np.array(position))
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
            if self._visit and self._is_sweeping and self._line.is_measured(self._line_time):
                self._visit.note(position, self._effort, tilt.direction)  # the effort of the last cycle
            # Friction is compensated before the motion begins: a joint that breaks away late would jump.
            coming = self._line.at(self._line_time + LEAD)[1] if self._line_time < LEAD else heading
            self.trouble = self._carry(dt, position, pace * heading - velocity, error, coming)
        return None if self.trouble else self._effort

    def _carry(
        self, dt: float, position: Sequence[float], speed_error: np.ndarray, error: np.ndarray, heading: np.ndarray
    ) -> str:
        """Set the effort of this cycle; return what is wrong with it, or ''."""
        tracker, watch = self._tracker, self._watch
        if self._now - self._refreshed > REFRESH_PERIOD:
            self._refreshed = self._now
            self._uncertain = self._guess.torques(np.array([position]))[1][0].tolist()
            self._matrix = self._masses.at(position)
        self._effort = tracker.step(dt, error, speed_error, heading, self._guess.torque(position), self._matrix)
        rows = (tracker.correction.tolist(), self._uncertain, self._friction)
        return watch.saturation(tracker.saturated.tolist()) or watch.torque(dt, *rows)

    def _next_line(self) -> None:
        """Begin the next sweep, or after the last one the way to the next pose."""
        end = self._line.at(math.inf)[0]
        if self._awaits_plan:
            if self._plan:
                self._go_on(end, *self._plan)
            return
        if self._visit is None:
            if not self.done:
                self.done, self.progress = True, "done"
            return
        if self._is_sweeping:
            self._end_sweep(self._visit)
            if self._visit.has_failed:
                self._skip(self._visit)
        if self._visit.is_complete and not self.trouble:
            self._finish(self._visit)
        if self.trouble:
            return
        if self._visit.is_complete or self._visit.has_failed:
            self._await_plan(end)
        else:
            self._start(self._visit.line, 0.0, is_sweeping=True)

    def _skip(self, visit: Visit) -> None:
        """Leave out a pose in which a joint sticks; the tour ends if that happens often."""
        self._skipped += 1
        if self._skipped > MAX_SKIPPED:
            joint, share = min(visit.stuck_joints.items(), key=lambda item: item[1])
            name = self._limits.joint_names[joint]
            self.trouble = f"{name}: it sticks: it follows {share:.0%} of a slow motion, must be {FOLLOWED:.0%}"

    def _end_sweep(self, visit: Visit) -> None:
        """Improve what is known of friction; sweeps without it, and those that a joint did not follow, do not count."""
        friction = visit.end_sweep()
        if friction is None:
            return
        was_known, stuck = any(self._friction), visit.stuck_joints
        if visit.station.speed >= STEADY_SPEED:
            self._friction = np.maximum(np.maximum(0.0, friction), self._friction if stuck else 0.0).tolist()
            self._tracker.friction = np.array(self._friction)
        if stuck or not was_known:
            visit.start_again(failed=bool(stuck))

    def _finish(self, visit: Visit) -> None:
        """Keep what was measured, and improve the expected torque with it."""
        theta, effort, friction, spread, unrest = visit.result()
        self.trouble = self._watch.unrest(unrest.tolist(), effort.tolist(), friction.tolist())
        if self.trouble:
            return
        observation = Observation(theta, visit.direction, effort, friction, spread, *self._load)
        self.measured.append(Measured(observation, visit.station.speed))
        here = theta.tolist()
        before = self._guess.torque(here)
        self._guess.learn(theta, effort, spread)
        self._tracker.shift(np.subtract(self._guess.torque(here), before))
        self._masses = self._mass_matrix()

    def _mass_matrix(self) -> MassMatrix:
        return MassMatrix(self._guess.length, self._guess.common_moments[:JOINT_COUNT], self._load)

    def _shape(self, station: Station) -> tuple[np.ndarray, np.ndarray]:
        """Return how the expected torque changes at a station: slope and bend, as for `average`."""
        steps = ANGLE_STEP * np.eye(JOINT_COUNT)
        torque = self._guess.torques
        after, before = (torque(np.array(station.theta) + sign * steps)[0] for sign in (1.0, -1.0))
        low, middle, high = torque(np.array(station.theta) + ANGLE_STEP * np.array(((-1.0,), (0.0,), (1.0,))))[0]
        return (after - before).T / (2.0 * ANGLE_STEP), (low - 2.0 * middle + high) / ANGLE_STEP**2

    def plan(self) -> None:
        """Choose the next pose if one is due. It takes 0.1 s and more: not on the thread of `step`."""
        if not self._awaits_plan or self._plan:
            return
        taken = np.array([measured.observation.theta for measured in self.measured]).reshape(-1, JOINT_COUNT)
        progress = Progress(self._line.at(math.inf)[0], self.elapsed)
        try:
            self._plan = (self._itinerary.next(taken, progress, self._guess, self._friction), "")
        except ExoGravityError as error:
            self._plan = (None, str(error))

    def _await_plan(self, position: np.ndarray) -> None:
        """Hold the arm at `position` until the next pose is chosen."""
        self._visit = None
        self._start(Line(position, position), 0.0)
        self._plan = None
        self._awaits_plan = True

    def _go_on(self, position: np.ndarray, station: Station | None, trouble: str) -> None:
        """Begin the way from `position` to the next pose, or home after the last."""
        self._awaits_plan = False
        self.trouble = trouble
        if station:
            angles = " ".join(f"{math.degrees(angle):.0f}" for angle in station.theta)
            self.progress = f"pose {len(self.measured) + 1} of {self._itinerary.count}: {angles} deg"
            self._visit = Visit(station, *self._shape(station))
            self._start(Line(position, station.low), SETTLING)
        else:
            self._visit, self.progress = None, "back to the hanging arm"
            self._start(Line(position, np.array(self._limits.home)), SETTLING)

    def _start(self, line: Line, pause: float, is_sweeping: bool = False) -> None:
        self._line, self._line_time, self._pause, self._is_sweeping = line, -LEAD, pause, is_sweeping
