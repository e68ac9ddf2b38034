# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The limits of a worn arm, and which motor readings are plausible.

watch.py finds readings that are a fault. shape.py keeps every command within the limits.
docs/safety_case.md compares the defaults with those of other systems.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from exo_gravity.core.arm.paper import MAX_MOMENT
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import USUAL_MOTORS
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import (
    MAX_STATUS_RATE,
    MOTOR_PARAMETERS,
    REPLY_SHARE,
    SIMULATED_BUSES,
    JointMotor,
    JointSample,
    Traffic,
    channels_of,
)
from exo_gravity.core.numbers import JOINT_COUNT, MAX_JOINTS, for_joints
from exo_gravity.core.params import JOINT_NAMES, REAL_TIME_PARAMETERS, Param, check_owned, owned, params_of

# An effort command beyond these is wrong: no joint with small motors needs half of the first, in Nm; and a large motor
# gives its peak torque at most.
MAX_COMMAND, MAX_OF_PEAK = 40.0, 2.0
MAX_EFFORT = 500.0  # Nm, of any motor that a person's arm may hang in
CONFIRM, HANGING = START_POSES = ("confirm", "hanging")
DAMPING = 5.0  # Nm s/rad, the range of kd on the wire
# Nm s/rad a second, by which damping rises and falls: more lets a joint swing longer, a rise at once is a torque step
DAMPING_RATE = DAMPING / 0.2
MAX_EFFORT_RATE = 50.0  # Nm/s; the full torque of an AK60-6 in 60 ms, slow enough not to jolt the arm


@dataclass(frozen=True)
class Equipment:
    """What ordinary equipment does. Time-outs leave room for it, and are computed from it where they can be.

    A worse bus or computer needs a lower `rate`, or longer `command_timeout` and `frozen_timeout`.
    """

    late: float = 0.02  #: s by which a busy computer runs a cycle, or hands on a message, too late
    lost: float = 0.03  #: share of the frames that are lost, each way
    timer: float = 0.016  #: s, the longest latency timer of a USB adapter


EQUIPMENT = Equipment()


def in_a_row(rate: float, rarely: float) -> int:
    """Return how many commands in a row one of four motors leaves unanswered once in `rarely` s at `rate` Hz.

    Lost frames alone are the reason: of the command, or of its reply.
    """
    return math.ceil(math.log(4.0 * rate * rarely) / -math.log(1.0 - (1.0 - EQUIPMENT.lost) ** 2))


@dataclass(frozen=True)
class SoftWall:
    """What holds a joint back before its limit.

    The figures make it passive, for inertias of 0.005 to 0.3 kg m^2 and any rate: behind the rate limit a spring alone
    would throw the arm back. The motor applies the damping without delay.
    """

    width: float = 0.1  #: rad before a joint limit, as in crisp_controllers
    stiffness: float = 25.0  #: Nm/rad
    most: float = 5.0  #: Nm, of the spring
    edge: float = 0.02  #: rad into the wall over which its damping rises to DAMPING
    release: float = 0.03  #: rad/s out of the wall, from which on the spring no longer pushes


@dataclass(frozen=True)
class Derating:
    """The temperatures of a motor in degC: one whose own protection switches it off would drop the arm."""

    most: float = 80.0  #: a fault from here on; an assumption
    span: float = 10.0  #: below `most`, over which the permitted torque falls to half


@dataclass(frozen=True)
class ReadingLimits:
    """Which readings of a motor are plausible, and when it is silent."""

    fastest: Sequence[float] = (5.0, 5.0, 5.0, 6.0)  #: rad/s, the usual `max_velocity`
    shock: float = 0.03  #: s above `max_velocity`, by half of it at most, that a slap on a table lasts
    overshoot: float = 0.1  #: rad past a joint limit: mechanical stops are not infinitely stiff
    missed: int = in_a_row(100.0, 250.0 * 3600.0)  #: commands without a reply, after which a motor may be silent: 7
    late: int = in_a_row(250.0, 80.0)  #: commands without a reply, after which a motor is late: 4
    reply_timeout: float = 2.5 * EQUIPMENT.late  #: s, and `missed` commands at least


WALL, HEAT, READING = SoftWall(), Derating(), ReadingLimits()
# s, on a real bus. A simulated bus may have longer ones: nobody wears that arm, and its computer may be busy.
LONGEST = {"command_timeout": 0.1, "frozen_timeout": 0.2}
PERIODS = 2  # of control that must fit into each time-out, so that one late cycle is not a fault


def _direction(what: str) -> Any:
    """Return a field with one component of a unit vector for each joint."""
    return owned((0.0,) * JOINT_COUNT, what, (-1.0, 1.0), expert=True)


