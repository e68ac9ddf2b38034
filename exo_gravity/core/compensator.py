"""Joint angles and trunk tilt -> the torques that carry the arm, without a step, or the reason why there are none.

The chain of one call: is the input fresh and finite -> law -> bridge over the last change of settings -> ramp in ->
clamp -> rate limit. A change of law, mode, mass or gain never steps the torque: what the old settings gave beyond the
new ones is kept as a remainder, and fades over `transition_time`. Whatever changes, the rate limit has the last word.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from exo_gravity.core.anfis_law import AnfisLaw
from exo_gravity.core.arm import JOINT_COUNT, MAX_TOTAL_MASS, ArmModel, four_floats, one_float
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.gravity import LAWS, Torque
from exo_gravity.core.limits import MOST_EFFORT
from exo_gravity.core.tilt import SIDES, Tilt

MODES = ("one_g", "zero_g")
LAW_NAMES = (*LAWS, "anfis")
TILT_SPEED = 5.0  # rad/s, faster than anybody bows,
TILT_JUMP = 0.1  # rad, and this much besides
RAMP_TIME = 1.0  # s from no torque to all of it, at the start and after a break
BREAK = 0.2  # s without an answer after which the torque ramps in anew; longer than any command_timeout: by then the
# arm has been let down, and torque that starts from 0 can drop nobody
LONGEST_STEP = 0.01  # s: after a pause the torque must not catch up in one step
MAX_ANGLE = 26.0  # rad: beyond what an AK motor can report, with any zero
NOTHING: Torque = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Settings:
    """What the compensator computes, all of which may change while the arm is worn.

    side: 'left' or 'right'. robot: the exoskeleton's own arm. wearer_mass (4,) kg, wearer_cog (4,) m: the wearer's
    segments on each link. mode 'one_g' carries the robot alone, 'zero_g' also the share `support` (0..1) of the
    wearer. max_total_mass kg, the most that robot and wearer's share may weigh together: a slip of the unit is heavier.
    max_effort (4,) Nm, max_effort_rate Nm/s. transition_time s, over which a change of settings reaches the arm.
    tilt_timeout s, or 0 for a trunk that counts as upright. anfis: the model that law 'anfis' needs.
    Raises ParameterError. `arm` is what gravity is computed for.
    """

    side: str
    robot: ArmModel
    law: str = "exact"
    mode: str = "one_g"
    support: float = 1.0
    wearer_mass: Sequence[float] = NOTHING
    wearer_cog: Sequence[float] = NOTHING
    max_total_mass: float = 10.0
    max_effort: Sequence[float] = (3.0, 9.0, 3.0, 3.0)
    max_effort_rate: float = 50.0
    transition_time: float = 1.0
    tilt_timeout: float = 0.08
    anfis: AnfisLaw | None = None

    def __post_init__(self):
        for name, value, choices in (
            ("side", self.side, SIDES),
            ("law", self.law, LAW_NAMES),
            ("mode", self.mode, MODES),
        ):
            if value not in choices:
                raise ParameterError(name, value, f"one of {', '.join(choices)}")
        if self.law == "anfis" and self.anfis is None:
            raise ParameterError("law", self.law, "another law, or anfis_file given: a file from train_anfis")
        one_float("support", self.support, 0.0, 1.0)
        one_float("tilt_timeout", self.tilt_timeout, 0.0, 0.5, "s")
        one_float("max_total_mass", self.max_total_mass, 0.5, MAX_TOTAL_MASS, "kg")
        one_float("max_effort_rate", self.max_effort_rate, 1.0, 1000.0, "Nm/s")
        one_float("transition_time", self.transition_time, 0.2, 30.0, "s")
        limit = tuple(four_floats("max_effort", self.max_effort, 0.0, MOST_EFFORT, "Nm").tolist())
        object.__setattr__(self, "max_effort", limit)
        # Combined whatever the mode, so that an impossible wearer is refused before somebody switches to zero_g.
        whole = self.robot.with_wearer(self.wearer_mass, self.wearer_cog, self.support)
        if whole.total_mass > self.max_total_mass:
            robot, wearer = self.robot.total_mass, whole.total_mass - self.robot.total_mass
            bound = f"at most max_total_mass = {self.max_total_mass:g} (robot {robot:.2f}, wearer's share {wearer:.2f})"
            raise ParameterError("total mass in kg", round(whole.total_mass, 2), bound)
        object.__setattr__(self, "arm", whole if self.mode == "zero_g" else self.robot)


class Answer(NamedTuple):
    """effort: (4,) Nm, or None with the `reason`. clamped: joints (0..3) whose torque exceeded `max_effort`.

    fallback: why the exact law answered in place of the ANFIS, or ''.
    """

    effort: Torque | None
    reason: str = ""
    clamped: tuple[int, ...] = ()
    fallback: str = ""


class Compensator:
    """The control law with its memory: ramps, rate limit, and the remainder of the last change."""

    def __init__(self, settings: Settings):
        self.settings = settings
        self._tilt = Tilt.of(settings.side)
        self._trunk = (0.0, 0.0)  # pitch and roll
        self._tilt_time = -math.inf
        self._started = -math.inf  # when the present ramp began
        self._answered = -math.inf  # when the last torque was given
        self._effort = NOTHING
        self._remainder = NOTHING
        self._changed: float | None = None  # when the settings last changed; None: nothing to bridge
        self._pending: Settings | None = None
        self._fallback = ""

    def apply(self, settings: Settings) -> None:
        """Compute with other settings from the next call on; the torque gets there without a step."""
        if settings.side != self.settings.side:
            raise ParameterError("side", settings.side, f"left as it is, {self.settings.side}")
        self._pending = settings

    def tilt(self, now: float, pitch: float, roll: float) -> None:
        """Take the trunk's pitch and roll in rad, measured at `now`.

        Raises ParameterError unless they are angles to which a trunk can have come since it was measured last.
        """
        tilt = Tilt.of(self.settings.side, pitch, roll)
        reach = TILT_JUMP + TILT_SPEED * (now - self._tilt_time)
        if any(abs(new - old) > reach for new, old in zip((pitch, roll), self._trunk, strict=True)):
            expected = f"within {reach:.2f} of the last, {self._trunk[0]:.2f} and {self._trunk[1]:.2f}"
            raise ParameterError("trunk tilt", [pitch, roll], expected)
        self._tilt, self._trunk, self._tilt_time = tilt, (pitch, roll), now

    def step(self, now: float, theta: Sequence[float]) -> Answer:
        """Return the torque for joint angles `theta` (4,) rad at `now` s on a monotonic clock."""
        if len(theta) != JOINT_COUNT or not all(-MAX_ANGLE <= angle <= MAX_ANGLE for angle in theta):
            return Answer(None, f"joint angles {list(theta)} are not 4 numbers within {MAX_ANGLE:g} rad")
        timeout = self.settings.tilt_timeout
        if timeout and not now - self._tilt_time <= timeout:
            never = self._tilt_time == -math.inf
            return Answer(None, "no trunk tilt yet" if never else f"trunk tilt older than {timeout * 1000:.0f} ms")
        torque = self._transition(now, theta)
        if not all(map(math.isfinite, torque)):
            return Answer(None, f"the law gives {list(torque)} Nm")
        return self._limited(now, torque)

    def _law(self, theta: Sequence[float]) -> Torque:
        arm, tilt, law = self.settings.arm, self._tilt, LAWS.get(self.settings.law)
        self._fallback = ""
        if law is None:  # the ANFIS: exact rather than extrapolated
            self._fallback = self.settings.anfis.outside(arm, theta, tilt)
            law = LAWS["exact"] if self._fallback else self.settings.anfis
        return law.torque(arm, theta, tilt)

    def _transition(self, now: float, theta: Sequence[float]) -> Torque:
        """Return the law's torque, with what is left of the difference that the last change of settings made."""
        before = None
        if self._pending is not None:
            before = self._bridged(now, self._law(theta))
            self.settings, self._pending = self._pending, None
        torque = self._law(theta)
        if before is not None:
            self._remainder = tuple(b - t for b, t in zip(before, torque, strict=True))
            self._changed = now
        return self._bridged(now, torque)

    def _bridged(self, now: float, torque: Torque) -> Torque:
        if self._changed is None:
            return torque
        left = 1.0 - (now - self._changed) / self.settings.transition_time
        if left <= 0.0:
            self._changed = None
            return torque
        return tuple(t + left * r for t, r in zip(torque, self._remainder, strict=True))

    def _limited(self, now: float, torque: Torque) -> Answer:
        dt = now - self._answered
        if not 0.0 <= dt <= BREAK:
            self._started, self._effort, dt = now, NOTHING, 0.0
        self._answered = now
        ramp = min(1.0, (now - self._started) / RAMP_TIME)
        step = self.settings.max_effort_rate * min(dt, LONGEST_STEP)
        effort, clamped = [], []
        for joint, (wanted, last, limit) in enumerate(zip(torque, self._effort, self.settings.max_effort, strict=True)):
            if abs(wanted) > limit:
                clamped.append(joint)
            target = ramp * max(-limit, min(limit, wanted))
            effort.append(max(last - step, min(last + step, target)))
        self._effort = tuple(effort)
        return Answer(self._effort, clamped=tuple(clamped), fallback=self._fallback)
