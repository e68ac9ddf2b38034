"""The tour of a calibration: moves the arm slowly from pose to pose and measures what each of them needs to be held.

Pure: time is an argument. At each pose all joints sweep through it there and back: the mean of both directions is
gravity, half of the difference is friction. What was measured improves the expected torque, which carries the arm and
distinguishes a hand on it from its weight. The tour begins and ends at the hanging arm; after trouble it withdraws its
efforts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from exo_gravity.core.calibration.identification import Observation
from exo_gravity.core.calibration.motion import FOLLOWED, LEAD, Line, Station, Visit
from exo_gravity.core.calibration.poses import Itinerary
from exo_gravity.core.calibration.tracking import TorqueGuess, Tracker, inertia_of
from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.model.kinematics import LinkInertia
from exo_gravity.core.model.tilt import Tilt, angle_between
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.limits import Limits

SETTLING = 0.1  # s at rest after the way to a pose
# rad behind the reference, from which on it slows down, and at which it stops and waits for the arm.
SLOW_ERROR, STOP_ERROR = 0.04, 0.08
MAX_SKIPPED = 2  # poses in which a joint may stick
STEADY_SPEED = 0.05  # rad/s of a sweep, from which on its friction is that of the motion between poses
REFRESH_PERIOD = 0.1  # s between two estimates of the mass matrix, and of how uncertain the expected torque is
ANGLE_STEP = 0.01  # rad, for the slope of the expected torque
# What stops a tour.
MAX_ERROR = 0.12  # rad between a joint and the slow reference
FASTEST = 1.0  # rad/s of a joint; a light joint that leaves its friction reaches 0.5
MAX_CORRECTION = 0.5  # Nm, of the controllers, in addition to what is unknown of weight and friction
DEVIATIONS = 3.0  # of the expected torque
UNKNOWN_FRICTION = 1.0  # Nm, until it is measured
PERSISTENCE = 0.25  # s for which a torque must be unexplained
SATURATION = 0.1  # s for which a joint may want more than its max_effort
MAX_GAP = 0.1  # s between two joint states; as long as can_bridge's longest time-out
MAX_TILT = 0.1  # rad by which the stand or the trunk may tilt during the tour
MAX_UNREST = (0.12, 0.25, 0.05)  # Nm, share of friction, share of the torque: between two passes of the same pose


class TourWatch:
    """Finds the first trouble of a tour, as a sentence that names joint, value and limit; '' while all is well.

    tilt: of the trunk or the stand at the start.
    """

    def __init__(self, limits: Limits, tilt: Tilt) -> None:
        self._names = limits.joint_names
        self._max_effort = limits.max_effort
        self._tilt = tilt
        self._unexplained = [0.0] * JOINT_COUNT  # s

    def motion(
        self, dt: float, position: Sequence[float], velocity: Sequence[float], wanted: Sequence[float], tilt: Tilt
    ) -> str:
        """Return what is wrong with the motion: position, wanted (4,) rad, velocity (4,) rad/s, after `dt` s."""
        if dt > MAX_GAP:
            return f"no joint states for {dt * 1000:.0f} ms, the limit is {MAX_GAP * 1000:.0f}: is a motor silent?"
        if (moved := angle_between(tilt.direction, self._tilt.direction)) > MAX_TILT:
            return f"the trunk tilted by {moved:.2f} rad during the measurement, the limit is {MAX_TILT:g}"
        for name, angle, speed, goal in zip(self._names, position, velocity, wanted, strict=True):
            if not abs(goal - angle) <= MAX_ERROR:
                reason = "a hand is on the arm, or the joint is blocked"
                return f"{name}: {abs(goal - angle):.2f} rad off its path, the limit is {MAX_ERROR:g}: {reason}"
            if not abs(speed) <= FASTEST:
                return f"{name}: {speed:.2f} rad/s, the limit is {FASTEST:g}: it slipped or was pushed"
        return ""

    def torque(self, dt: float, tracker: Tracker, uncertain: Sequence[float], friction: Sequence[float]) -> str:
        """Return which joint is saturated, or needs a torque that neither weight nor friction explains.

        uncertain: (4,) Nm, standard deviation of the expected torque. friction: (4,) Nm, 0 while it is unknown.
        """
        for name, time, most in zip(self._names, tracker.saturated.tolist(), self._max_effort, strict=True):
            if time > SATURATION:
                return f"{name}: saturated: the pose needs more than max_effort = {most:g} Nm"
        columns = zip(self._names, tracker.correction.tolist(), uncertain, friction, strict=True)
        for i, (name, torque, deviation, slide) in enumerate(columns):
            limit = MAX_CORRECTION + DEVIATIONS * deviation + (0.5 * slide if slide else UNKNOWN_FRICTION)
            self._unexplained[i] = self._unexplained[i] + dt if abs(torque) > limit else 0.0
            if self._unexplained[i] > PERSISTENCE:
                reason = "is a hand on the arm?"
                return f"{name}: {torque:.2f} Nm beyond its weight and friction, the limit is {limit:.2f}: {reason}"
        return ""

    def unrest(self, change: Sequence[float], effort: Sequence[float], friction: Sequence[float]) -> str:
        """Return which joint's torque changed between two passes of a pose: change, effort, friction (4,) Nm."""
        for name, between, torque, slide in zip(self._names, change, effort, friction, strict=True):
            limit = MAX_UNREST[0] + MAX_UNREST[1] * abs(slide) + MAX_UNREST[2] * abs(torque)
            if between > limit:
                reason = "the arm was touched, or the joint slips"
                return f"{name}: {between:.2f} Nm between two passes of a pose, the limit is {limit:.2f}: {reason}"
        return ""


