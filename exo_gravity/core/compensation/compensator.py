"""Joint angles and trunk tilt -> step-free torques that hold an arm of n joints, or the reason why there are none.

Each call checks that the input is fresh and finite, evaluates the law, blends in the last change of settings, ramps in,
clamps and limits the rate. A change of law, mode, mass or gain never steps the torque: the difference between the
torques before and after the change is kept as a remainder that fades. Where the chosen law does not apply, the exact
law replaces it, with the same transition, for at least `FALLBACK_TIME`.

The exoskeleton's own arm (`Settings`) has a wearer and terms on top of gravity compensation; any other arm
(`UrdfSettings`) has the torque of its URDF alone.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import NamedTuple

from exo_gravity.core.compensation.limiter import BREAK, EffortLimiter, Transition
from exo_gravity.core.compensation.settings import Settings, UrdfSettings
from exo_gravity.core.compensation.terms.terms import Terms
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.model.kinematics import turning_torque
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.trunk.felt_motion import FeltMotion
from exo_gravity.core.trunk.tilt_input import MAX_TURN, Tilted

FALLBACK_TIME = 0.5  # s for which the chosen law must apply before it replaces the exact law again
JOINTS = ("shoulder_rotation", "shoulder_abduction", "shoulder_flexion", "elbow_flexion")
MAX_ANGLE = 26.0  # rad, more than an AK motor can report with any zero


class Answer(NamedTuple):
    """One answer of the compensator."""

    effort: Torque | None  #: (n,) Nm; None for the given `reason`
    reason: str = ""
    clamped: tuple[int, ...] = ()  #: indices of the joints whose torque exceeded `max_effort`
    fallback: str = ""  #: why the exact law replaced the chosen one, or ''
    held: str = ""  #: why the last tilt is held on, and the bound of the error in Nm; or ''


class Compensator(Tilted):
    """The control law and its state: ramp, rate limit, and the remainder of the last change of settings.

    names: of the joints (4,), for the outer loop's input.
    """

    def __init__(self, settings: Settings | UrdfSettings, names: Sequence[str] = JOINTS) -> None:
        self.settings = settings
        #: what is added to gravity compensation; None if `settings` have no terms
        self.terms = Terms(names, settings.terms, settings.moving) if isinstance(settings, Settings) else None
        super().__init__(settings.side, settings.tilt_timeout)
        self._motion = FeltMotion()
        self._nothing = (0.0,) * len(settings.max_effort)
        self._limiter = EffortLimiter(len(settings.max_effort))
        self._transition = Transition()  # of the last change of law or settings
        self._torque: Torque = self._nothing  # before ramp and limits
        self._pending: Settings | UrdfSettings | None = None
        self._fallback = ""  # why the exact law replaces the chosen one
        self._fallback_until = -math.inf

    def apply(self, settings: Settings | UrdfSettings) -> None:
        """Use new settings from the next `step` on; the torque moves to them without a step."""
        if settings.side != self.settings.side:
            raise ParameterError("side", settings.side, f"{self.settings.side}, because the side cannot change")
        self._pending = settings
        if self.terms is not None and isinstance(settings, Settings):
            self.terms.apply(settings.terms, settings.moving)

    def set_motion(
        self, now: float, specific_force: Sequence[float], angular_velocity: Sequence[float], age: float = 0.0
    ) -> None:
        """Set what the trunk's IMU measured `age` s before `now`; used with `inertial`, while the tilt is fresh.

        specific_force m/s^2, angular_velocity rad/s: (3,) in the trunk's axes. Raises ParameterError.
        """
        self._motion.add(now - max(0.0, age), specific_force, angular_velocity)

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Answer:
        """Return the torque for joint angles `theta` (n,) rad at `now` s on a monotonic clock.

        velocity: (n,) rad/s, None if not known: then the terms add nothing.
        """
        count = len(self._nothing)
        if len(theta) != count or not all(-MAX_ANGLE <= angle <= MAX_ANGLE for angle in theta):
            return Answer(None, f"joint angles {list(theta)} are not {count} numbers within {MAX_ANGLE:g} rad")
        held = self._tilt.problem(now) if self.settings.use_imu else ""
        if held:
            turn = self._tilt.unknown_turn(now)
            if not turn <= MAX_TURN:
                return Answer(None, held)
            held = f"{held}: held on, torque off by at most {turn * self._largest_torque(theta):.2f} Nm"
        torque = self._without_step(now, theta)
        if not all(map(math.isfinite, torque)):
            return Answer(None, f"torque {list(torque)} Nm from the law is not finite")
        added = self.terms.torque(now, theta, velocity, torque) if velocity and self.terms else self._nothing
        s = self.settings
        effort, clamped = self._limiter.limit(now, torque, added, s.max_effort, s.max_effort_rate)
        return Answer(effort, clamped=clamped, fallback=self._fallback, held=held)

    def _largest_torque(self, theta: Sequence[float]) -> float:
        """Return the most in Nm that gravity takes of any joint at `theta` (n,) rad, whatever its direction."""
        settings = self.settings
        tilts = [Tilt.of_gravity(settings.side, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
        if isinstance(settings, Settings):
            torques = [settings.torque(theta, tilt, exact=True) for tilt in tilts]
        else:
            torques = [settings.torque(theta, tilt) for tilt in tilts]
        return max(math.hypot(*components) for components in zip(*torques, strict=True))

    def _law(self, now: float, theta: Sequence[float]) -> Torque:
        """Return the torque of the chosen law, or of the exact law while the chosen one does not apply."""
        settings, tilt = self.settings, self._tilt.at(now)
        if not isinstance(settings, Settings):
            return settings.torque(theta, tilt)
        felt = self._motion.at(now, settings.shoulder_from_imu) if settings.inertial and settings.use_imu else None
        if felt:
            magnitude = math.hypot(*felt.gravity) / STANDARD_GRAVITY
            tilt = Tilt.of_gravity(settings.side, felt.gravity)._replace(magnitude=magnitude)
        reason = settings.outside(theta, tilt)
        if reason:
            self._fallback, self._fallback_until = reason, now + FALLBACK_TIME
        elif now >= self._fallback_until:
            self._fallback = ""
        torque = settings.torque(theta, tilt, exact=bool(self._fallback))
        if felt is None:
            return torque
        turning = turning_torque(settings.arm, settings.side, theta, felt.angular_acceleration)
        return tuple(map(operator.add, torque, turning))

    def _without_step(self, now: float, theta: Sequence[float]) -> Torque:
        """Return the law's torque plus the remainder of the last change of settings or law."""
        replaced = bool(self._fallback)
        torque = self._law(now, theta)
        if bool(self._fallback) != replaced and 0.0 <= now - self._limiter.last_answer <= BREAK:
            # Continue from the last torque: the replaced law may not apply at `theta`.
            torque = self._transition.begin(now, self._torque, torque)
        else:
            torque = self._transition.blended(now, torque)
        if self._pending is not None:
            if self._pending.law != self.settings.law:
                self._fallback, self._fallback_until = "", -math.inf
            self.settings, self._pending = self._pending, None
            self._tilt.timeout = self.settings.tilt_timeout
            torque = self._transition.begin(now, torque, self._law(now, theta))
        self._torque = torque
        return torque
