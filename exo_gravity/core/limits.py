"""The limits of a worn arm: which readings are a fault, and what a torque may be before it reaches a motor.

`find_fault` looks at what the motors say. `shape` takes the torque that was asked through, in this order: the soft
wall before a joint stop, the clamp to the permitted torque (derated with temperature), and the rate limit. Defaults
and the systems they were taken from are in the README's table of limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from exo_gravity.core.arm import JOINT_COUNT, four_floats, one_float
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors import MOTOR_ERRORS

MOST_EFFORT = 40.0  # Nm that a compensator may ask at all, twice what a heavy arm's shoulder needs; more is no torque
WALL_WIDTH = 0.1  # rad before a joint stop, as in crisp_controllers
WALL_TORQUE = 5.0  # Nm at the stop
OVERSHOOT = 0.1  # rad past a joint stop that is still no fault: the stops are not infinitely stiff
DERATING = 10.0  # degC below the fault over which the permitted torque falls to half
JUMP = 0.05  # rad that a reading may be off what the velocity limit explains


class Fault(NamedTuple):
    """Why the arm was let down: a `code` for programs, a `reason` for people."""

    code: str
    reason: str


class JointSample(NamedTuple):
    """The newest reading of one joint: rad, rad/s, Nm, degC, error code, and its time on the caller's clock in s."""

    position: float
    velocity: float
    effort: float
    temperature: int | None
    error: int | None
    time: float


UNKNOWN = JointSample(math.nan, math.nan, math.nan, None, None, -math.inf)


