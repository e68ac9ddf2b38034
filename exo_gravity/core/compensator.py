"""Joint angles and trunk tilt -> the torques that hold the arm, without a step; or the reason why there are none.

One call does this: check that the input is fresh and finite, evaluate the law, blend in the last change of settings,
ramp in, clamp, limit the rate. A change of law, mode, mass or gain never steps the torque: the difference between the
old and the new settings' torque is kept as a remainder, which fades over `transition_time`. The rate limit comes last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from exo_gravity.core.anfis_law import AnfisLaw
from exo_gravity.core.arm import JOINT_COUNT, MAX_TOTAL_MASS, ArmModel
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.gravity import LAWS, Law, Torque
from exo_gravity.core.limits import MAX_COMMAND
from exo_gravity.core.param_table import check_owned, owned
from exo_gravity.core.tilt import SIDES, Tilt

MODES = ("one_g", "zero_g")
LAW_NAMES = (*LAWS, "anfis")
TILT_SPEED = 5.0  # rad/s: no trunk bows faster
TILT_JUMP = 0.1  # rad that two tilts may differ, however close in time
RAMP_TIME = 1.0  # s from no torque to full torque, at the start and after a break
# s without an answer after which the torque ramps in from zero. Longer than any command_timeout: the arm has been let
# down by then, so starting from zero cannot drop it.
BREAK = 0.2
LONGEST_STEP = 0.01  # s: after a pause the torque must not catch up in one step
MAX_ANGLE = 26.0  # rad: beyond what an AK motor can report, with any zero
NOTHING: Torque = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Settings:
    """What the compensator computes. All but `side` and `use_imu` may change while the arm is worn.

    side: 'left' or 'right'. robot: the exoskeleton's own arm. wearer_mass (4,) kg, wearer_cog (4,) m: the wearer's
    segments on each link. use_imu: False for a trunk that counts as upright. anfis: the model for the law 'anfis'.
    The other fields are parameters of `compensator`. `arm` is the arm that is compensated: the robot in One-G, robot
    and `support` times the wearer in Zero-G. `active_law` is the law in use. Raises ParameterError.
    """

    side: str
    robot: ArmModel
    law: str = owned("exact", "law that computes the gravity torque", choices=LAW_NAMES)
    mode: str = owned("one_g", "one_g compensates the robot, zero_g the wearer's arm too", choices=MODES)
    support: float = owned(1.0, "share of the wearer's arm that zero_g compensates", (0.0, 1.0))
    wearer_mass: Sequence[float] = NOTHING
    wearer_cog: Sequence[float] = NOTHING
    max_total_mass: float = owned(
        10.0, "largest total mass; a larger one is probably in the wrong unit", (0.5, MAX_TOTAL_MASS), "kg"
    )
    max_effort: Sequence[float] = owned((3.0, 9.0, 3.0, 3.0), "torque limit per joint", (0.0, MAX_COMMAND), "Nm")
    max_effort_rate: float = owned(50.0, "fastest change of torque", (1.0, 1000.0), "Nm/s")
    transition_time: float = owned(1.0, "time over which a change of mass, mode or law takes effect", (0.2, 30.0), "s")
    tilt_timeout: float = owned(0.08, "age of the trunk tilt at which the efforts are withdrawn", (0.01, 0.5), "s")
    use_imu: bool = True
    anfis: AnfisLaw | None = None
    arm: ArmModel = field(init=False)
    active_law: Law = field(init=False)

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise ParameterError("side", self.side, f"one of {', '.join(SIDES)}")
        check_owned(self)
        law = self.anfis if self.law == "anfis" else LAWS[self.law]
        if law is None:
            raise ParameterError("law", self.law, "another law unless anfis_file names a file from train_anfis")
        # Computed in every mode, so that an impossible wearer is refused before the mode is set to zero_g.
        whole = self.robot.with_wearer(self.wearer_mass, self.wearer_cog, self.support)
        if whole.total_mass > self.max_total_mass:
            robot, wearer = self.robot.total_mass, whole.total_mass - self.robot.total_mass
            bound = f"at most max_total_mass = {self.max_total_mass:g} (robot {robot:.2f}, wearer's share {wearer:.2f})"
            raise ParameterError("total mass in kg", round(whole.total_mass, 2), bound)
        object.__setattr__(self, "arm", whole if self.mode == "zero_g" else self.robot)
        object.__setattr__(self, "active_law", law)


class Answer(NamedTuple):
    """One answer of the compensator.

    effort: (4,) Nm, or None with the `reason`. clamped: joints (0..3) whose torque exceeded `max_effort`.
    fallback: why the exact law replaced the chosen one, or ''.
    """

    effort: Torque | None
    reason: str = ""
    clamped: tuple[int, ...] = ()
    fallback: str = ""


class Compensator:
    """The control law with its state: ramp, rate limit, and the remainder of the last change."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._tilt = Tilt.of(settings.side)
        self._trunk = (0.0, 0.0)  # pitch and roll
        self._tilt_time = -math.inf
        self._ramp_start = -math.inf
        self._last_answer = -math.inf
        self._effort = NOTHING
        self._remainder = NOTHING
        self._changed: float | None = None  # time of the last change of settings; None: no transition under way
        self._pending: Settings | None = None
        self._fallback = ""

    def apply(self, settings: Settings) -> None:
        """Use other settings from the next call on; the torque changes to them without a step."""
        if settings.side != self.settings.side:
            raise ParameterError("side", settings.side, f"{self.settings.side}: the side cannot change")
        self._pending = settings

    def set_tilt(self, now: float, pitch: float, roll: float) -> None:
        """Set the trunk's pitch and roll in rad, measured at `now` (s).

        Raises ParameterError unless a trunk can have moved there since the last measurement.
        """
        tilt = Tilt.of(self.settings.side, pitch, roll)
        reach = TILT_JUMP + TILT_SPEED * (now - self._tilt_time)
        if any(abs(new - old) > reach for new, old in zip((pitch, roll), self._trunk, strict=True)):
            expected = f"within {reach:.2f} rad of the last, {self._trunk[0]:.2f} and {self._trunk[1]:.2f}"
            raise ParameterError("trunk tilt", [pitch, roll], expected)
        self._tilt, self._trunk, self._tilt_time = tilt, (pitch, roll), now

    def step(self, now: float, theta: Sequence[float]) -> Answer:
        """Return the torque for joint angles `theta` (4,) rad at `now` s on a monotonic clock."""
        if len(theta) != JOINT_COUNT or not all(-MAX_ANGLE <= angle <= MAX_ANGLE for angle in theta):
            return Answer(None, f"joint angles {list(theta)} are not 4 numbers within {MAX_ANGLE:g} rad")
        timeout = self.settings.tilt_timeout
        if self.settings.use_imu and not now - self._tilt_time <= timeout:
            never = self._tilt_time == -math.inf
            return Answer(None, "no trunk tilt yet" if never else f"trunk tilt older than {timeout * 1000:.0f} ms")
        torque = self._transition(now, theta)
        if not all(map(math.isfinite, torque)):
            return Answer(None, f"the law gives {list(torque)} Nm")
        return self._limited(now, torque)

    def _law(self, theta: Sequence[float]) -> Torque:
        settings, tilt = self.settings, self._tilt
        law = settings.active_law
        self._fallback = law.outside(settings.arm, theta, tilt)
        if self._fallback:
            law = LAWS["exact"]
        return law.torque(settings.arm, theta, tilt)

    def _transition(self, now: float, theta: Sequence[float]) -> Torque:
        """Return the law's torque plus the remainder of the last change of settings."""
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
        dt = now - self._last_answer
        if not 0.0 <= dt <= BREAK:
            self._ramp_start, self._effort, dt = now, NOTHING, 0.0
        self._last_answer = now
        ramp = min(1.0, (now - self._ramp_start) / RAMP_TIME)
        step = self.settings.max_effort_rate * min(dt, LONGEST_STEP)
        effort, clamped = [], []
        for joint, (wanted, last, limit) in enumerate(zip(torque, self._effort, self.settings.max_effort, strict=True)):
            if abs(wanted) > limit:
                clamped.append(joint)
            target = ramp * max(-limit, min(limit, wanted))
            effort.append(max(last - step, min(last + step, target)))
        self._effort = tuple(effort)
        return Answer(self._effort, clamped=tuple(clamped), fallback=self._fallback)
