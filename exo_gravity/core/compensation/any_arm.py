"""Gravity compensation of any serial arm of n joints, whose torques come from a model outside `core`.

The counterpart of `compensator.py` without what is known of the exoskeleton alone (its laws, the wearer, the terms).
The tilt's checks, the ramp, the clamp, the rate limit and the transition between settings are the same code.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from exo_gravity.core.compensation.command_fade import COMMAND_PARAMETERS
from exo_gravity.core.compensation.compensator import MAX_ANGLE, Answer
from exo_gravity.core.compensation.limiter import EffortLimiter
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.transition import Transition
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import MAX_GAIN, MAX_GRAVITY, STANDARD_GRAVITY
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.params import REAL_TIME_PARAMETERS, Param, param_of
from exo_gravity.core.trunk.tilt_input import Tilted

LAW = "urdf"
MAX_JOINTS = 32
MAX_EFFORT = 1000.0  # Nm; an industrial arm's largest joint


class GravityModel(Protocol):
    """An arm of n joints. max_effort: (n,) Nm, its joints' own limits, 0 if not known. mass: kg, that they carry."""

    max_effort: tuple[float, ...]
    mass: float

    def torque(self, theta: Sequence[float], gravity: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm that holds the arm at `theta` (n,) rad.

        gravity: (3,) m/s^2 in the axes of the arm's root link.
        """
        ...


@dataclass(frozen=True)
class AnyArmSettings:
    """Parameters of `compensator` for the law `urdf`; gain (n,) and max_effort (n,) Nm have one entry per joint."""

    gain: tuple[float, ...]
    gravity: float
    max_effort: tuple[float, ...]
    max_effort_rate: float
    transition_time: float
    tilt_timeout: float
    use_imu: bool


def any_arm_table(count: int) -> tuple[Param, ...]:
    """Return the parameters of `compensator` for the law `urdf` and `count` joints."""
    # fmt: off
    return (
        Param("law", LAW, "urdf computes the torque of any serial arm from its URDF", choices=(LAW,), fixed=True),
        Param("joint_names", [f"joint{n + 1}" for n in range(count)],
              "the joints in the order of the commands; the URDF's other joints count as fixed at 0", fixed=True),
        Param("urdf.file", "", "path of the URDF; empty: the topic urdf.topic", fixed=True),
        Param("urdf.topic", "/robot_description", "latched topic of the URDF, a std_msgs/String", fixed=True),
        Param("gain", [1.0] * count, "scales the torque of each joint", (0.0, MAX_GAIN)),
        Param("gravity", STANDARD_GRAVITY, "acceleration of gravity", (0.0, MAX_GRAVITY), "m/s^2"),
        Param("max_effort", [0.0] * count, "torque limit per joint; 0: the URDF's", (0.0, MAX_EFFORT), "Nm"),
        param_of(Settings, "max_effort_rate"),
        param_of(Settings, "transition_time"),
        Param("use_imu", True, "false assumes that the root link's z axis points up", fixed=True),
        param_of(Settings, "tilt_timeout"),
        *COMMAND_PARAMETERS,
        *REAL_TIME_PARAMETERS,
    )
    # fmt: on


def any_arm_settings(values: Mapping[str, Any], model: GravityModel) -> AnyArmSettings:
    """Return the settings that parameter values describe for `model`, or raise ParameterError."""
    limits = []
    for name, given, own in zip(values["joint_names"], values["max_effort"], model.max_effort, strict=True):
        if not (given or own):
            raise ParameterError(f"max_effort of {name}", given, "greater than 0, because the URDF has no effort limit")
        limits.append(given or own)
    others = ("gravity", "max_effort_rate", "transition_time", "tilt_timeout", "use_imu")
    return AnyArmSettings(tuple(values["gain"]), max_effort=tuple(limits), **{name: values[name] for name in others})


class AnyArm(Tilted):
    """The compensator of `model`'s n joints. Its methods are those of `core.compensation.compensator.Compensator`."""

    def __init__(self, model: GravityModel, settings: AnyArmSettings) -> None:
        self.settings = settings
        self._model = model
        self._count = len(settings.gain)
        super().__init__("left", settings.tilt_timeout)
        self._limiter = EffortLimiter(self._count)
        self._transition = Transition()
        self._pending: AnyArmSettings | None = None

    def apply(self, settings: AnyArmSettings) -> None:
        """Use new settings from the next `step` on; the torque moves to them without a step."""
        self._pending = settings

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Answer:
        """Return the torque for joint angles `theta` (n,) rad at `now` s on a monotonic clock."""
        if len(theta) != self._count or not all(-MAX_ANGLE <= angle <= MAX_ANGLE for angle in theta):
            return Answer(None, f"joint angles {list(theta)} are not {self._count} numbers within {MAX_ANGLE:g} rad")
        if self.settings.use_imu and (problem := self._tilt.problem(now)):
            return Answer(None, problem)
        torque = self._transition.blended(now, self._torque(now, theta), self.settings.transition_time)
        if self._pending is not None:
            self.settings, self._pending = self._pending, None
            self._tilt.timeout = self.settings.tilt_timeout
            torque = self._transition.begin(now, torque, self._torque(now, theta))
        if not all(map(math.isfinite, torque)):
            return Answer(None, f"torque {list(torque)} Nm from the URDF is not finite")
        s = self.settings
        effort, clamped = self._limiter.limit(now, torque, (0.0,) * self._count, s.max_effort, s.max_effort_rate)
        return Answer(effort, clamped=clamped)

    def _torque(self, now: float, theta: Sequence[float]) -> Torque:
        x, y, z = self._tilt.at(now).gravity_in_trunk
        g = self.settings.gravity
        torque = self._model.torque(theta, (g * x, g * y, g * z))
        return tuple(gain * tau for gain, tau in zip(self.settings.gain, torque, strict=True))
