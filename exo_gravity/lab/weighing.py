# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Weighs what is in the hand of a relaxed arm: the motors take it over, and sweep all joints a little there and back.

At first the arm is held where it is, so that the wearer can relax and the motors get the load. The mean of both
directions of a sweep is what the settings do not carry, without the joints' friction (`tracking.average`). With dz/dq,
the height that each joint gives the hand, m kg in the hand take the torque m g dz/dq; m is fitted to it.

The result contains the error of the model, which weighing the empty hand in the same pose shows. Muscles look like a
load: what the wearer carries is missing from the result, unless their torque is one that no load can cause.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.interface import MAX_PAYLOAD
from exo_gravity.core.arm.tilt import AXES, Tilt
from exo_gravity.core.compensation.compensator import CLIENT_EFFORT, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.numbers import COVER, Torque
from exo_gravity.core.vocabulary import NO_REASON, NONE, Status
from exo_gravity.lab.calibration.tracking import MOTION, Line, Station, Sweep, Tracker, average, followed
from exo_gravity.lab.vocabulary import WeighingPhase, WeighingRefused, WeighingTrouble

CARRIERS = ("spring", "coupling", "limits", "assist")  # terms that would carry a part


@dataclass(frozen=True)
class WeighingTuning:
    """When a load can be weighed, and when a result is accepted."""

    take_over: float = 4.0  #: s in which the motors take the load over
    cycles: int = 3  #: there and back
    least_lever: float = 0.2  #: m, of dz/dq: below, a load needs too little torque
    least_rate: float = 80.0  #: Hz of the joint states
    start_speed: float = 0.2  #: rad/s of a joint at the start
    largest_error: float = 0.4  #: rad of a joint from its path
    persistence: float = 0.3  #: s for which a joint may want more than it may have, or a hand may push
    lifted: float = 0.5  #: kg less than nothing, that a wearer may lift
    foreign: float = CLIENT_EFFORT  #: Nm of any joint that is no load's: more is a hand on the arm
    unrest: tuple[float, float] = (0.08, 0.05)  #: kg, and share of the mass, between two turns
    #: Nm, and share of the torque, that is no load's, beyond the 95 % band
    unlike: tuple[float, float] = (0.3, 0.1)
    least_error: float = 0.05  #: Nm: standard error of a joint's torque at best
    pause: float = 0.1  #: s without joint states, that ends it
    same_pose: float = 0.1  #: m, of dz/dq
    empty: float = 0.15  #: kg: a result of less, while no load is configured, is that of an empty hand


WEIGHING = WeighingTuning()


class Weighed(NamedTuple):
    """A result: the mass in kg, what is random of its standard deviation, and dz/dq, (n,) m."""

    mass: float
    deviation: float
    lever: np.ndarray


def refusal(s: Settings, terms: Sequence[str], rate: float) -> Status:
    """Return why nothing can be weighed with these settings, active terms, and joint states at `rate` Hz."""
    if carriers := [name for name in terms if name in CARRIERS]:
        return Status(WeighingRefused.TERMS, f"{', '.join(carriers)} would carry a part of the load: switch it off")
    if any(s.wearer_mass) and (s.mode != "zero_g" or s.support < 1.0):
        return Status(
            WeighingRefused.SUPPORT,
            "a wearer can relax only while the whole arm is carried: mode zero_g with support 1",
        )
    if rate < WEIGHING.least_rate:
        return Status(
            WeighingRefused.SLOW, f"joint states come at {rate:.0f} Hz, must be {WEIGHING.least_rate:g} or more"
        )
    if not s.robot.has_hand:
        return Status(WeighingRefused.NO_HAND, "urdf.hand does not say which link holds a load")
    return NO_REASON


