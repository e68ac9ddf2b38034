"""Joint angles and trunk tilt -> step-free torques that hold an arm of n joints, or the reason why there are none.

Each call checks that the input is fresh and finite, evaluates law and terms, clamps their sum, ramps in and limits the
rate. A change of any setting is a guided motion (`guidance`). Where the chosen law does not apply, the exact law
replaces it in the same way, for at least `FALLBACK_TIME`.

The exoskeleton's own arm (`Settings`) has a wearer and terms on top of gravity compensation; any other arm
(`UrdfSettings`) has the torque of its URDF alone.
"""

import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

from exo_gravity.core.arm.arm import STANDARD_GRAVITY
from exo_gravity.core.arm.gravity import LAWS, Torque
from exo_gravity.core.arm.kinematics import turning_torque
from exo_gravity.core.arm.tilt import AXES, Tilt
from exo_gravity.core.compensation.guidance import (
    BREAK,
    LONGEST_STEP,
    RAMP_TIME,
    WATCH,
    DropWatch,
    GuidedChange,
    limited,
)
from exo_gravity.core.compensation.settings import Settings, UrdfSettings
from exo_gravity.core.compensation.support import SupportRequest
from exo_gravity.core.compensation.terms.terms import Active, Terms
from exo_gravity.core.trunk.inputs import TILT, FeltMotion, TiltInput

FALLBACK_TIME = 0.5  # s for which the chosen law must apply before it replaces the exact law again
JOINTS = ("shoulder_rotation", "shoulder_abduction", "shoulder_flexion", "elbow_flexion")
LEAST_CARRIED = 0.5  # of the load's torque, that motors must apply to carry it
MAX_ANGLE = 26.0  # rad, more than an AK motor can report with any zero


class Answer(NamedTuple):
    """One answer of the compensator."""

    effort: Torque | None  #: (n,) Nm; None for the given `reason`
    reason: str = ""
    clamped: tuple[int, ...] = ()  #: indices of the joints whose gravity torque exceeds `max_effort`
    fallback: str = ""  #: why the exact law replaced the chosen one, or ''
    remainder: Torque = ()  #: (n,) Nm by which a change of load is not done yet; () if none is under way
    damped: bool = False  #: whether the motors are to damp the joints meanwhile
    held: str = ""  #: why the last tilt is held on, and the bound of the error in Nm; or ''


class Scale(Protocol):
    """What weighs the load in the hand for a while: core/compensation/weighing.py."""

    trouble: str  #: why there is no result, or ''; set, it ends the weighing
    is_thrown: bool  #: whether the load must have left the hand

    @property
    def is_over(self) -> bool:
        """Whether it adds nothing any more."""
        ...

    def torque(
        self, dt: float, theta: Sequence[float], velocity: Sequence[float], tilt: Tilt, torque: Torque
    ) -> Torque:
        """Return what the arm gets in place of `torque` (4,) Nm, `dt` s after the last call."""
        ...


State = tuple[float, Sequence[float], Sequence[float] | None]  # time in s, joint angles and velocities as in `step`
Load = tuple[Settings | UrdfSettings, Active]  # what the compensator carries, and the terms on top of it


