# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The tour of a calibration: moves the arm slowly from pose to pose and measures what each of them needs to be held.

Pure: time is an argument. At each pose all joints sweep through it there and back: the mean of both directions is
gravity, half of the difference is friction. The next pose is a given one, or the most informative one that the motors
can hold. What holds the arm is expected with a mean and a standard deviation for every pose: by the fit of what this
tour, and earlier ones, have measured so far. That carries the arm, and distinguishes a hand on it from its weight.

A pose in which a joint sticks is left out. The tour begins and ends at the hanging arm; after trouble it withdraws its
efforts. Its record has one line of JSON for each pose, as `calibrator` prints it.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from exo_gravity.core.arm.interface import MAX_MASS
from exo_gravity.core.arm.paper import MAX_LENGTH
from exo_gravity.core.arm.tilt import SIDES, Tilt, angle_between
from exo_gravity.core.compensation.settings import compensator_table
from exo_gravity.core.errors import DataError, ExoGravityError
from exo_gravity.core.motors.joint_motor import MOTOR_PARAMETERS, JointSample
from exo_gravity.core.numbers import Torque, Vector
from exo_gravity.core.params import Param, table_for
from exo_gravity.core.safety.command import Efforts
from exo_gravity.core.safety.limits import CAN_BRIDGE, WALL, Limits
from exo_gravity.lab.calibration.identification import EXACT, Unknowns, columns, known_of, next_pose, rows_at, solve
from exo_gravity.lab.calibration.moment_model import MomentModel, model_of
from exo_gravity.lab.calibration.tracking import MOTION, Line, Observation, Station, Sweep, Tracker, average, followed
from exo_gravity.sim.controllers import SampleController


@dataclass(frozen=True)
class TourTuning:
    """What the expected torque leaves, which poses may be visited, and the sweeps that show friction."""

    unexplained: float = 0.05  #: Nm: standard deviation of what no unknown explains,
    share: float = 0.03  #: of the torque, in addition: zeros and axes that are off
    candidates: int = 800  #: random poses, of which those above the horizontal are left out
    most_upwards: float = 0.3  #: sine of the largest angle above the horizontal, of links 3 and 4
    effort_share: float = 0.85  #: of max_effort that a pose may need
    deviations: float = 2.0  #: of the expected torque, that a pose must leave room for; less where none does
    usual_friction: float = 0.5  #: Nm, until it is measured
    waypoints: int = 4  #: of the way to a pose, at which the motors must hold the arm too
    first_edge: float = 0.1  #: rad in addition, at the first pose
    edge: float = 0.02  #: rad between a sweep's end and the soft wall
    speeds: tuple[float, ...] = (0.02, 0.05, 0.1, 0.18, MOTION.speed)  #: rad/s, at which friction is measured
    time: float = 1.2  #: s of such a sweep's half at steady speed
    amplitude: tuple[float, float] = (0.05, 0.3)  #: rad, smallest and largest