class Weighing:
    """One weighing, from the first call of `torque` on.

    settings: of the compensator. names: of the joints (n,). rate: of the calls, Hz. empty: result of the empty hand, if
    known for these settings, whatever their payload.
    result: None while there is none. trouble: why there is none. elapsed: s since it began.
    """

    def __init__(self, settings: Settings, names: Sequence[str], rate: float, empty: Weighed | None = None) -> None:
        self.result: Weighed | None = None
        self.trouble = NO_REASON
        self.elapsed = 0.0
        self.settings, self._names, self._empty = settings, names, empty
        self._tracker, friction = Tracker(rate, settings.max_effort), settings.terms.friction
        if any(friction.coulomb):  # less what the term `friction` compensates
            self._tracker.friction = (1.0 - friction.share) * np.array(friction.coulomb)
        self._matrix: np.ndarray | None = None  # kg m^2, of the arm where it is held; None before the first call
        self._is_moving = False
        self._foreign = 0.0  # s for which a hand has pushed

    @property
    def is_over(self) -> bool:
        """Whether there is a result, or none will come."""
        return bool(self.result or self.trouble)

    @property
    def empty(self) -> Weighed | None:
        """The latest result for an empty hand, or None."""
        result = self.result
        is_empty = result and abs(result.mass) < WEIGHING.empty and not self.settings.payload.mass
        return result if is_empty else self._empty

    @property
    def phase(self) -> WeighingPhase:
        """How far it is."""
        if self.trouble:
            return WeighingPhase.FAILED
        if self.result:
            return WeighingPhase.DONE
        return WeighingPhase.SWEEPING if self._is_moving else WeighingPhase.TAKING_OVER

    @property
    def excess(self) -> tuple[float, float] | None:
        """The mass in kg that the settings do not carry, and half its 95 % band; None without a result."""
        if self.result is None:
            return None
        mass, random, _ = self.result
        return mass, COVER * math.hypot(random, self._model, self._share * mass)

    @property
    def payload(self) -> tuple[float, float] | None:
        """The `payload.mass` in kg that carries the load, and half its 95 % band; None for an empty hand."""
        if self.result is None or self.excess is None or self.empty is self.result:
            return None
        more, band = self._beyond_empty or self.excess
        return max(0.0, self.settings.payload.mass + more), band

    @property
    def _beyond_empty(self) -> tuple[float, float] | None:
        """The mass in kg beyond that of the empty hand in the same pose, and half its 95 % band."""
        empty = self._empty
        if self.result is None or empty is None or math.dist(empty.lever, self.result.lever) > WEIGHING.same_pose:
            return None
        more = self.result.mass - empty.mass
        parts = self.result.deviation, empty.deviation, self._share * more, math.sqrt(2.0) * self._leaning
        return more, COVER * math.hypot(*parts)

    @property
    def text(self) -> str:
        """What is known, in a sentence."""
        if self.trouble:
            return f"not weighed: {self.trouble}"
        if self.excess is None:
            return "the arm moves a little: stay relaxed" if self._is_moving else "relax: the motors take the load over"
        text = "{:.3f} +- {:.3f} kg more than the settings carry".format(*self.excess)
        if self.payload is None:
            return f"{text}: the hand is empty"
        if self._beyond_empty:
            text = "{}; {:.3f} +- {:.3f} kg more than with an empty hand".format(text, *self._beyond_empty)
        return f"{text}: payload.mass = {self.payload[0]:.3f} carries it"

    def torque(
        self, dt: float, theta: Sequence[float], velocity: Sequence[float], tilt: Tilt, torque: Torque
    ) -> Torque:
        """Return `torque` (n,) in Nm with what carries the load, `dt` s later; `torque` alone once this is over.

        The compensator bounds the difference.
        """
        if self._matrix is None:
            self._matrix, dt = self.settings.moving.links.matrix(theta), 0.0
            self._begin(theta, velocity, tilt)
        if self.is_over:
            return torque
        self.elapsed += dt
        effort = self._tracker.step(dt, theta, velocity, torque, tilt.direction, self._matrix)
        return torque if self.is_over or self._is_wrong(dt) else effort

    def interrupt(self, why: str) -> None:
        """End it without a result."""
        self.trouble = Status(WeighingTrouble.SETTINGS_CHANGED, why)

    def _begin(self, theta: Sequence[float], velocity: Sequence[float], tilt: Tilt) -> None:
        """Refuse a pose that shows no load, and an arm that moves; compute what depends on the pose alone.

        These are each joint's weight in the fit of the mass, by least squares, where all joints share one error of the
        tilt; and the standard errors of the result: of the torque's scale, as a share, and in kg of the trunk's tilt,
        and of the whole model with it.
        """
        s, error, gravity = self.settings, self.settings.model_error, self.settings.arm.gravity
        self._lever = np.array(s.unit_load.torque(theta, tilt))  # dz/dq, m
        fastest = max(map(abs, velocity))
        if np.linalg.norm(self._lever) < WEIGHING.least_lever:
            pose = "bend the elbow by 45 degrees"
            self.trouble = Status(
                WeighingTrouble.HANGS_DOWN, f"the hand hangs below the joints, where a load needs no torque: {pose}"
            )
            return
        if fastest > WEIGHING.start_speed:
            self.trouble = Status(WeighingTrouble.MOVES, f"the arm moves at {fastest:.2f} rad/s: hold it still")
        wearer = s.worn(s.robot.massless(gravity))
        self._worn = np.array(wearer.torque(theta, tilt))  # Nm
        by_tilt = np.array([s.arm.torque(theta, axis) for axis in AXES]).T  # (n, 3) Nm/rad
        covariance = np.diag(np.hypot(error.torque, WEIGHING.least_error) ** 2) + error.tilt**2 * by_tilt @ by_tilt.T
        weight = np.linalg.solve(covariance, self._lever)
        self._weight = weight / (weight @ self._lever)  # 1/m
        self._tilted = error.tilt * np.linalg.norm(by_tilt, axis=1)  # Nm
        self._leaning = error.tilt * math.hypot(*(self._weight @ by_tilt)) / gravity
        self._share = math.hypot(*(self._weight * self._lever * error.scale))
        model = math.hypot(*(self._weight * error.torque), error.wearer * float(self._weight @ self._worn))
        self._model = math.hypot(model / gravity, self._leaning)
        self._tracker.lines = self._way(Station(tuple(theta), cycles=WEIGHING.cycles))

    def _way(self, station: Station) -> Iterator[Line]:
        """Yield each line when it begins; have the result, or the trouble, after the last one."""
        here, sweeps = np.array(station.theta), list[Sweep]()
        for _ in range(round(WEIGHING.take_over / MOTION.lead)):
            yield Line(here, here)
        yield Line(here, station.ends[0], station.speed)
        self._is_moving = True
        for _ in range(station.cycles):
            sweeps += yield from self._tracker.sweep(station)
        yield Line(station.ends[0], here, station.speed)
        self._finish(sweeps, followed(sweeps, station))
        yield Line(here, here)

    def _is_wrong(self, dt: float) -> bool:
        """Note what is wrong with the motion; return whether anything is."""
        error, gravity = self._tracker.error, self.settings.arm.gravity
        worst = int(np.argmax(np.abs(error)))
        times = zip(self._names, self._tracker.saturated, strict=True)
        saturated = [name for name, time in times if time > WEIGHING.persistence]
        correction = self._tracker.correction / (self.settings.arm.gain * gravity)
        mass = float(self._weight @ correction)
        foreign = (np.abs(correction - mass * self._lever) * gravity).tolist()
        is_foreign = max(foreign) > WEIGHING.foreign or not -WEIGHING.lifted < mass < MAX_PAYLOAD
        self._foreign = self._foreign + dt if is_foreign else 0.0
        if not dt <= WEIGHING.pause:
            self.trouble = Status(WeighingTrouble.NO_JOINT_STATES, f"no joint states for {1000.0 * dt:.0f} ms")
        elif abs(error[worst]) > WEIGHING.largest_error:
            is_thrown = float(error @ self._lever) < 0.0
            why = "was the load dropped?" if is_thrown else "relax gradually, and touch nothing"
            self.trouble = Status(
                WeighingTrouble.MOVED_AWAY, f"{self._names[worst]} moved by {abs(error[worst]):.2f} rad: {why}"
            )
        elif self._foreign > WEIGHING.persistence:
            self.trouble = Status(
                WeighingTrouble.HAND_ON_ARM,
                f"{self._names[int(np.argmax(foreign))]}: {max(foreign):.1f} Nm of a hand on the arm",
            )
        elif saturated:
            remedy = "the load needs more than max_effort here: hold it nearer to the body"
            self.trouble = Status(WeighingTrouble.TOO_HEAVY, f"{', '.join(saturated)}: {remedy}")
        return bool(self.trouble)

    def _finish(self, sweeps: Sequence[Sweep], shares: np.ndarray) -> None:
        """Fit the mass to the sweeps, of whose way each joint must have followed MOTION.followed; shares: (n,)."""
        seen, unrest = average(sweeps)
        error, weight, gravity = self.settings.model_error, self._weight, self.settings.arm.gravity
        scale = self.settings.arm.gain * gravity
        mass = float(weight @ (seen.effort / scale))
        needed = mass * scale * self._lever
        parts = (error.torque, seen.spread, self._share * needed, error.wearer * self._worn, self._tilted)
        known = COVER * np.linalg.norm(np.array(parts), axis=0)
        unlike = np.abs(seen.effort - needed) - known - WEIGHING.unlike[0] - WEIGHING.unlike[1] * np.abs(needed)
        restless = math.hypot(*(weight * unrest)) / gravity
        if restless > WEIGHING.unrest[0] + WEIGHING.unrest[1] * abs(mass):
            self.trouble = Status(
                WeighingTrouble.RESTLESS, f"{restless:.2f} kg between two turns: relax, and touch nothing"
            )
        for name, share, off in zip(self._names, shares, unlike, strict=True):
            if share < MOTION.followed:
                self.trouble = Status(
                    WeighingTrouble.NOT_FOLLOWED, f"{name} does not follow: is the arm carried, is a hand on it?"
                )
            elif off > 0.0:
                torque = f"{off + WEIGHING.unlike[0]:.1f} Nm"
                self.trouble = Status(
                    WeighingTrouble.NO_LOAD,
                    f"{name}: no load in the hand explains {torque}: someone may be touching the arm",
                )
        if not self.trouble:
            self.result = Weighed(mass, math.hypot(*(weight * seen.spread)) / gravity, self._lever)