@dataclass(frozen=True)
class Limits:
    """The limits that the worn arm must never exceed: one entry per joint (n,), or one number for all joints.

    The fields with a description are parameters of `can_bridge`. Raises ParameterError that names the invalid value.
    """

    joint_names: tuple[str, ...]
    position_min: Sequence[float] = owned((-1.65, -0.17, -0.78, -0.17), "lower joint limits", (-3.15, 3.15), "rad")
    position_max: Sequence[float] = owned((1.65, 3.14, 2.53, 3.14), "upper joint limits", (-3.15, 3.15), "rad")
    #: a reach stays below, a throw does not
    max_velocity: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT, "speed beyond which a joint is a fault; 0: 5, the paper's elbow 6", (0.0, 20.0), "rad/s"
    )
    max_effort: Sequence[float] = owned(
        tuple(MOTORS[name].rated_torque for name in USUAL_MOTORS),
        "torque limit, by default the motors' rated torque",
        (0.0, MAX_EFFORT),
        "Nm",
    )
    driven_speed: float = owned(
        1.5,
        "speed from which a joint that its motor drives is braked, and no longer driven 1 rad/s above",
        (0.5, 4.0),
        "rad/s",
        expert=True,
    )
    command_timeout: float = owned(
        0.05, "age of effort commands that trips a fault; on a real bus at most 0.1", (0.01, 5.0), "s"
    )
    frozen_timeout: float = owned(
        0.08,
        "time without a control cycle after which the watchdog takes over; on a real bus at most 0.2; a longer one is "
        "also that of replies",
        (0.05, 5.0),
        "s",
        expert=True,
    )
    #: s without a reply that makes a motor silent; `limits_of` derives it from the rate
    reply_timeout: float = READING.reply_timeout
    start_pose: str = owned(
        "confirm",
        "who vouches that the arm hangs at a start from unknown zeros: the operator, or (hanging) who starts the nodes",
        choices=START_POSES,
    )
    enable_timeout: float = owned(10.0, "time in which the checks of a start must pass", (2.0, 60.0), "s")
    sign_check_torque: float = owned(
        1.5, "largest test torque of the sign check; 0 skips the check", (0.0, 3.0), "Nm", expert=True
    )
    start_tilt: float = owned(
        1.05,
        "tilt of the trunk from upright beyond which no start begins; for a wearer who lies 1.8",
        (0.2, math.pi),
        "rad",
    )
    largest_moment: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT,
        "M1 to M4 of robot plus heaviest wearer, by `budget`; efforts beyond their need: a fault; zeros: not checked",
        (0.0, MAX_MOMENT),
        "kg m",
    )
    largest_addition: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT,
        "torque beyond what `largest_moment` needs, of assistance, terms, `inertial` and `joint_spring`",
        (0.0, 10.0),
        "Nm",
    )
    axis_x: Sequence[float] = _direction(
        "each joint's axis along x of the root link while all angles are 0, by `budget`; zeros: the paper's arm"
    )
    axis_y: Sequence[float] = _direction("the same along y")
    axis_z: Sequence[float] = _direction("the same along z")
    link_x: Sequence[float] = _direction("the way from each joint to the next along x of the root link, likewise")
    link_y: Sequence[float] = _direction("the same along y")
    link_z: Sequence[float] = _direction("the same along z")
    home: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT,
        "angles of the hanging arm, where a start from unknown zeros begins",
        (-3.15, 3.15),
        "rad",
    )
    #: (n,) rad from `home` at the first start; `limits_of` takes it from the motors
    home_tolerance: Sequence[float] = tuple(MOTORS[name].home_tolerance for name in USUAL_MOTORS)
    #: (n,) Nm beyond which an effort command is wrong; `limits_of` takes it from the motors
    max_command: Sequence[float] = (MAX_COMMAND,) * JOINT_COUNT
    channels: Sequence[str] = ()  #: of the motors' buses, (n,); () if that does not matter

    def __post_init__(self) -> None:
        names = self.joint_names
        if not 1 <= len(set(names)) == len(names) <= MAX_JOINTS or not all(names):
            raise ParameterError("joint_names", list(names), f"1 to {MAX_JOINTS} different names")
        check_owned(self, len(names))
        for name in ("home_tolerance", "max_command"):
            object.__setattr__(self, name, for_joints(getattr(self, name), len(names)))
        fastest = zip(self.max_velocity, for_joints(READING.fastest, len(names)), strict=True)
        object.__setattr__(self, "max_velocity", tuple([own or usual for own, usual in fastest]))
        object.__setattr__(self, "channels", tuple(self.channels) or ("",) * len(names))
        self._check_directions()
        if any(high - low < 4 * WALL.width for low, high in zip(self.position_min, self.position_max, strict=True)):
            expected = f"at least {4 * WALL.width} rad above position_min = {list(self.position_min)}"
            raise ParameterError("position_max", list(self.position_max), expected)
        columns = zip(names, self.position_min, self.home, self.position_max, self.home_tolerance, strict=True)
        for name, low, home, high, tolerance in columns:
            if not low - tolerance <= home <= high + tolerance:
                raise ParameterError(f"home of {name}", home, f"within its limits, {low:g} to {high:g} rad")

    @property
    def axes(self) -> tuple[tuple[float, float, float], ...]:
        """Unit vectors (n, 3) along the joints' axes of an arm from a URDF, () for the paper's arm."""
        axes = zip(self.axis_x, self.axis_y, self.axis_z, strict=True)
        return tuple(axes) if any((*self.axis_x, *self.axis_y, *self.axis_z)) else ()

    @property
    def ways(self) -> tuple[tuple[float, float, float], ...]:
        """Unit vectors (n, 3) along its links, zeros for one without length."""
        return tuple(zip(self.link_x, self.link_y, self.link_z, strict=True))

    def _check_directions(self) -> None:
        """Check axes and links, which `largest_moment` of any arm but the paper's needs. Raises ParameterError."""
        moments, names = list(self.largest_moment), self.joint_names
        if not self.axes:
            if any(moments) and len(names) != JOINT_COUNT:
                expected = "zeros without axis_x, axis_y, axis_z, which `budget` prints for arms but the paper's"
                raise ParameterError("largest_moment", moments, expected)
            return
        for name, moment, axis, way in zip(names, moments, self.axes, self.ways, strict=True):
            for what, vector, sizes in (("axis", axis, (1.0,)), ("link", way, (0.0, 1.0))):
                if not any(abs(math.hypot(*vector) - size) < 0.01 for size in sizes):
                    expected = f"a vector of length {' or '.join(f'{size:g}' for size in sizes)}"
                    raise ParameterError(f"{what}_x, _y, _z of {name}", list(vector), expected)
            if moment and not any(way):
                raise ParameterError(f"largest_moment of {name}", moment, "0 for a link without a direction")

    def is_silent(self, now: float, joint: JointSample) -> bool:
        """Return whether the reading `joint` of a motor is older than `reply_timeout` at `now` (s)."""
        return not now - joint.time <= self.reply_timeout


