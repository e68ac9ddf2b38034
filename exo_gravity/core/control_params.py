"""The parameters of `can_bridge` and `compensator`, and what their values mean: limits, motors, settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from exo_gravity.core.anfis_law import AnfisLaw
from exo_gravity.core.arm import MAX_GAIN, MAX_GRAVITY, MAX_LENGTH, MAX_MASS, MAX_TOTAL_MASS, STANDARD_GRAVITY, ArmModel
from exo_gravity.core.compensator import LAW_NAMES, MODES, Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.joint_motor import JointMotor
from exo_gravity.core.limits import MOST_EFFORT, Limits
from exo_gravity.core.motors import MOTORS
from exo_gravity.core.param_table import Param
from exo_gravity.core.tilt import SIDES
from exo_gravity.core.wearer import SEX, TABLES, TYPICAL_LENGTH, Wearer

OPTIONS = "can.options"  # everything below it goes to python-can as it is

JOINT_NAMES = Param(
    "joint_names",
    ["right_shoulder_rotation", "right_shoulder_abduction", "right_shoulder_flexion", "right_elbow_flexion"],
    "the four joints from the shoulder to the elbow, as in joint_states",
    fixed=True,
)
# fmt: off
REAL_TIME_PARAMETERS = (
    Param("thread_priority", 0, "SCHED_FIFO priority of the hot threads, if permitted; 0: none", (0, 99), fixed=True),
    Param("lock_memory", False, "keep the process's memory from being paged out, where permitted", fixed=True),
)
# For `can_bridge` these are what it believes of the motors; for `simulator`, what is true.
MOTOR_PARAMETERS = (
    Param("can.interface", "", "python-can interface, e.g. socketcan, udp_multicast", fixed=True, required=True),
    Param("can.channel", "", "python-can channel, e.g. can0", fixed=True, required=True),
    Param("motor", ["AK60-6", "AK80-9", "AK60-6", "AK60-6"], "motor types", choices=tuple(MOTORS), fixed=True),
    Param("can_id", [1, 2, 3, 4], "CAN IDs", (1, 126), fixed=True),
    Param("direction", [1, 1, 1, 1], "1 or -1: joint angle = direction * (motor angle - zero)", (-1, 1), fixed=True),
    Param("zero", [0.0, 0.0, 0.0, 0.0], "motor angle in rad where the joint's angle is 0", (-12.5, 12.5), fixed=True),
    Param("torque_scale", [1.0, 1.0, 1.0, 1.0], "real torque per commanded Nm", (0.2, 2.0), fixed=True),
    Param("velocity_range", [45.0, 50.0, 45.0, 45.0], "wire range of the firmware in rad/s", (1.0, 100.0), fixed=True),
    Param("torque_range", [15.0, 18.0, 15.0, 15.0], "wire range of the firmware in Nm", (1.0, 100.0), fixed=True),
)
LIMIT_PARAMETERS = (
    Param("position_min", [-1.65, -0.17, -0.78, -0.17], "lower joint limits in rad", (-3.15, 3.15), fixed=True),
    Param("position_max", [1.65, 3.14, 2.53, 3.14], "upper joint limits in rad", (-3.15, 3.15), fixed=True),
    Param("max_velocity", [5.0, 5.0, 5.0, 6.0], "speed in rad/s that lets the arm down", (0.1, 20.0), fixed=True),
    Param("max_effort", [3.0, 9.0, 3.0, 3.0], "largest torque in Nm; rated by default", (0.0, 18.0), fixed=True),
    Param("max_effort_rate", 50.0, "fastest change of torque in Nm/s", (1.0, 1000.0), fixed=True),
    Param("max_temperature", 80.0, "motor temperature in degC that lets the arm down", (30.0, 120.0), fixed=True),
    Param("command_timeout", 0.05, "age of efforts in s that lets the arm down", (0.01, 0.1), fixed=True),
    Param("reply_timeout", 0.05, "silence of a motor in s that lets the arm down", (0.01, 0.1), fixed=True),
    Param("ramp_time", 1.0, "from no torque to all of it in s", (0.5, 30.0), fixed=True),
    Param("fade_time", 2.0, "from all torque to none in s, when the arm is let down", (0.5, 30.0), fixed=True),
    Param("damping", 5.0, "motor-side damping on the way down in Nm s/rad", (0.5, 5.0), fixed=True),
    Param("home", [0.0, 0.0, 0.0, 0.0], "rad, where the arm hangs at the start", (-3.15, 3.15), fixed=True),
    Param("home_tolerance", [0.5, 0.34, 0.5, 0.5], "rad off home, refused at the start", (0.01, 6.3), fixed=True),
    Param("sign_check_torque", 1.5, "Nm that try a joint's sign at the start; 0: none", (0.0, 3.0), fixed=True),
)
CAN_BRIDGE = (
    JOINT_NAMES,
    Param("autostart", True, "configure and activate at start, without an operator", fixed=True),
    Param("rate", 250.0, "control cycles per second, as many as fit on the wire", (20.0, 2000.0), fixed=True),
    *MOTOR_PARAMETERS,
    *LIMIT_PARAMETERS,
    *REAL_TIME_PARAMETERS,
)
COMPENSATOR = (
    Param("side", "right", "which arm: its base is mirrored", choices=SIDES, fixed=True),
    JOINT_NAMES,
    Param("link_length", [0.05, 0.13, 0.30, 0.30], "l_n, link lengths in m", (0.0, MAX_LENGTH), fixed=True),
    Param("law", "exact", "how gravity's torque is computed", choices=LAW_NAMES),
    Param("anfis_file", "", "model for the law anfis, written by train_anfis"),
    Param("mode", "one_g", "one_g carries the robot, zero_g the wearer's arm too", choices=MODES),
    Param("support", 1.0, "share of the wearer's arm that zero_g carries", (0.0, 1.0)),
    Param("gain", [1.0, 1.0, 1.0, 1.0], "c_n, scales the torque of joint n", (0.0, MAX_GAIN)),
    Param("gravity", STANDARD_GRAVITY, "g, acceleration of gravity in m/s^2", (0.0, MAX_GRAVITY)),
    Param("robot.mass", [0.585, 0.468, 0.598, 0.203], "m_n, link masses in kg", (0.0, MAX_MASS)),
    Param("robot.cog", [0.046, 0.113, 0.237, 0.128], "d_n, centre of gravity from joint n in m", (0.0, MAX_LENGTH)),
    Param("wearer.mass", [0.0, 0.0, 0.0, 0.0], "the wearer's mass on each link in kg", (0.0, MAX_MASS)),
    Param("wearer.cog", [0.0, 0.0, 0.0, 0.0], "its centre of gravity from joint n in m", (0.0, MAX_LENGTH)),
    Param("wearer.body_mass", 0.0, "body mass in kg; fills wearer.mass and cog where they are 0", (0.0, 300.0)),
    Param("wearer.sex", "male", "for the table of segment masses", choices=SEX),
    Param("wearer.table", "de_leva", "table of segment masses and centres of gravity", choices=tuple(TABLES)),
    Param("wearer.segment_length", list(TYPICAL_LENGTH), "upper arm, forearm, hand in m", (0.0, 0.6)),
    Param("max_total_mass", 10.0, "most that may be carried in all, in kg", (0.5, MAX_TOTAL_MASS), fixed=True),
    Param("max_effort", [3.0, 9.0, 3.0, 3.0], "largest torque per joint in Nm", (0.0, MOST_EFFORT)),
    Param("max_effort_rate", 50.0, "fastest change of torque in Nm/s", (1.0, 1000.0)),
    Param("transition_time", 1.0, "time in s over which a change of mass, mode or law reaches the arm", (0.2, 30.0)),
    Param("use_imu", True, "false: the trunk counts as upright (the paper's seated wearer)", fixed=True),
    Param("tilt_timeout", 0.08, "age of the trunk tilt in s after which the arm is let down", (0.01, 0.5)),
    *REAL_TIME_PARAMETERS,
)
# fmt: on


def motors_of(values: Mapping[str, Any]) -> tuple[JointMotor, ...]:
    """Return the four motors that parameter values describe, or raise ParameterError."""
    ids = values["can_id"]
    if len(set(ids)) != len(ids):
        raise ParameterError("can_id", ids, "4 different IDs")
    columns = ("motor", "can_id", "direction", "zero", "torque_scale", "velocity_range", "torque_range")
    return tuple(
        JointMotor(MOTORS[motor].with_ranges(velocity_range, torque_range), can_id, direction, zero, scale)
        for motor, can_id, direction, zero, scale, velocity_range, torque_range in zip(
            *(values[column] for column in columns), strict=True
        )
    )


def limits_of(values: Mapping[str, Any]) -> Limits:
    """Return the limits that `can_bridge`'s parameter values describe, or raise ParameterError."""
    return Limits(tuple(values["joint_names"]), **{param.name: values[param.name] for param in LIMIT_PARAMETERS})