class Tour:
    """One tour. Call `wait` for each joint state until the arm is carried, then `step`; and `plan` again and again.

    measured: so far. trouble: why it ended early, or ''. done: whether the arm hangs again after the last pose.
    progress: what it does, as a sentence. elapsed: s since the first step.
    """

    def __init__(
        self, limits: Limits, guess: TorqueGuess, itinerary: Itinerary, rate: float, load: tuple[float, float] = (0, 0)
    ) -> None:
        self.measured: list[Observation] = []
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
        self._inertia = self._known_inertia()
        self._matrix = np.eye(JOINT_COUNT)
        self._watch = TourWatch(limits, guess.tilt)
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
        self._guess.tilt = tilt
        if self._now == -math.inf:
            self._watch = TourWatch(self._limits, tilt)
            self._now = now
            self._await_plan(np.array(position))
        dt, self._now = now - self._now, now
        self.elapsed += dt
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
        if self._now - self._refreshed > REFRESH_PERIOD:
            self._refreshed = self._now
            self._uncertain = self._guess.torques(np.array([position]))[1][0].tolist()
            self._matrix = self._inertia.matrix(position)
        expected = self._guess.torque(position)
        self._effort = self._tracker.step(dt, error, speed_error, heading, expected, self._matrix)
        return self._watch.torque(dt, self._tracker, self._uncertain, self._friction)

    def _next_line(self) -> None:
        """Begin the next sweep, or after the last one the way to the next pose."""
        end = self._line.at(math.inf)[0]
        if self._awaits_plan:
            if self._plan:
                self._go_on(end, *self._plan)
            return
        if self._visit is None:
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
        """Improve what is known of friction; sweep again what passed without it, or what a joint did not follow."""
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
        (theta, effort, friction, spread, unrest), direction = visit.result()
        self.trouble = self._watch.unrest(unrest.tolist(), effort.tolist(), friction.tolist())
        if self.trouble:
            return
        found = Observation(theta, direction, effort, friction, spread, *self._load, visit.station.speed)
        self.measured.append(found)
        here = theta.tolist()
        before = self._guess.torque(here)
        self._guess.learn(theta, effort, spread)
        self._tracker.shift(np.subtract(self._guess.torque(here), before))
        self._inertia = self._known_inertia()

    def _known_inertia(self) -> LinkInertia:
        return inertia_of(self._guess.length, self._guess.common_moments[:JOINT_COUNT], self._load)

    def _shape(self, station: Station) -> tuple[np.ndarray, np.ndarray]:
        """Return how the expected torque changes at a station: slope and bend, as for `average`."""
        steps = ANGLE_STEP * np.eye(JOINT_COUNT)
        torque = self._guess.torques
        after, before = (torque(np.array(station.theta) + sign * steps)[0] for sign in (1.0, -1.0))
        low, middle, high = torque(np.array(station.theta) + ANGLE_STEP * np.array(((-1.0,), (0.0,), (1.0,))))[0]
        return (after - before).T / (2.0 * ANGLE_STEP), (low - 2.0 * middle + high) / ANGLE_STEP**2

    def plan(self) -> None:
        """Choose the next pose if one is due. It takes 0.1 s and more: not on the thread of `step`.

        Any error of the choice ends the tour: without a next pose the arm would be held for ever.
        """
        if not self._awaits_plan or self._plan:
            return
        try:
            taken = np.array([measured.theta for measured in self.measured]).reshape(-1, JOINT_COUNT)
            position = self._line.at(math.inf)[0]
            station = self._itinerary.next(taken, position, self.elapsed, self._guess, self._friction)
            self._plan = (station, "")
        except ExoGravityError as error:
            self._plan = (None, str(error))
        except Exception as error:
            self._plan = (None, f"the next pose could not be chosen: {type(error).__name__}: {error}")

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