LIMIT_PARAMETERS = params_of(Limits, fixed=True)
CAN_BRIDGE = (
    JOINT_NAMES,
    Param("autostart", False, "configure and activate once at the start", fixed=True),
    Param("rate", 250.0, "control cycles, as far as the CAN bus allows", (20.0, 2000.0), "Hz", fixed=True),
    *MOTOR_PARAMETERS,
    Param(
        "can.serial",
        "",
        "serial number of the adapter; empty: any",
        fixed=True,
    ),
    *LIMIT_PARAMETERS,
    *REAL_TIME_PARAMETERS,
)


def limits_of(values: Mapping[str, Any]) -> Limits:
    """Return the limits that `can_bridge`'s parameter values describe, or raise ParameterError."""
    given = {param.name: values[param.name] for param in LIMIT_PARAMETERS}
    given["channels"] = channels_of(values["can.channel"], len(values["joint_names"]))
    given["home_tolerance"] = tuple(MOTORS[name].home_tolerance for name in values["motor"])
    given["max_command"] = tuple(max(MAX_COMMAND, MAX_OF_PEAK * MOTORS[name].peak_torque) for name in values["motor"])
    shortest, patience = READING.reply_timeout, given["frozen_timeout"]
    usual = min(2.0 * shortest, max(shortest, READING.missed / values["rate"]))
    given["reply_timeout"] = patience if patience > LONGEST["frozen_timeout"] else usual
    for name in LONGEST:
        if given[name] > LONGEST[name] and values["can.interface"] not in SIMULATED_BUSES:
            raise ParameterError(name, given[name], f"at most {LONGEST[name]:g} s on a real bus")
    return Limits(tuple(values["joint_names"]), **given)


def check_bridge(rate: float, motors: Sequence[JointMotor], limits: Limits, buses: Collection[Traffic] = ()) -> None:
    """Check the parameters of a `can_bridge` with control rate `rate` (Hz) against each other.

    buses: the traffic on each of its buses. Raises ParameterError that names both values.
    """
    shortest, name = min((getattr(limits, name), name) for name in LONGEST)
    if rate * shortest < PERIODS - 1e-9:
        expected = f"at least {PERIODS / shortest:g} Hz: {name} = {shortest:g} s must span {PERIODS} periods"
        raise ParameterError("rate", rate, expected)
    status_rate = min([bus.status_rate for bus in buses], default=MAX_STATUS_RATE)
    if rate > REPLY_SHARE * status_rate + 1e-9 and not all(motor.wire_format.replies for motor in motors):
        expected = f"at most {REPLY_SHARE * status_rate:g} Hz: each cycle waits for a status frame of a V3 board"
        raise ParameterError("rate", rate, f"{expected}, which sends {status_rate:g} a second")
    if not all(limits.max_effort):
        raise ParameterError("max_effort", list(limits.max_effort), "above 0 Nm: else nothing carries the arm")
    peak = [motor.peak_effort for motor in motors]
    if any(effort > most + 1e-9 for effort, most in zip(limits.max_effort, peak, strict=True)):
        shown = [round(effort, 2) for effort in peak]
        raise ParameterError("max_effort", list(limits.max_effort), f"at most the motors' peak torque, {shown} Nm")
    for bus in buses:
        bus.check(rate)