def settings_of(values: Mapping[str, Any], anfis: AnfisLaw | None = None) -> Settings:
    """Return the settings that `compensator`'s parameter values describe, or raise ParameterError.

    anfis: the model in `anfis_file`, if one is named.
    """
    try:
        robot = ArmModel(
            values["link_length"], values["robot.cog"], values["robot.mass"], values["gain"], values["gravity"]
        )
    except ParameterError as error:
        if error.name in ("mass", "cog"):
            raise ParameterError(f"robot.{error.name}", error.value, error.expected) from None
        raise
    mass, cog = wearer_of(values)
    same = ("law", "mode", "support", "max_total_mass", "max_effort", "max_effort_rate", "transition_time")
    return Settings(
        side=values["side"],
        robot=robot,
        wearer_mass=mass,
        wearer_cog=cog,
        tilt_timeout=values["tilt_timeout"] if values["use_imu"] else 0.0,
        anfis=anfis,
        **{name: values[name] for name in same},
    )


def wearer_of(values: Mapping[str, Any]) -> tuple[Sequence[float], Sequence[float]]:
    """Return mass and centre of gravity (4,) of the wearer on each link; explicit ones win over the table's."""
    if any(values["wearer.mass"]) or not values["wearer.body_mass"]:
        return values["wearer.mass"], values["wearer.cog"]
    person = {name: values[f"wearer.{name}"] for name in ("body_mass", "sex", "table", "segment_length")}
    try:
        return Wearer(**person).on_links(values["link_length"])
    except ParameterError as error:
        raise ParameterError(f"wearer.{error.name}", error.value, error.expected) from None