class Weigher:
    """The service `~/weigh` of a compensator, an entry point of exo_gravity.clients.

    weighing: the last one. names: of the joints (n,).
    """

    help = "relax: the keys of /diagnostics have the result, docs/keys.md"  #: the answer once one has begun

    def __init__(self, control: Compensator, names: Sequence[str]) -> None:
        self.weighing: Weighing | None = None
        self._control, self._names = control, names
        self._count, self._refusal = 0, NO_REASON

    def begin(self, rate: float) -> Status:
        """Begin a weighing with joint states at `rate` Hz; return why it does not begin, false if it does."""
        control, last = self._control, self.weighing
        self._refusal = refusal(control.settings, control.terms.active, rate)
        is_alike = last and replace(last.settings, payload=control.settings.payload) == control.settings
        weighing = Weighing(control.settings, self._names, rate, last.empty if last and is_alike else None)
        if self._refusal:
            return self._refusal
        if last and not last.is_over:
            self._refusal = Status(WeighingRefused.UNDER_WAY, "a weighing is under way")
        elif not control.lend(weighing):
            self._refusal = Status(WeighingRefused.CHANGING_LOAD, "the load is changing: wait for it")
        else:
            self.weighing, self._count = weighing, self._count + 1
        return self._refusal

    @property
    def values(self) -> dict[str, object]:
        """The last weighing, for /diagnostics."""
        weighing = self.weighing
        mass, band = (weighing.excess if weighing else None) or (None, None)
        carried, carried_band = (weighing.payload if weighing else None) or (None, None)
        figures: dict[str, tuple[float | None, int]] = {
            "weighing time (s)": (weighing.elapsed if weighing else None, 1),
            "weighed mass (kg)": (mass, 3),
            "weighed band (kg)": (band, 3),
            "weighed payload (kg)": (carried, 3),
            "weighed payload band (kg)": (carried_band, 3),
        }
        return {
            "weighing": weighing.phase if weighing else WeighingPhase.NONE,
            "weighing text": weighing.text if weighing else "",
            "weighing number": self._count,
            "weighing trouble": weighing.trouble.code if weighing else NONE,
            "weigh refused": self._refusal.code,
            "weigh refused text": self._refusal,
            **{key: NONE if one is None else f"{round(one, digits):.12g}" for key, (one, digits) in figures.items()},
        }