TOUR = TourTuning()


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
        self.model, self._load = model, load
        known = known_of(model, None, False)
        error = Unknowns.of(known.error, model)
        error.tilt[:] = error.slope[:] = EXACT
        self._unknowns, self._covariance = known.start, np.diag(known.error**2)
        if seen:
            theta, direction, effort, spread = columns(seen)
            hung = np.array([model.load(one.load_mass, one.load_lever) for one in seen])
            rows = rows_at(model, theta, direction)._replace(load=hung)
            unexplained = np.hypot(TOUR.unexplained, TOUR.share * effort)
            fit = solve(rows, known, effort, np.hypot(spread, unexplained), passes=1)
            self._unknowns, self._covariance = fit.unknowns, fit.covariance
        value = Unknowns.of(self._unknowns, model)
        self.moments = value.moment + model.load(*load)
        self._share = np.exp(-value.scale)  # commanded torque by torque
        self._arm = model.holding(self.moments)
        parts = (self._share, value.spring, value.offset)
        self._joints = list(zip(*(part.tolist() for part in parts), strict=True))

    def torque(self, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the expected torque (n,) in Nm at `theta` (n,) rad, in plain floats for the control loop."""
        joints = zip(self._arm.torque(theta, tilt), theta, self._joints, strict=True)
        return tuple([share * (own + k * angle) + offset for own, angle, (share, k, offset) in joints])

    def torques(self, theta: np.ndarray, direction: Vector) -> tuple[np.ndarray, np.ndarray]:
        """Return the expected torque and its standard deviation, both (m, n) Nm, at `theta` (m, n) rad.

        direction: (3,), gravity's unit vector in the base frame.
        """
        rows = rows_at(self.model, theta, direction)
        rows = rows._replace(load=rows.load + self.model.load(*self._load))
        mean, jacobian = rows.predicted(self._unknowns), rows.jacobian(self._unknowns)
        variance = np.einsum("mnt,mnt->mn", jacobian @ self._covariance, jacobian)
        return mean, np.sqrt(variance)

    def matrix(self, theta: Sequence[float]) -> np.ndarray:
        """Return the mass matrix (n, n) in kg m^2 of the file's arm, in the torque that each motor is commanded.

        theta: (n,) rad.

        A torque that the joints share in another proportion than their motors give it turns light links against each
        other: with 1 kg and the arm abducted, joints 1 and 3 together carry 1 kg m^2, but 0.005 against each other.
        """
        return self._share[:, None] * self.model.matrix(theta, self._load)


@dataclass(frozen=True)
class Itinerary:
    """Which stations a tour visits: given ones, then others until so many poses are measured."""

    limits: Limits
    most: int  #: poses; each that is not given is the one that shows the most
    given: Sequence[Station] = ()  #: by default the hanging arm
    again: int = 0  #: of the first poses, visited again at the end, to see whether anything has changed

    @property
    def count(self) -> int:
        """How many poses there are."""
        return max(self.most, len(self.given) or 1) + self.again

    def stations(self, tour: "Tour") -> Iterator[Station]:
        """Yield each station of a tour when it is due. Raises DataError if no pose can be held."""
        yield from self.given or [hanging(self.limits)]
        poses = candidates(self.limits, tour.guess.model)
        while len(tour.measured) < self.most:
            room = self._room(poses, tour)
            if room.max() < 0.0:
                raise DataError("no further pose can be held within max_effort: is it too small for the arm?")
            possible = np.flatnonzero(room >= min(TOUR.deviations, math.floor(room.max())))
            seen = [one.theta for one in tour.measured] or [hanging(self.limits).theta]
            index = possible[next_pose(seen, poses[possible], tour.down, tour.guess.moments, tour.guess.model)]
            yield Station(tuple(poses[index].tolist()))
            poses = np.delete(poses, index, axis=0)  # chosen once, even if a joint sticks there
        for one in tour.measured[: self.again]:
            yield Station(tuple(one.theta))

    def _room(self, poses: np.ndarray, tour: "Tour") -> np.ndarray:
        """Return the room (m,) that the motors have to hold `poses`, reach them, and leave them for home.

        It is in standard deviations of the expected torque, below 0 where they have none.
        """
        shares = np.linspace(0.0, 1.0, TOUR.waypoints + 1)[1:, None, None]
        sweep = MOTION.amplitude * np.array((-1.0, 1.0))[:, None, None]
        there, home = (start + shares * (poses - start) for start in (tour.position, np.array(self.limits.home)))
        ways = np.vstack((there, poses + sweep, home))
        mean, deviation = tour.guess.torques(ways.reshape(-1, poses.shape[1]), tour.down)
        slide = np.where(tour.friction, tour.friction, TOUR.usual_friction)
        most = TOUR.effort_share * np.array(self.limits.max_effort) - slide
        room = (most - np.abs(mean)) / deviation
        return np.asarray(room.min(axis=1).reshape(len(ways), -1).min(axis=0))


def hanging(limits: Limits, speed: float = 0.1, amplitude: float = MOTION.amplitude) -> Station:
    """Return the hanging arm, farther off the soft walls than other poses: friction is not known there at first."""
    low, high = measurable(limits, amplitude)
    return Station(
        tuple(np.clip(limits.home, low + TOUR.first_edge, high - TOUR.first_edge).tolist()), speed, amplitude
    )


def friction_stations(limits: Limits) -> list[Station]:
    """Return sweeps through the hanging arm at each speed; the first lets the controller learn the friction."""
    speeds = (0.1, *TOUR.speeds)
    amplitudes = np.clip(np.array(speeds) * TOUR.time, *TOUR.amplitude).tolist()
    return [hanging(limits, *sweep) for sweep in zip(speeds, amplitudes, strict=True)]


def candidates(limits: Limits, model: MomentModel) -> np.ndarray:
    """Return random poses (m, n) in rad within `limits` in which no link points far upwards.

    Above the shoulder gravity tips the arm over: what is wrong with the expected torque grows with each movement.
    """
    low, high = measurable(limits, MOTION.amplitude)
    poses = np.random.default_rng(1).uniform(low, high, (TOUR.candidates, model.count))
    home = float(model.upwards(np.array([limits.home]))[0])  # a link may point upwards in every pose
    return np.asarray(poses[model.upwards(poses) <= max(TOUR.most_upwards, home)])


def measurable(limits: Limits, amplitude: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest pose (n,) rad around which a sweep of `amplitude` rad stays off the soft walls."""
    margin = WALL.width + amplitude + TOUR.edge
    return np.array(limits.position_min) + margin, np.array(limits.position_max) - margin


# Share of the expected torque that a hanging arm gets until it is carried. With more torque than its weight needs, it
# tips over: with 1 kg, and motors 17 % stronger than the file says, it swung out to 0.9 rad before the tour began.
WAITING_SHARE = 0.5
MAX_FAILURES = 3  # pairs of sweeps in which a joint may stick: each shows the controller more of its friction
MAX_LEFT_OUT = 4  # poses in which a joint may stick, before the tour ends with what it has
RAISED = 4  # chosen poses of a tour for friction: they show what depends on the torque
STEADY_SPEED = 0.05  # rad/s of a sweep, from which on its friction is that of the motion between poses
REFRESH_PERIOD = 0.1  # s between two estimates of the mass matrix, and of how uncertain the expected torque is
# What stops a tour.
MAX_ERROR = 0.18  # rad between a joint and the slow reference
FASTEST = 1.0  # rad/s of a joint; a light joint that leaves its friction reaches 0.5
MAX_VIBRATING = 1.0  # s for which a motor may vibrate
MAX_CORRECTION = 0.75  # Nm, of the controllers, in addition to what is unknown of weight and friction
DEVIATIONS = 3.0  # of the expected torque
UNKNOWN_FRICTION = 1.0  # Nm, until it is measured
PERSISTENCE = 0.25  # s for which a torque must be unexplained
SATURATION = 0.1  # s for which a joint may want more than its max_effort
MAX_GAP = 0.1  # s between two joint states; as long as can_bridge's longest time-out
LONGEST_CHOICE = 30.0  # s for which the arm is held while the next pose is chosen
MAX_TILT = 0.1  # rad by which the stand or the trunk may tilt during the tour
HAND = "a hand is on the arm, or the joint is blocked"
VIBRATED = (
    "motors vibrated, as behind elastic joints: correct the file's masses and torque_scale, hang no weight, or stiffen "
    "the joint"
)
MAX_UNREST = (0.12, 0.25, 0.05)  # Nm, share of friction, share of the torque: between two passes of the same pose


class Tour:
    """One tour. Call `wait` for each joint state until the arm is carried, then `step`; and `plan` again and again.

    model: of the arm, of which `earlier` tours showed something. itinerary: which poses it visits.
    rate: of joint states, Hz. load: a weight in kg, and its distance from the last joint in m.

    measured: so far. trouble: why it ended early, as a sentence that names joint, value and limit, or ''. done: whether
    the arm hangs again after the last pose. progress: what it does, as a sentence.
    temperature: (n,) degC of the motors, set by who knows it; () if it is not known.
    guess: of the torque that holds the arm, by `plan`. position: (n,) rad, at the end of the present line.
    down: (3,), gravity's unit vector in the base frame. friction: (n,) Nm, 0 until it is measured.
    """

    def __init__(
        self,
        limits: Limits,
        model: MomentModel,
        itinerary: Itinerary,
        rate: float,
        load: tuple[float, float] = (0.0, 0.0),
        earlier: Sequence[Observation] = (),
    ) -> None:
        self.measured: list[Observation] = []
        self.trouble = ""
        self.done = False
        self.progress = "choosing the first pose"
        self.temperature: Sequence[float] = ()
        self._limits, self._most = limits, np.array(limits.max_effort)
        self.itinerary, self._load, self._earlier = itinerary, load, earlier
        self._stations = itinerary.stations(self)
        self.guess = self._acting = TorqueGuess(model, load, earlier)
        self._tracker = Tracker(rate, limits.max_effort)
        self._first_tilt = self._tilt = Tilt.of(SIDES[0])
        self._now = -math.inf
        self.position = self.friction = np.zeros(model.count)
        self._left_out: list[str] = []  # why, of each pose
        self._awaits_plan, self._undecided = False, 0.0  # whether a pose is to be chosen, and s since then
        self._plan: tuple[Station | None, str] = (None, "")  # the next pose, or None to go home, and the trouble
        self._unexplained = np.zeros(model.count)  # s
        self._refreshed = -math.inf
        self._matrix, self._uncertain = np.eye(model.count), np.zeros(model.count)

    def wait(self, position: Sequence[float], tilt: Tilt) -> Torque:
        """Return the effort (n,) in Nm at `position` (n,) rad, while the arm is not yet carried: it goes on hanging."""
        return tuple(WAITING_SHARE * torque for torque in self._acting.torque(position, tilt))

    def step(self, now: float, position: Sequence[float], velocity: Sequence[float], tilt: Tilt) -> Torque | None:
        """Return the effort (n,) in Nm at `now` s, None after trouble.

        position, velocity: (n,), rad and rad/s. tilt: of the trunk or the stand.
        """
        if self.trouble:
            return None
        self._tilt, expected = tilt, self._acting.torque(position, tilt)
        if self.done:  # the bridge lets the arm down: it is no longer watched
            return tuple(np.clip(expected + self._tracker.correction, -self._most, self._most).tolist())
        if self._now == -math.inf:
            self._first_tilt, self._now, self.position = tilt, now, np.array(position)
            self._tracker.lines = self._lines()
            self._tracker.shift((1.0 - WAITING_SHARE) * np.array(expected))
        dt, self._now = now - self._now, now
        self._undecided = self._undecided + dt if self._awaits_plan else 0.0
        if now - self._refreshed > REFRESH_PERIOD:
            self._refreshed, self._matrix = now, self._acting.matrix(position)
            self._uncertain = self._acting.torques(np.array([position]), self.down)[1][0]
        effort = self._tracker.step(dt, position, velocity, expected, self.down, self._matrix)
        self.trouble = self.trouble or self._wrong_motion(dt, tilt) or self._wrong_torque(dt)
        if self.trouble and self._tracker.is_softened:
            self.trouble += f"; {VIBRATED}"
        return None if self.trouble else effort

    def _wrong_motion(self, dt: float, tilt: Tilt) -> str:
        """Return what is wrong after `dt` s with the motion, or ''."""
        if dt > MAX_GAP:
            return f"no joint states for {dt * 1000:.0f} ms, the limit is {MAX_GAP * 1000:.0f}: is a motor silent?"
        if self._undecided > LONGEST_CHOICE:
            return f"the next pose was not chosen within {LONGEST_CHOICE:g} s: is this computer too busy?"
        if (moved := angle_between(tilt.direction, self._first_tilt.direction)) > MAX_TILT:
            return f"the trunk tilted by {moved:.2f} rad during the measurement, the limit is {MAX_TILT:g}"
        tracker = self._tracker
        joints = zip(self._limits.joint_names, tracker.error, tracker.vibration.speed, tracker.vibrating, strict=True)
        for name, behind, speed, vibrating in joints:
            if not abs(behind) <= MAX_ERROR:
                return f"{name}: {abs(behind):.2f} rad off its path, the limit is {MAX_ERROR:g}: {HAND}"
            if not abs(speed) <= FASTEST:
                return f"{name}: {speed:.2f} rad/s, the limit is {FASTEST:g}: it slipped or was pushed"
            if vibrating > MAX_VIBRATING:
                return f"{name}: its motor goes on vibrating: is something loose?"
        return ""

    def _wrong_torque(self, dt: float) -> str:
        """Return which joint is saturated, or needs a torque that neither weight nor friction explains, or ''."""
        for i in np.flatnonzero(self._tracker.saturated > SATURATION):
            most = f"max_effort = {self._most[i]:g} Nm"
            return f"{self._limits.joint_names[i]}: saturated: the pose needs more than {most}"
        torque, slide = self._tracker.correction, np.where(self.friction, 0.5 * self.friction, UNKNOWN_FRICTION)
        limit = MAX_CORRECTION + DEVIATIONS * self._uncertain + slide
        self._unexplained = np.where(np.abs(torque) > limit, self._unexplained + dt, 0.0)
        for i in np.flatnonzero(self._unexplained > PERSISTENCE):
            beyond = f"{torque[i]:.2f} Nm beyond its weight and friction, the limit is {limit[i]:.2f}"
            return f"{self._limits.joint_names[i]}: {beyond}: is a hand on the arm?"
        return ""

    @property
    def down(self) -> np.ndarray:
        """Gravity's unit vector (3,) in the base frame."""
        return self.guess.model.down(self._tilt)

    def plan(self) -> None:
        """Fit what was measured, and choose the next pose, if one is due.

        It takes 0.1 s and more: not on the thread of `step`.

        Any error of the choice ends the tour: without a next pose the arm would be held for ever.
        """
        if not self._awaits_plan:
            return
        try:
            self.guess = TorqueGuess(self.guess.model, self._load, [*self._earlier, *self.measured])
            is_over = len(self._left_out) > MAX_LEFT_OUT
            self._plan = None if is_over else next(self._stations, None), ""
        except Exception as error:
            why = "" if isinstance(error, ExoGravityError) else f"{type(error).__name__}: "
            self._plan = (None, f"the next pose could not be chosen: {why}{error}")
        self._awaits_plan = False

    def _lines(self) -> Iterator[Line]:
        """Yield each line of the tour when it begins; the arm is held until `plan` chose."""
        home = np.array(self._limits.home)
        while True:
            self._awaits_plan = True
            while self._awaits_plan:
                yield Line(self.position, self.position)
            before, after = (one.torque(self.position.tolist(), self._tilt) for one in (self._acting, self.guess))
            self._tracker.shift(np.subtract(after, before))
            self._acting, (station, self.trouble) = self.guess, self._plan
            if station is None:
                break
            angles = " ".join(f"{math.degrees(angle):.0f}" for angle in station.theta)
            left_out = "".join(f"; left out: {why}" for why in self._left_out[-1:])
            self.progress = f"pose {len(self.measured) + 1} of {self.itinerary.count}: {angles} deg{left_out}"
            start, self.position = self.position, station.ends[0]
            yield Line(start, self.position)
            yield from self._sweeps(station)
        self.progress = "back to the hanging arm"
        yield Line(self.position, home)
        self.done, self.progress = True, "done"
        yield Line(home, home)

    def _sweeps(self, station: Station) -> Iterator[Line]:
        """Yield each sweep until enough were good, and keep what they show; or leave the pose out if a joint sticks."""
        failures, sweeps = 0, list[Sweep]()
        while len(sweeps) < 2 * station.cycles:
            frequency = self._tracker.frequency.min()
            pair = yield from self._tracker.sweep(station)
            if self._tracker.frequency.min() < frequency:  # neither friction nor gravity shows while motors vibrate
                sweeps = []
                continue
            share, was_known = followed(pair, station), bool(np.any(self.friction))
            sticks = bool(np.min(share) < MOTION.followed)
            if station.speed >= STEADY_SPEED:
                self.friction = np.maximum(average(pair)[0].friction, self.friction if sticks else 0.0)
                self._tracker.friction = self.friction
            # Sweep again what passed without friction, or what a joint did not follow.
            sweeps = [] if sticks or not was_known else sweeps + pair
            failures += sticks
            if failures > MAX_FAILURES:
                name, least = self._limits.joint_names[int(np.argmin(share))], float(np.min(share))
                what = f"follows {least:.0%} of a slow motion, must be {MOTION.followed:.0%}"
                self._left_out.append(f"a pose in which {name} sticks: it {what}")
                return
        self._keep(station, sweeps)

    def _keep(self, station: Station, sweeps: list[Sweep]) -> None:
        """Keep what the `sweeps` show, and improve the expected torque with it, unless the passes differ."""
        seen, unrest = average(sweeps)
        theta = np.asarray(seen.theta)
        effort = seen.effort + self._acting.torques(theta[None], seen.direction)[0][0]
        allowed = np.dot(MAX_UNREST, (np.ones(len(effort)), np.abs(seen.friction), np.abs(effort)))
        for name, change, limit in zip(self._limits.joint_names, unrest, allowed, strict=True):
            if change > limit:
                what = f"{change:.2f} Nm between two passes of a pose, the limit is {limit:.2f}"
                self.trouble = f"{name}: {what}: the arm was touched, or the joint slips"
                return
        weight, lever = self._load
        self.measured.append(
            seen._replace(
                effort=effort,
                load_mass=weight,
                load_lever=lever,
                speed=station.speed,
                temperature=tuple(self.temperature),
            )
        )


class TourController(SampleController):
    """Carries an arm through a tour, in the compensator's place, without messages.

    tour: which is planned and stepped here.
    limits: as in `SampleController`.
    tilt: of the trunk or the stand.
    is_carried: whether the arm is carried; from then on the tour moves it.
    """

    def __init__(self, tour: Tour, limits: Limits, tilt: Tilt, is_carried: Callable[[], bool]) -> None:
        super().__init__(limits)
        self.tour = tour
        self._tilt, self._is_carried = tilt, is_carried
        self._has_begun = False

    def _efforts_for(self, now: float, samples: Sequence[JointSample]) -> Efforts:
        position, velocity, _, temperature, _, times, *_ = zip(*samples, strict=True)
        self.tour.temperature = () if None in temperature else tuple(map(float, temperature))
        self._has_begun = self._has_begun or self._is_carried()
        if self._has_begun:
            effort = self.tour.step(now, position, velocity, self._tilt)
            self.tour.plan()
        else:
            effort = self.tour.wait(position, self._tilt)
        return Efforts(effort, min(times), False, False)


def line_of(observation: Observation) -> str:
    """Return the line of an observation, without its end."""
    return json.dumps({"observation": observation._asdict()}, default=np.ndarray.tolist)


def observations_in(record: Path, joints: int) -> list[Observation]:
    """Return what a tour of an arm of so many `joints` wrote to its `record`. Raises DataError if it is not one."""
    try:
        lines = record.read_text(encoding="utf-8").splitlines()
        observations = [Observation(**json.loads(line)["observation"]) for line in lines]
        if other := {len(one.theta) for one in observations} - {joints}:
            raise ValueError(f"poses of {other.pop()} joints")
        return observations
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{record}: {error}: must be the record (.jsonl) of a tour of this arm") from None


# As the compensator's, of the paper's arm or one from a URDF, and those that describe its links.
ARM = (
    "side", "joint_names", "law", "gain", "gravity", "use_imu", "tilt_timeout", "link_length",
    "robot.mass", "robot.cog", "robot.first_moment", "robot.off_axis",
)  # fmt: skip
LIMITS = ("position_min", "position_max", "max_effort")
BRIDGE = ("rate", *LIMITS, "motor", "home")  # as can_bridge's
OWN = (
    Param("tour.poses", 12, "number of poses that are chosen", (1, 100), fixed=True),
    Param("tour.again", 0, "number of the first poses that are visited again at the end", (0, 100), fixed=True),
    Param("tour.friction", False, "sweep the hanging arm at several speeds, then a few chosen poses", fixed=True),
    Param("tour.load_mass", 0.0, "weight that hangs on the last link", (0.0, MAX_MASS), "kg", fixed=True),
    Param("tour.load_lever", 0.0, "its distance from the last joint", (0.0, MAX_LENGTH), "m", fixed=True),
    Param("tour.earlier", "", "record (.jsonl) of an earlier tour, whose poses without a weight are known", fixed=True),
    Param("tour.wearer_mass", [0.0] * 4, "expected mass of the wearer's segment on each link", (0.0, MAX_MASS), "kg",
          fixed=True),
    Param("tour.wearer_cog", [0.0] * 4, "its centre of gravity from the link's joint", (0.0, MAX_LENGTH), "m",
          fixed=True),
)  # fmt: skip


def of_arm(name: str) -> bool:
    """Return whether the compensator's parameter `name` says how an arm is calibrated."""
    return name in ARM or name.startswith("urdf.")


def calibrator_table(given: Mapping[str, Any]) -> tuple[Param, ...]:
    """Return the parameters of `calibrator` for an arm with the parameters `given`."""
    own = [replace(param, fixed=True) for param in compensator_table(given) if of_arm(param.name)]
    known = {param.name for param in own}
    bridge = {one.name: one for one in (*CAN_BRIDGE, *MOTOR_PARAMETERS) if one.name in BRIDGE and one.name not in known}
    return tuple(table_for((*own, *bridge.values(), *OWN), given))


def side_of(values: Mapping[str, Any]) -> str:
    """Return the side of the arm that `calibrator` moves. One from a URDF has none: its root link is not mirrored."""
    return str(values.get("side", SIDES[0]))


def tour_of(values: Mapping[str, Any]) -> Tour:
    """Return the tour that parameter values describe. Raises ParameterError."""
    load = values["tour.load_mass"], values["tour.load_lever"]
    limits = Limits(tuple(values["joint_names"]), **{name: values[name] for name in (*LIMITS, "home")})
    model = model_of(values, (values["tour.wearer_mass"], values["tour.wearer_cog"]))
    earlier = observations_in(Path(values["tour.earlier"]), model.count) if values["tour.earlier"] else []
    given = friction_stations(limits) if values["tour.friction"] else ()
    count = len(given) + RAISED if given else values["tour.poses"]
    return Tour(limits, model, Itinerary(limits, count, given, values["tour.again"]), values["rate"], load, earlier)
