# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint angles and trunk tilt -> step-free torques that hold an arm of n joints, or the reason why there are none.

`Compensator.step` is the whole way: it checks the input and the tilt, evaluates the law, adds the terms and what a
client beside the path asks for, clamps, guides whatever changes, and limits the rate. Where the chosen law does not
apply, the exact law replaces it as a guided change, for at least FALLBACK_TIME. How the torque begins is for who
applies it (core/safety/guidance.py).
"""

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from exo_gravity.core.arm.interface import MAX_PAYLOAD, STANDARD_GRAVITY
from exo_gravity.core.arm.tilt import AXES, Tilt
from exo_gravity.core.compensation.load_change import DROP, PAUSE, TOUCH, DropWatch, GuidedChange, TouchWatch
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.support import SupportRequest
from exo_gravity.core.compensation.terms.terms import Terms, TermsInForce
from exo_gravity.core.numbers import Torque, clamp, rate_limited
from exo_gravity.core.params import JOINT_NAMES
from exo_gravity.core.trunk.inputs import TILT, FeltMotion, TiltInput
from exo_gravity.core.vocabulary import NO_REASON, Status, Withdrawal

FALLBACK_TIME = 0.5  # s for which the chosen law must apply before it replaces the exact law again
MAX_ANGLE = 26.0  # rad, more than an AK motor can report with any zero
LONGEST_STEP = (
    0.01  # s that the rate limit allows for after a shorter one, so that the torque does not catch up at once
)


CLIENTS = "exo_gravity.clients"  # entry points of what makes a client, by the name of the service that begins it
CLIENT_EFFORT = 2.0  # Nm of any joint, that a client may ask for beyond what any load in the hand needs


class Client(Protocol):
    """Moves a carried arm slightly from outside the path, as a weighing does (lab/weighing.py)."""

    @property
    def is_over(self) -> bool:
        """Whether it asks for nothing more."""
        ...

    def torque(
        self, dt: float, theta: Sequence[float], velocity: Sequence[float], tilt: Tilt, torque: Torque
    ) -> Torque:
        """Return what it asks for in place of `torque`, (n,) Nm each, `dt` s after the last call."""
        ...

    def interrupt(self, why: str) -> None:
        """End it, because of what the sentence says."""
        ...


class Compensation(NamedTuple):
    """What the compensator answers to one reading of the joints."""

    effort: Torque | None  #: (n,) Nm; None for the given `reason`
    reason: Status  #: why there are no efforts; false if there are
    clamped: tuple[int, ...] = ()  #: indices of the joints whose gravity torque exceeds `max_effort`
    fallback: str = ""  #: why the exact law replaced the chosen one
    remainder: Torque = ()  #: (n,) Nm by which a change of load is not done yet; () if none is under way
    damped: bool = False  #: whether the motors are to damp the joints meanwhile
    held: str = ""  #: why the last tilt is held on, and the bound of the error in Nm


class Reading(NamedTuple):
    """The joints and the trunk at one moment."""

    time: float  #: s on a monotonic clock
    theta: Sequence[float]  #: (n,) rad
    velocity: Sequence[float] | None  #: (n,) rad/s, None if not known
    tilt: Tilt


class Load(NamedTuple):
    """What the compensator carries."""

    settings: Settings
    terms: TermsInForce  #: on top of gravity compensation
    tilt: Tilt | None  #: at which it is carried; None: the newest one


class Compensator:
    """The control law and its state: rate limit, and the change of load that is under way.

    names: of the joints (n,), for the outer loop's input.
    """

    def __init__(self, settings: Settings, names: Sequence[str] = JOINT_NAMES.default) -> None:
        self.settings = settings
        self.terms = Terms(names, settings.terms, settings.moving)  #: what is added to gravity compensation
        #: of the trunk, or of the root link of another arm
        self.tilt = TiltInput(settings.side, settings.tilt_timeout)
        self.support_request = SupportRequest()  #: used with `support_adapts` in zero_g
        self.motion = FeltMotion()  #: of the trunk, used with `inertial` while the tilt is fresh
        self.applied: Sequence[float] | None = None  #: (n,) Nm, the motors' measured torque, set by who knows it
        self.lost: Mapping[str, object] = {}  #: what changed of the settings as the load was lost last, by parameter
        self._client: Client | None = None  # the last one
        self._most_asked: Sequence[float] = ()  # (n,) Nm, that it may ask for; () before its first call
        self._pending: Settings | None = None
        self._effort: Torque = (0.0,) * len(settings.max_effort)  # of the last step that had efforts,
        self._last = Reading(-math.inf, (), None, self.tilt.at(0.0))  # that it answers
        self._change: GuidedChange[Load] = GuidedChange(len(settings.max_effort))
        self._drop_watch, self._touch_watch = DropWatch(), TouchWatch()
        self._fallback = ""  # why the exact law replaces the chosen one
        self._fallback_until = -math.inf

    def apply(self, settings: Settings) -> None:
        """Use new settings of the same side from the next `step` on; the torque moves to them as a guided motion.

        A support that was raised on request stays as it is, while it may.
        """
        last = self._pending or self.settings
        if settings.is_adaptive:
            settings = replace(settings, raised_support=last.raised_support)
        self._pending = settings

    def lend(self, client: Client) -> bool:
        """Let `client` move the arm a little from the next `step` on; return False if another one or a change does."""
        if self._active_client or not self._change.is_over:
            return False
        self._client, self._most_asked = client, ()
        return True

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Compensation:
        """Return the torque for joint angles `theta` (n,) rad at `now` s on a monotonic clock.

        velocity: (n,) rad/s, None if not known: then the terms add nothing, and changes take longer.
        """
        if len(theta) != len(self._effort) or not all(-MAX_ANGLE <= angle <= MAX_ANGLE for angle in theta):
            expected = f"{len(self._effort)} numbers within {MAX_ANGLE:g} rad"
            impossible = f"joint angles {list(theta)} are not {expected}"
            return Compensation(None, Status(Withdrawal.IMPOSSIBLE_ANGLES, impossible))
        late, late_tilt = self.tilt.problem(now) if self.settings.use_imu else NO_REASON, ""
        if late:
            turn = self.tilt.unknown_turn(now)
            if not turn <= TILT.turn:
                return Compensation(None, late)
            late_tilt = f"{late}: held on, torque off by at most {turn * self._largest_torque(theta):.2f} Nm"
        self._follow_request(now)
        at = Reading(now, theta, velocity, self.tilt.at(now))
        if (self._pending or self.settings).payload.mass and velocity:
            self._withdraw_lost_load(at, velocity)
        before = self._loads_before()
        was_replaced = bool(self._fallback)
        gravity = self._law(at)
        if not all(map(math.isfinite, gravity)):
            infinite = f"torque {list(gravity)} Nm from the law is not finite"
            return Compensation(None, Status(Withdrawal.LAW_NOT_FINITE, infinite))
        s, dt = self.settings, now - self._last.time
        torque = gravity
        if velocity:
            torque = tuple(map(operator.add, gravity, self.terms.torque(now, theta, velocity)))
        client = self._active_client if velocity else None
        if client:
            torque = self._asked_for(client, at, torque)
        torque = tuple(map(clamp, torque, s.max_effort))
        needs = partial(self._torque_of, at)
        change = self._change
        if not 0.0 <= dt <= PAUSE:
            change.stop()
            dt, self._effort = 0.0, torque
        elif before or bool(self._fallback) != was_replaced or (client and client.is_over):
            held = self._held_here(before[-1], at) if before and before[-1].tilt else self._effort
            change.set_out(before or (None,), held, needs, torque)
        if not change.is_over:
            torque = change.follow(dt, velocity, needs, torque)
        self._last = at
        # Over 1 rad gravity's torque changes by its amplitude: a lower limit would make that of a moving arm false.
        turn, step = sum(map(abs, velocity or ())), min(dt, LONGEST_STEP)
        self._effort = tuple([
            rate_limited(new, last, step * (s.max_effort_rate + turn * most))
            for new, last, most in zip(torque, self._effort, s.max_effort, strict=True)
        ])  # fmt: skip
        if (
            s.mode == "zero_g"
            and velocity
            and now - self._touch_watch.time >= TOUCH.period
            and self.applied
            and max(map(abs, self.applied)) > TOUCH.least  # motors that are off carry no arm
        ):
            self._withdraw_from_empty(at, velocity, self.applied)
        over = tuple([n for n, most in enumerate(s.max_effort) if not -most <= gravity[n] <= most])
        remainder = () if change.is_over else change.remainder
        return Compensation(self._effort, NO_REASON, over, self._fallback, remainder, change.is_large, late_tilt)

    def _asked_for(self, client: Client, at: Reading, torque: Torque) -> Torque:
        """Return `torque` (n,) in Nm with what `client` asks for, within CLIENT_EFFORT and what any load needs."""
        asked = client.torque(at.time - self._last.time, at.theta, at.velocity or (), at.tilt, torque)
        if not self._most_asked:  # in the pose in which it began
            heaviest = MAX_PAYLOAD * self.settings.arm.gravity
            levers = self.settings.unit_load.torque(at.theta, at.tilt)
            self._most_asked = [CLIENT_EFFORT + heaviest * abs(lever) for lever in levers]
        return tuple(map(operator.add, torque, map(clamp, map(operator.sub, asked, torque), self._most_asked)))

    def _follow_request(self, now: float) -> None:
        """Carry as much of the wearer's arm as is asked for."""
        last = self._pending or self.settings
        if last.is_adaptive:
            support = self.support_request.support(now, last.support, last.support_now)
            if support != last.support_now:
                self._pending = replace(last, raised_support=support)

    def _largest_torque(self, theta: Sequence[float]) -> float:
        """Return the most in Nm that gravity takes of any joint at `theta` (n,) rad, whatever its direction."""
        torques = [self.settings.exact.torque(theta, axis) for axis in AXES]
        return max(math.hypot(*components) for components in zip(*torques, strict=True))

    def _loads_before(self) -> Sequence[Load]:
        """Return what may have been carried until now if the settings or the tilt have changed.

        New settings are used from now on.
        """
        overtaken = self.tilt.overtaken if self.settings.use_imu else None
        tilts = (overtaken, self._last.tilt) if overtaken else (None,)
        loads = [Load(self.settings, self.terms.in_force, tilt) for tilt in tilts]
        if (self._pending or overtaken) and (client := self._active_client):
            client.interrupt("the settings changed" if self._pending else "the trunk turned fast")
        if self._pending:
            self._use(self._pending)
            return loads
        return loads if overtaken else ()

    def _held_here(self, load: Load, at: Reading) -> Torque:
        """Return the last torque (n,) in Nm as it is in the present pose: joints turn on while the trunk turns.

        load: carried then. Each joint keeps its share of the way to it.
        """
        poses = at, self._last._replace(tilt=self.tilt.at(self._last.time))  # by the newest tilt, both
        here, there = (self._change.held(load, partial(self._torque_of, pose)) for pose in poses)
        return tuple([torque + new - old for torque, new, old in zip(self._effort, here, there, strict=True)])

    def _use(self, settings: Settings) -> None:
        if settings.law != self.settings.law:
            self._fallback, self._fallback_until = "", -math.inf
        self.settings, self._pending = settings, None
        self.tilt.timeout = settings.tilt_timeout
        self.terms.apply(settings.terms, settings.moving)

    def _withdraw_lost_load(self, at: Reading, velocity: Sequence[float]) -> None:
        """Carry a load that has left the hand no longer."""
        s = self.settings
        per_mass = s.unit_load.torque(at.theta, at.tilt)  # m that each joint lifts it, per rad
        if self.applied:  # motors that do not carry the load cannot throw the arm
            needed = s.payload.mass * s.arm.gravity * sum(height * height for height in per_mass)
            if sum(map(operator.mul, per_mass, self.applied)) < DROP.least_carried * needed:
                return
        speed = sum(map(operator.mul, per_mass, velocity))
        if self._drop_watch.step(at.time - self._last.time, speed, s.payload.mass):
            self.lost = {"payload.mass": 0.0}
            self._pending = replace(self._pending or s, payload=s.payload._replace(mass=0.0))

    def _withdraw_from_empty(self, at: Reading, velocity: Sequence[float], applied: Sequence[float]) -> None:
        """Carry the robot alone once nothing touches it."""
        s = self.settings
        weight = s.sprung(s.robot.torque(at.theta, at.tilt), at.theta)
        momentum, coriolis = (s.robot_by_mass or s.robot).links.momentum(at.theta, velocity)
        known = np.add(applied, coriolis) - weight
        carried, lacking = np.subtract(self._effort, weight), np.subtract(self._effort, applied)
        if self._touch_watch.step(at.time, max(map(abs, velocity)), np.array(momentum), known, carried, lacking):
            self.lost = {"mode": "one_g", "payload.mass": 0.0}
            self._pending = replace(s, mode="one_g", payload=s.payload._replace(mass=0.0))

    def _law(self, at: Reading) -> Torque:
        """Return the torque of the chosen law, or of the exact law while the chosen one does not apply."""
        torque, reason = self._gravity(self.settings, at, exact=at.time < self._fallback_until)
        if reason:
            self._fallback, self._fallback_until = reason, at.time + FALLBACK_TIME
        elif at.time >= self._fallback_until:
            self._fallback = ""
        return torque

    def _gravity(self, s: Settings, at: Reading, exact: bool = False) -> tuple[Torque, str]:
        """Return the torque (n,) in Nm by the law of the settings, or by the exact law and why theirs does not apply.

        The tilt is that of what the trunk feels as gravity. exact: by the exact law in any case.
        """
        felt = self.motion.at(at.time, s.shoulder_from_imu) if s.inertial and s.use_imu else None
        if not felt:
            return s.torque(at.theta, at.tilt, exact)
        torque, reason = s.torque(at.theta, Tilt.of_felt(s.side, felt.gravity, STANDARD_GRAVITY), exact)
        turning = s.arm.turning_torque(s.side, at.theta, felt.angular_acceleration)
        return tuple(map(operator.add, torque, turning)), reason

    @property
    def _active_client(self) -> Client | None:
        return self._client if self._client and not self._client.is_over else None

    def _torque_of(self, reading: Reading, load: Load) -> Torque:
        """Return the torque (n,) in Nm that `load` would need here, clamped as it was."""
        if load.tilt:
            torque, _ = load.settings.torque(reading.theta, load.tilt, exact=False)
        else:
            torque, _ = self._gravity(load.settings, reading)
        if reading.velocity:
            torque = tuple(map(operator.add, torque, self.terms.torque_of(load.terms)))
        return tuple(map(clamp, torque, load.settings.max_effort))