class Compensator:
    """The control law and its state: ramp, rate limit, and the change of load that is under way.

    names: of the joints (4,), for the outer loop's input.
    """

    def __init__(self, settings: Settings | UrdfSettings, names: Sequence[str] = JOINTS) -> None:
        self.settings = settings
        #: what is added to gravity compensation; None if `settings` have no terms
        self.terms = Terms(names, settings.terms, settings.moving) if isinstance(settings, Settings) else None
        #: of the trunk, or of the root link of another arm
        self.tilt = TiltInput(settings.side, settings.tilt_timeout)
        self.support_request = SupportRequest()  #: used with `support_adapts` in zero_g
        self.motion = FeltMotion()  #: of the trunk, used with `inertial` while the tilt is fresh
        self._nothing = (0.0,) * len(settings.max_effort)
        self._effort = self._nothing  # the last answer's,
        self._last_answer = self._ramp_start = -math.inf  # its time, and that of the first one after a break
        self._change = GuidedChange(len(settings.max_effort))
        self._origins: list[Load | None] = []  # where each joint's change began; None where no settings say
        self._torque: Torque = self._nothing  # the last, before ramp and rate limit
        self._pending: Settings | UrdfSettings | None = None
        self.applied: Sequence[float] | None = None  #: (n,) Nm, the motors' measured torque, set by who knows it
        self.dropped = 0.0  #: kg, the load that left the hand last; 0 for none
        self.scale: Scale | None = None  #: of the last weighing
        self._drop_watch, self._braked_until = DropWatch(), -math.inf  # s
        self._fallback = ""  # why the exact law replaces the chosen one
        self._fallback_until = -math.inf

    def apply(self, settings: Settings | UrdfSettings) -> None:
        """Use new settings of the same side from the next `step` on; the torque moves to them as a guided motion.

        A support that was raised on request stays as it is, while it may.
        """
        last = self._pending or self.settings
        if isinstance(settings, Settings) and isinstance(last, Settings) and settings.is_adaptive:
            settings = replace(settings, raised_support=last.raised_support)
        self._pending = settings

    def weigh(self, scale: Scale) -> str:
        """Let `scale` carry the load in the hand from the next `step` on, until it is over; return why not, or ''."""
        if self._active_scale:
            return "a weighing is under way"
        if not self._change.is_over:
            return "the load is changing: wait for it"
        self.scale = scale
        return ""

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Answer:
        """Return the torque for joint angles `theta` (n,) rad at `now` s on a monotonic clock.

        velocity: (n,) rad/s, None if not known: then the terms add nothing, and changes take longer.
        """
        count = len(self._nothing)
        if len(theta) != count or not all(-MAX_ANGLE <= angle <= MAX_ANGLE for angle in theta):
            return Answer(None, f"joint angles {list(theta)} are not {count} numbers within {MAX_ANGLE:g} rad")
        held = self.tilt.problem(now) if self.settings.use_imu else ""
        if held:
            turn = self.tilt.unknown_turn(now)
            if not turn <= TILT.turn:
                return Answer(None, held)
            held = f"{held}: held on, torque off by at most {turn * self._largest_torque(theta):.2f} Nm"
        self._follow_request(now)
        before = None
        if self._pending is not None:
            before = self.settings, self.terms.now if self.terms else Active()
            self._use(self._pending)
        self._watch_load(now, theta, velocity)
        replaced = bool(self._fallback)
        gravity = self._law(now, theta)
        if not all(map(math.isfinite, gravity)):
            return Answer(None, f"torque {list(gravity)} Nm from the law is not finite")
        added = self.terms.torque(now, theta, velocity) if velocity and self.terms else self._nothing
        s = self.settings
        dt = now - self._last_answer
        torque = tuple(map(operator.add, gravity, added))
        scale = self._active_scale if velocity else None
        if scale and velocity:
            torque = scale.torque(dt, theta, velocity, self.tilt.at(now), torque)
        ended = scale if scale and scale.is_over else None
        torque = clamped(torque, s.max_effort)
        if not 0.0 <= dt <= BREAK:  # the torque ramps in from zero
            self._change.stop()
            self._effort, self._ramp_start, dt = self._nothing, now, 0.0
        elif ended and ended.is_thrown:
            self._braked_until = now + WATCH  # a guided change would be too slow
        elif before is not None or bool(self._fallback) != replaced or ended:
            self._begin(before, torque, (now, theta, velocity))  # without `before`: a replaced law may not apply here
        if not self._change.is_over:
            start = self._start(self._origins, torque, (now, theta, velocity))
            torque = self._change.step(dt, velocity, start, torque)
        self._torque, self._last_answer = torque, now
        ramp, step = min(1.0, (now - self._ramp_start) / RAMP_TIME), s.max_effort_rate * min(dt, LONGEST_STEP)
        pairs = zip(torque, self._effort, strict=True)
        self._effort = tuple([limited(ramp * wanted, last, math.inf, step) for wanted, last in pairs])
        over = [joint for joint, most in enumerate(s.max_effort) if not -most <= gravity[joint] <= most]
        change = self._change
        remainder = () if change.is_over else change.remainder
        damped = change.is_large or now < self._braked_until
        return Answer(self._effort, "", tuple(over), self._fallback, remainder, damped, held)

    def _follow_request(self, now: float) -> None:
        """Carry as much of the wearer's arm as is asked for."""
        last = self._pending or self.settings
        if not isinstance(last, Settings) or not last.is_adaptive:
            return
        support = self.support_request.support(now, last.support, last.support_now)
        if support != last.support_now:
            self._pending = replace(last, raised_support=support)

    @property
    def _active_scale(self) -> Scale | None:
        return self.scale if self.scale and not self.scale.is_over else None

    def _watch_load(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None) -> None:
        """Withdraw the torque of a load that has left the hand, without a guided change: that would be too slow."""
        s = self.settings
        if not isinstance(s, Settings) or not s.payload_mass or not velocity:
            return
        per_mass = LAWS["exact"](s.unit_load, theta, self.tilt.at(now))  # the height that each joint gives the hand, m
        if self.applied:  # motors that do not carry the load cannot throw the arm
            needed = s.payload_mass * s.robot.gravity * sum(height * height for height in per_mass)
            if sum(map(operator.mul, per_mass, self.applied)) < LEAST_CARRIED * needed:
                return
        speed = sum(map(operator.mul, per_mass, velocity))
        if self._drop_watch.step(now - self._last_answer, speed, s.payload_mass):
            self.dropped, self._braked_until = s.payload_mass, now + WATCH
            self._use(replace(s, payload_mass=0.0))
            self._change.stop()

    def _largest_torque(self, theta: Sequence[float]) -> float:
        """Return the most in Nm that gravity takes of any joint at `theta` (n,) rad, whatever its direction."""
        torques = [self.settings.torque(theta, axis, exact=True)[0] for axis in AXES]
        return max(math.hypot(*components) for components in zip(*torques, strict=True))

    def _use(self, settings: Settings | UrdfSettings) -> None:
        if settings.law != self.settings.law:
            self._fallback, self._fallback_until = "", -math.inf
        self.settings, self._pending = settings, None
        if scale := self._active_scale:
            scale.trouble = "the settings changed"
        self.tilt.timeout = settings.tilt_timeout
        if self.terms is not None and isinstance(settings, Settings):
            self.terms.apply(settings.terms, settings.moving)

    def _begin(self, before: Load | None, torque: Torque, state: State) -> None:
        """Begin a change to `torque` (n,) Nm, from `before` or from where a joint's unfinished change began.

        Of the two, each joint takes the one that explains its present torque better.
        """
        ways: list[list[Load | None]] = [] if self._change.is_over else [self._origins]
        ways.append([before] * len(torque))
        chosen = self._change.begin(self._torque, [self._start(way, torque, state) for way in ways], torque)
        self._origins = [ways[index][joint] for joint, index in enumerate(chosen)]

    def _start(self, origins: Sequence[Load | None], torque: Torque, state: State) -> Torque:
        """Return the torque (n,) in Nm that each joint's load of `origins` would need here, `torque` for None."""
        needed = {id(load): self._torque_of(load, state) if load else torque for load in origins}
        return tuple([needed[id(load)][joint] for joint, load in enumerate(origins)])

    def _torque_of(self, load: Load, state: State) -> Torque:
        """Return the torque (n,) in Nm that `load` would need here, clamped as it was."""
        now, theta, velocity = state
        settings, active = load
        gravity, _ = self._gravity(settings, now, theta)
        if not velocity or self.terms is None:
            return clamped(gravity, settings.max_effort)
        return clamped(map(operator.add, gravity, self.terms.torque_of(active)), settings.max_effort)

    def _law(self, now: float, theta: Sequence[float]) -> Torque:
        """Return the torque of the chosen law, or of the exact law while the chosen one does not apply."""
        torque, reason = self._gravity(self.settings, now, theta, exact=now < self._fallback_until)
        if reason:
            self._fallback, self._fallback_until = reason, now + FALLBACK_TIME
        elif now >= self._fallback_until:
            self._fallback = ""
        return torque

    def _gravity(
        self, settings: Settings | UrdfSettings, now: float, theta: Sequence[float], exact: bool = False
    ) -> tuple[Torque, str]:
        """Return the torque (n,) in Nm by the law of `settings`, or by the exact law and why the law does not apply.

        The tilt is that of what the trunk feels as gravity. exact: by the exact law in any case.
        """
        if isinstance(settings, Settings) and settings.inertial and settings.use_imu:
            felt = self.motion.at(now, settings.shoulder_from_imu)
            if felt:
                tilt = Tilt.of_felt(settings.side, felt.gravity, STANDARD_GRAVITY)
                torque, reason = settings.torque(theta, tilt, exact)
                turning = turning_torque(settings.arm, settings.side, theta, felt.angular_acceleration)
                return tuple(map(operator.add, torque, turning)), reason
        return settings.torque(theta, self.tilt.at(now), exact)


def clamped(torque: Iterable[float], limit: Sequence[float]) -> Torque:
    """Return `torque` (n,) within -`limit`..`limit`, both in Nm."""
    return tuple([max(-most, min(most, tau)) for tau, most in zip(torque, limit, strict=True)])