@dataclass(frozen=True)
class Limits:
    """What the wearer's arm must never exceed. Per joint (4,), or one number for all.

    joint_names; position_min, position_max rad; max_velocity rad/s; max_effort Nm; max_effort_rate Nm/s;
    max_temperature degC; reply_timeout and command_timeout s: ages at which a reading or a command is a fault;
    ramp_time s: from no torque to all of it; fade_time s: from all of it to none; damping Nm s/rad, the motor's kd on
    the way down. home, home_tolerance rad: where the arm hangs when its motors are switched on; a single encoder's zero
    may be off by whole turns of the motor, 60 degrees of an AK60-6, 40 of an AK80-9, and the tolerances lie below half
    of that. sign_check_torque Nm: the most that a joint is pushed with to see which way it gives; 0: no check.
    Raises ParameterError that names the offending value.
    """

    joint_names: tuple[str, ...]
    position_min: Sequence[float]
    position_max: Sequence[float]
    max_velocity: Sequence[float]
    max_effort: Sequence[float]
    max_effort_rate: float = 50.0
    max_temperature: float = 80.0
    reply_timeout: float = 0.05
    command_timeout: float = 0.05
    ramp_time: float = 1.0
    fade_time: float = 2.0
    damping: float = 5.0
    home: Sequence[float] = (0.0, 0.0, 0.0, 0.0)
    home_tolerance: Sequence[float] = (0.5, 0.34, 0.5, 0.5)
    sign_check_torque: float = 1.5

    def __post_init__(self):
        if len(set(self.joint_names)) != JOINT_COUNT or not all(self.joint_names):
            raise ParameterError("joint_names", list(self.joint_names), "4 different names")
        bounds = {
            "position_min": (-3.15, 3.15, "rad"),
            "position_max": (-3.15, 3.15, "rad"),
            "max_velocity": (0.1, 20.0, "rad/s"),
            "max_effort": (0.0, MOST_EFFORT, "Nm"),
            "home": (-3.15, 3.15, "rad"),
            "home_tolerance": (0.01, 6.3, "rad"),
        }
        for name, bound in bounds.items():
            object.__setattr__(self, name, tuple(four_floats(name, getattr(self, name), *bound).tolist()))
        scalars = {
            "max_effort_rate": (1.0, 1000.0, "Nm/s"),
            "max_temperature": (30.0, 120.0, "degC"),
            "reply_timeout": (0.01, 0.1, "s"),
            "command_timeout": (0.01, 0.1, "s"),
            "ramp_time": (0.5, 30.0, "s"),
            "fade_time": (0.5, 30.0, "s"),
            "damping": (0.5, 5.0, "Nm s/rad"),
            "sign_check_torque": (0.0, 3.0, "Nm"),
        }
        for name, bound in scalars.items():
            object.__setattr__(self, name, one_float(name, getattr(self, name), *bound))
        if not all(
            high - low >= 4 * WALL_WIDTH for low, high in zip(self.position_min, self.position_max, strict=True)
        ):
            expected = f"at least {4 * WALL_WIDTH} rad above position_min = {list(self.position_min)}"
            raise ParameterError("position_max", list(self.position_max), expected)

    def silent(self, now: float, joint: JointSample) -> bool:
        """Return whether the reading `joint` is so old at `now` s that its motor counts as silent."""
        return not now - joint.time <= self.reply_timeout

    def find_fault(
        self, now: float, joints: Sequence[JointSample], before: Sequence[JointSample], overshoot: float = OVERSHOOT
    ) -> Fault | None:
        """Return the first fault that the readings `joints` show at `now`, given those `before` them, or None.

        overshoot: rad past the joint limits that are no fault yet.
        """
        for i, (name, joint, last) in enumerate(zip(self.joint_names, joints, before, strict=True)):
            if self.silent(now, joint):
                return Fault("motor_silent", f"{name}: no reply for more than {self.reply_timeout * 1000:.0f} ms")
            if joint.error:
                text = MOTOR_ERRORS.get(joint.error, "unknown")
                return Fault("motor_error", f"{name}: the motor reports error {joint.error} ({text})")
            if joint.temperature is not None and joint.temperature >= self.max_temperature:
                return Fault(
                    "over_temperature", f"{name}: {joint.temperature} degC, the limit is {self.max_temperature:g}"
                )
            if not abs(joint.velocity) <= self.max_velocity[i]:
                return Fault("over_speed", f"{name}: {joint.velocity:.2f} rad/s, the limit is {self.max_velocity[i]:g}")
            low, high = self.position_min[i], self.position_max[i]
            if not low - overshoot <= joint.position <= high + overshoot:
                return Fault("outside_limits", f"{name}: {joint.position:.3f} rad, the limits are {low:g} to {high:g}")
            reach = JUMP + self.max_velocity[i] * (joint.time - last.time)
            if abs(joint.position - last.position) > reach:  # False while `last` is UNKNOWN
                return Fault("position_jump", f"{name}: from {last.position:.3f} to {joint.position:.3f} rad at once")
        return None

    def find_wrong_zero(self, joints: Sequence[JointSample]) -> Fault | None:
        """Return the fault of an arm that should hang at home and says that it does not, or None."""
        columns = (self.joint_names, joints, self.home, self.home_tolerance)
        for name, joint, home, tolerance in zip(*columns, strict=True):
            if not abs(joint.position - home) <= tolerance:
                expected = f"within {tolerance:g} of home = {home:g}: let the arm hang, or its zero is wrong"
                return Fault("implausible_zero", f"{name}: {joint.position:.3f} rad at the start, must be {expected}")
        return None

    def shape(
        self, effort: Sequence[float], share: float, joints: Sequence[JointSample], before: Sequence[float], dt: float
    ) -> tuple[tuple[float, ...], set[str]]:
        """Return the torque in Nm that the motors may get, and the names of the limits that acted.

        effort: (4,) Nm asked, of which, as of the wall, only `share` (0..1) is given while the arm ramps in.
        before: (4,) Nm given `dt` s ago. Raises ParameterError where `effort` is no torque that anybody can mean.
        """
        step = self.max_effort_rate * dt
        shaped, acted = [], set()
        for i, (name, joint) in enumerate(zip(self.joint_names, joints, strict=True)):
            if not abs(effort[i]) <= MOST_EFFORT:
                raise ParameterError(f"effort of {name}", effort[i], f"at most {MOST_EFFORT:g} Nm either way")
            wall = self._wall(i, joint.position)
            permitted = self.max_effort[i] * self._derating(joint.temperature)
            wanted = share * (effort[i] + wall)
            clamped = max(-permitted, min(permitted, wanted))
            limited = max(before[i] - step, min(before[i] + step, clamped))
            for limit, acts in (
                ("soft wall", wall != 0.0),
                ("derating", permitted < self.max_effort[i]),
                ("max_effort", clamped != wanted),
                ("max_effort_rate", limited != clamped),
            ):
                if acts:
                    acted.add(f"{limit} ({name})")
            shaped.append(limited)
        return tuple(shaped), acted

    def _wall(self, i: int, position: float) -> float:
        stiffness = WALL_TORQUE / WALL_WIDTH
        below = self.position_min[i] + WALL_WIDTH - position
        above = position - self.position_max[i] + WALL_WIDTH
        if below > 0.0:
            return min(WALL_TORQUE, stiffness * below)
        return -min(WALL_TORQUE, stiffness * above) if above > 0.0 else 0.0

    def _derating(self, temperature: int | None) -> float:
        if temperature is None:
            return 1.0
        return max(0.5, min(1.0, 0.5 + 0.5 * (self.max_temperature - temperature) / DERATING))
