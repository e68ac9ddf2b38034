"""Weighs what is in the hand of a relaxed arm: the motors take it over, and sweep all joints a little there and back.

For TAKE_OVER s the arm is held where it is, so that the wearer can relax and the motors get the load. The mean of both
directions of a sweep is what the settings do not carry, without the joints' friction (`motion.average`). With dz/dq,
the height that each joint gives the hand, m kg in the hand take the torque m g dz/dq; m is fitted to it.

The result contains the error of the model, which weighing the empty hand in the same pose shows. Muscles look like a
load: what the wearer carries himself is missing from the result, unless his torque is one that no load can cause.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.calibration.motion import LEAD, WINDOW, Line, Station, average
from exo_gravity.core.calibration.tracking import ADDED, Tracker
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.model.arm import MAX_PAYLOAD, ArmModel
from exo_gravity.core.model.gravity import LAWS, Torque
from exo_gravity.core.model.kinematics import ROTORS, links_of
from exo_gravity.core.model.tilt import AXES, Tilt
from exo_gravity.core.observer.momentum import COVER

TAKE_OVER = 4.0  # s
CYCLES = 3  # there and back
LEAST_LEVER = 0.2  # m, of dz/dq: below, a load needs too little torque
LEAST_RATE = 80.0  # Hz
STILL = 0.2  # rad/s of a joint at the start
LARGEST_ERROR = 0.4  # rad of a joint from its path
FOLLOWED = 0.5  # of the path, that each joint must follow
PERSISTENCE = 0.3  # s for which a joint may want more than it may have
LIFTED = 0.5  # kg less than nothing, and
FOREIGN = 2.0  # Nm of any joint that is no load's: more is a hand on the arm, and a joint gets no more
UNREST = (0.08, 0.05)  # kg, and share of the mass, between two turns
UNLIKE = (0.3, 0.1)  # Nm, and share of the torque, that is no load's, beyond COVER standard errors
LEAST_ERROR = 0.05  # Nm: standard error of a joint's torque at best
MAX_GAP = 0.1  # s
SAME_POSE = 0.1  # m, of dz/dq
EMPTY = 0.15  # kg: a result of less, while no load is configured, is that of an empty hand
CARRIERS = ("spring", "coupling", "limits", "assist")  # terms that would carry a part


class Weighed(NamedTuple):
    """A result: the mass in kg, what is random of its standard deviation, and dz/dq, (4,) m."""

    mass: float
    deviation: float
    lever: np.ndarray


def refusal(s: Settings, terms: Sequence[str], rate: float) -> str:
    """Return why nothing can be weighed with these settings, active terms, and joint states at `rate` Hz, or ''."""
    if carriers := [name for name in terms if name in CARRIERS]:
        return f"{', '.join(carriers)} would carry a part of the load: switch it off"
    if any(s.wearer_mass) and (s.mode != "zero_g" or s.support < 1.0):
        return "a wearer can relax only while the whole arm is carried: mode zero_g with support 1"
    if rate < LEAST_RATE:
        return f"joint states come at {rate:.0f} Hz, must be {LEAST_RATE:g} or more"
    return ""


class Weighing:
    """One weighing, from the first call of `torque` on.

    names: of the joints (4,). rate: of the calls, Hz. empty: result of the empty hand, if known.
    result: None while there is none. trouble: why there is none, or ''. is_thrown: whether the load must have left the
    hand, so that its torque throws the arm.
    """

    def __init__(self, settings: Settings, names: Sequence[str], rate: float, empty: Weighed | None = None) -> None:
        self.result: Weighed | None = None
        self.trouble, self.is_thrown = "", False
        self._settings, self._names, self._empty = settings, names, empty
        self._tracker, friction = Tracker(rate, settings.max_effort), settings.terms.friction
        if any(friction.coulomb):  # less what the term `friction` compensates
            self._tracker.friction = (1.0 - friction.share) * np.array(friction.coulomb)
        self._lines: Iterator[Line] = iter(())
        self._time = 0.0  # s, on the present line
        self._line = Line(np.zeros(4), np.zeros(4))
        self._sweep: list[tuple[Sequence[float], np.ndarray]] | None = None  # its samples
        self._sweeps: list[tuple[np.ndarray, np.ndarray]] = []
        self._lever = self._weight = self._worn = np.zeros(4)  # dz/dq in m; of the torques, in 1/m; Nm
        self._by_tilt, self._matrix = np.zeros((4, 3)), np.eye(4)
        self._slide = np.zeros(4)  # Nm that compensate friction
        self._foreign = 0.0  # s for which a hand has pushed
        self._has_begun = False

    @property
    def is_over(self) -> bool:
        """Whether there is a result, or none will come."""
        return bool(self.result or self.trouble)

    @property
    def empty(self) -> Weighed | None:
        """The latest result for an empty hand, or None."""
        result = self.result
        return result if result and abs(result.mass) < EMPTY and not self._settings.payload_mass else self._empty

    @property
    def text(self) -> str:
        """What is known, in a sentence."""
        if self.trouble:
            return f"not weighed: {self.trouble}"
        if self.result is None:
            return "the arm moves a little: stay relaxed" if self._sweeps else "relax: the motors take the load over"
        mass, random, lever = self.result
        share, model = self._errors()
        text = f"{mass:.3f} +- {COVER * math.hypot(random, model, share * mass):.3f} kg more than the settings carry"
        if self.empty is self.result:
            return f"{text}: the hand is empty"
        more, empty = mass, self._empty
        if empty and math.dist(empty.lever, lever) <= SAME_POSE:
            more -= empty.mass
            error = COVER * math.hypot(random, empty.deviation, share * more, math.sqrt(2.0) * self._leaning())
            text = f"{text}; {more:.3f} +- {error:.3f} kg more than with an empty hand"
        return f"{text}: payload.mass = {max(0.0, self._settings.payload_mass + more):.3f} carries it"

    def torque(
        self, dt: float, theta: Sequence[float], velocity: Sequence[float], tilt: Tilt, torque: Torque
    ) -> Torque:
        """Return `torque` (4,) in Nm with what carries the load, `dt` s later; `torque` alone once this is over."""
        if not self._has_begun:
            self._begin(theta, velocity, tilt)
            dt = 0.0
        self._time += dt
        while self._time > self._line.duration + LEAD and not self.is_over:
            self._line, self._time = next(self._lines), 0.0
        goal, heading = self._line.at(self._time - LEAD)
        error = goal - np.array(theta)
        if self.is_over or self._is_wrong(dt, error):
            return torque
        if self._sweep is not None and self._line.is_measured(self._time - LEAD):
            self._sweep.append((theta, self._tracker.correction + self._slide))
        coming = self._line.at(LEAD)[1] if self._time < 2.0 * LEAD else heading
        effort = self._tracker.step(dt, error, heading - np.array(velocity), coming, torque, self._matrix)
        added = np.subtract(effort, torque)
        self._slide = added - self._tracker.correction
        most = FOREIGN + MAX_PAYLOAD * self._settings.robot.gravity * np.abs(self._lever)  # what a load may need
        return tuple((np.array(torque) + np.clip(added, -most, most)).tolist())

    def _begin(self, theta: Sequence[float], velocity: Sequence[float], tilt: Tilt) -> None:
        s, self._has_begun = self._settings, True
        links = links_of(s.moving)
        self._matrix = links._replace(rotors=tuple(rotor + ADDED for rotor in ROTORS)).matrix(theta)
        self._prepare(theta, tilt)
        fastest = max(map(abs, velocity))
        if np.linalg.norm(self._lever) < LEAST_LEVER:
            pose = "bend the elbow to a right angle, or raise the arm to the side"
            self.trouble = f"the hand hangs below the joints, where a load needs no torque: {pose}"
        elif fastest > STILL:
            self.trouble = f"the arm moves at {fastest:.2f} rad/s: hold it still"
        self._line = Line(np.array(theta), np.array(theta))
        self._lines = self._way(Station(tuple(theta), cycles=CYCLES))

    def _way(self, station: Station) -> Iterator[Line]:
        """Yield each line when it begins, and the result after the last one."""
        here, (low, high) = np.array(station.theta), station.ends
        for _ in range(round(TAKE_OVER / LEAD)):
            yield Line(here, here)
        yield Line(here, low, station.speed)
        for ends in ((low, high), (high, low)) * station.cycles:
            self._sweep = []
            yield Line(*ends, station.speed)
            position, remainder = zip(*self._sweep, strict=True)
            self._sweeps.append((np.array(position), np.array(remainder)))
        self._sweep = None
        yield Line(low, here, station.speed)
        self._finish(2.0 * WINDOW * station.amplitude)
        yield Line(here, here)

    def _is_wrong(self, dt: float, error: np.ndarray) -> bool:
        """Note what is wrong with the motion, `error` (4,) rad from its path; return whether anything is."""
        worst = int(np.argmax(np.abs(error)))
        saturated = [name for name, t in zip(self._names, self._tracker.saturated, strict=True) if t > PERSISTENCE]
        correction = self._tracker.correction / (self._settings.robot.gain * self._settings.robot.gravity)
        mass = float(self._weight @ correction)
        foreign = (np.abs(correction - mass * self._lever) * self._settings.robot.gravity).tolist()
        is_foreign = max(foreign) > FOREIGN or not -LIFTED < mass < MAX_PAYLOAD
        self._foreign = self._foreign + dt if is_foreign else 0.0
        if not dt <= MAX_GAP:
            self.trouble = f"no joint states for {1000.0 * dt:.0f} ms"
        elif abs(error[worst]) > LARGEST_ERROR:
            self.is_thrown = float(error @ self._lever) < 0.0
            why = "was the load dropped?" if self.is_thrown else "relax gradually, and touch nothing"
            self.trouble = f"{self._names[worst]} moved by {abs(error[worst]):.2f} rad: {why}"
        elif self._foreign > PERSISTENCE:
            self.trouble = f"{self._names[int(np.argmax(foreign))]}: {max(foreign):.1f} Nm of a hand on the arm"
        elif saturated:
            remedy = "the load needs more than max_effort here: hold it nearer to the body"
            self.trouble = f"{', '.join(saturated)}: {remedy}"
        return bool(self.trouble)

    def _errors(self) -> tuple[float, float]:
        """Return the standard errors of the torque's scale, as a share, and of the model, in kg."""
        error, weight = self._settings.model_error, self._weight
        share = math.hypot(*(weight * self._lever * error.scale))
        model = math.hypot(*(weight * error.torque), error.wearer * float(weight @ self._worn))
        return share, math.hypot(model / self._settings.robot.gravity, self._leaning())

    def _leaning(self) -> float:
        """Return the standard error in kg that is left of the trunk's tilt."""
        s = self._settings
        return s.model_error.tilt * math.hypot(*(self._weight @ self._by_tilt)) / s.robot.gravity

    def _prepare(self, theta: Sequence[float], tilt: Tilt) -> None:
        """Compute each joint's weight in the fit of the mass: least squares; all joints share one error of the tilt."""
        s = self._settings
        self._lever = np.array(LAWS["exact"](s.unit_load, theta, tilt))
        wearer = ArmModel(s.robot.length, s.wearer_cog, s.wearer_mass, gravity=s.robot.gravity)
        self._worn = np.array(LAWS["exact"](wearer, theta, tilt))
        self._by_tilt = np.array([LAWS["exact"](s.arm, theta, axis) for axis in AXES]).T
        own = np.hypot(s.model_error.torque, LEAST_ERROR)
        covariance = np.diag(own**2) + s.model_error.tilt**2 * self._by_tilt @ self._by_tilt.T
        weight = np.linalg.solve(covariance, self._lever)
        self._weight = weight / (weight @ self._lever) if np.any(self._lever) else self._lever

    def _finish(self, way: float) -> None:
        """Fit the mass to the sweeps, of which each joint must have followed half of `way` rad."""
        _, remainder, _, spread, unrest = average(self._sweeps)
        s, weight = self._settings, self._weight
        scale = s.robot.gain * s.robot.gravity
        mass = float(weight @ (remainder / scale))
        ways = np.min([np.abs(position[-1] - position[0]) for position, _ in self._sweeps], axis=0)
        share, _ = self._errors()
        needed = mass * scale * self._lever
        tilted = s.model_error.tilt * np.linalg.norm(self._by_tilt, axis=1)
        parts = (s.model_error.torque, spread, share * needed, s.model_error.wearer * self._worn, tilted)
        known = COVER * np.linalg.norm(np.array(parts), axis=0)
        unlike = np.abs(remainder - needed) - known - UNLIKE[0] - UNLIKE[1] * np.abs(needed)
        restless = math.hypot(*(weight * unrest)) / s.robot.gravity
        if restless > UNREST[0] + UNREST[1] * abs(mass):
            self.trouble = f"{restless:.2f} kg between two turns: relax, and touch nothing"
        for name, short, off in zip(self._names, FOLLOWED * way - ways, unlike, strict=True):
            if short > 0.0:
                self.trouble = f"{name} does not follow: is the arm carried, is a hand on it?"
            elif off > 0.0:
                torque = f"{off + UNLIKE[0]:.1f} Nm"
                self.trouble = f"{name}: no load in the hand explains {torque}: is somebody touching the arm?"
        if not self.trouble:
            random = math.hypot(*(weight * spread)) / s.robot.gravity
            self.result = Weighed(mass, random, self._lever)
