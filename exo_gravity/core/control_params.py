"""The parameters of each node but `simulator` and `calibrator`, and the objects built from their values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from exo_gravity.core.compensation.command_fade import COMMAND_PARAMETERS
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.settings import term_parameters, term_settings_of
from exo_gravity.core.compensation.terms.spring import PosePath
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.anfis_law import AnfisLaw
from exo_gravity.core.model.arm import (
    MAX_GAIN,
    MAX_GRAVITY,
    MAX_LENGTH,
    MAX_MASS,
    MAX_MOMENT,
    STANDARD_GRAVITY,
    ArmModel,
)
from exo_gravity.core.model.tilt import SIDES
from exo_gravity.core.model.wearer import SEX, TABLES, TYPICAL_LENGTH, Wearer
from exo_gravity.core.motors.bus_load import BITRATE, MAX_STATUS_RATE, Traffic
from exo_gravity.core.motors.joint_motor import MAX_CAN_ID, TORQUE_SCALE_BOUNDS, JointMotor
from exo_gravity.core.motors.specs import MOTORS, WIRE_RANGE_BOUNDS, MotorSpec
from exo_gravity.core.motors.wire_formats import FORMATS
from exo_gravity.core.params import Param, param_of, params_of
from exo_gravity.core.safety.limits import Limits

GYROSCOPE_RANGE, GYROSCOPE_RANGES = 34.9, (1.0, 200.0)  # rad/s; 2000 deg/s
ACCELEROMETER_RANGE, ACCELEROMETER_RANGES = 156.9, (15.0, 4000.0)  # m/s^2; 16 g
OPTIONS = "can.options"  # parameters below this prefix go to python-can unchanged
# python-can's interfaces that open a bus at another bit rate than the motors' unless they are given one.
NEED_BITRATE = ("cantact", "gs_usb", "ixxat", "kvaser", "pcan", "slcan", "usb2can", "vector")

JOINT_NAMES = Param(
    "joint_names",
    ["right_shoulder_rotation", "right_shoulder_abduction", "right_shoulder_flexion", "right_elbow_flexion"],
    "the four joints from the shoulder to the elbow, as in joint_states",
    fixed=True,
)
# fmt: off
REAL_TIME_PARAMETERS = (
    Param("thread_priority", 0, "SCHED_FIFO priority of the control loop's threads; 0 for none", (0, 99), fixed=True),
    Param("lock_memory", False, "lock the process's memory (mlockall) if permitted", fixed=True),
)
# `can_bridge` assumes these properties of its motors; `simulator` builds motors that have them.
MOTOR_PARAMETERS = (
    Param("can.interface", "", "python-can interface, e.g. socketcan, udp_multicast", fixed=True, required=True),
    Param("can.channel", "", "python-can channel, e.g. can0", fixed=True, required=True),
    Param("motor", ["AK60-6", "AK80-9", "AK60-6", "AK60-6"], "motor types", choices=tuple(MOTORS), fixed=True),
    Param("can_id", [1, 2, 3, 4], "CAN IDs", (1, MAX_CAN_ID), fixed=True),
    Param("direction", [1, 1, 1, 1], "1 or -1: joint angle = direction * (motor angle - zero)", (-1, 1), fixed=True),
    Param("zero", [0.0] * 4, "motor angle at which the joint angle is 0", (-12.5, 12.5), "rad", fixed=True),
    Param("torque_scale", [1.0] * 4, "real output torque per commanded Nm", TORQUE_SCALE_BOUNDS, fixed=True),
    Param("wire_format", ["mit"] * 4, "wire format of the motor's board: mit for V1 and V2, mit_v3 for V3",
          choices=tuple(FORMATS), fixed=True),
    Param("velocity_range", [0.0] * 4, "velocity range of the firmware's wire format; 0: the usual one of the motor",
          (0.0, WIRE_RANGE_BOUNDS[1]), "rad/s", fixed=True),
    Param("torque_range", [0.0] * 4, "torque range of the firmware's wire format; 0: the usual one of the motor",
          (0.0, WIRE_RANGE_BOUNDS[1]), "Nm", fixed=True),
    Param("torque_per_ampere", [0.0] * 4, "V3: output torque by the current in status frames; 0: rated torque by "
          "rated current", (0.0, 10.0), "Nm/A", fixed=True),
    Param("status_rate", MAX_STATUS_RATE, "V3: status frames a second, as set on the boards", (1.0, MAX_STATUS_RATE),
          "Hz", fixed=True),
)
LIMIT_PARAMETERS = params_of(Limits, fixed=True)
CAN_BRIDGE = (
    JOINT_NAMES,
    Param("autostart", True, "configure and activate at start without an operator", fixed=True),
    Param("rate", 250.0, "control cycles per second, as far as the CAN bus allows", (20.0, 2000.0), "Hz",
          fixed=True),
    *MOTOR_PARAMETERS,
    *LIMIT_PARAMETERS,
    *REAL_TIME_PARAMETERS,
)
COMPENSATOR = (
    Param("side", "right", "side of the arm; the right arm mirrors the left", choices=SIDES, fixed=True),
    JOINT_NAMES,
    Param("link_length", [0.05, 0.13, 0.30, 0.30], "l_n, link lengths", (0.0, MAX_LENGTH), "m", fixed=True),
    param_of(Settings, "law"),
    Param("anfis_file", "", "model for the law anfis, written by train_anfis"),
    param_of(Settings, "mode"),
    param_of(Settings, "support"),
    Param("gain", [1.0, 1.0, 1.0, 1.0], "c_n, scales the torque of joint n", (0.0, MAX_GAIN)),
    Param("gravity", STANDARD_GRAVITY, "g, acceleration of gravity", (0.0, MAX_GRAVITY), "m/s^2"),
    Param("robot.mass", [0.585, 0.468, 0.598, 0.203], "m_n, link masses", (0.0, MAX_MASS), "kg"),
    Param("robot.cog", [0.046, 0.113, 0.237, 0.128], "d_n, centre of gravity from joint n", (0.0, MAX_LENGTH), "m"),
    Param("robot.first_moment", [0.0] * 4, "M1 to M4 by `calibrate`, in place of mass and cog; zeros: not given",
          (0.0, MAX_MOMENT), "kg m"),
    Param("robot.off_axis", [0.0] * 4, "W, Z, Y3, Y4 by `calibrate`: moments across the links, for the law exact",
          (-MAX_MOMENT, MAX_MOMENT), "kg m"),
    Param("wearer.mass", [0.0, 0.0, 0.0, 0.0], "mass of the wearer's arm on each link", (0.0, MAX_MASS), "kg"),
    Param("wearer.cog", [0.0, 0.0, 0.0, 0.0], "centre of gravity of that mass from joint n", (0.0, MAX_LENGTH), "m"),
    Param("wearer.body_mass", 0.0, "body mass; computes wearer.mass and wearer.cog if these are 0", (0.0, 300.0), "kg"),
    Param("wearer.sex", "male", "selects the column of the segment table", choices=SEX),
    Param("wearer.table", "de_leva", "table of segment masses and centres of gravity", choices=tuple(TABLES)),
    Param("wearer.segment_length", list(TYPICAL_LENGTH), "upper arm, forearm, hand", (0.0, 0.6), "m"),
    param_of(Settings, "max_total_mass", fixed=True),
    param_of(Settings, "max_effort"),
    param_of(Settings, "max_effort_rate"),
    param_of(Settings, "transition_time"),
    param_of(Settings, "inertial"),
    Param("shoulder_from_imu", [0.0] * 3, "the arm's base from the IMU along the trunk's axes, for inertial",
          (-1.0, 1.0), "m"),
    Param("use_imu", True, "false assumes an upright trunk (the paper's seated wearer)", fixed=True),
    param_of(Settings, "tilt_timeout"),
    *COMMAND_PARAMETERS,
    *term_parameters(),
    Param("spring.path_file", "", "CSV file with the path of the spring, rows of s and 4 angles in rad; empty: pose"),
    *REAL_TIME_PARAMETERS,
)
IMU_SOURCES = ("topic", "mpu6050", "icm20948", "lsm6dsox", "witmotion", "bno085")
IMU = (
    Param("source", "topic", "the IMU: a driver's topic, a chip on I2C, or a sensor on a serial port", fixed=True,
          choices=IMU_SOURCES),
    Param("input_topic", "/imu/data_raw", "topic of the IMU driver's sensor_msgs/Imu", fixed=True),
    Param("i2c.bus", 1, "number n of the bus /dev/i2c-n", (0, 255), fixed=True),
    Param("i2c.address", 0, "address of the chip; 0: the usual one of its boards", (0, 0x77), fixed=True),
    Param("serial.port", "", "the sensor's port, best a name in /dev/serial/by-id", fixed=True),
    Param("serial.baud", 115200, "the sensor's baud rate", (4800, 921600), fixed=True),
    # No rotation would be a safe default. Four zeros are not a rotation, so the node rejects them.
    Param("rotation_trunk_from_imu", [0.0] * 4, "mounting of the IMU, unit quaternion x, y, z, w; required",
          (-1.0, 1.0), fixed=True),
    Param("rate", 100.0, "sample rate of the IMU, within 15 %", (20.0, 2000.0), "Hz", fixed=True),
    Param("gyroscope_range", GYROSCOPE_RANGE, "rate at which the gyroscope saturates", GYROSCOPE_RANGES, "rad/s",
          fixed=True),
    Param("accelerometer_range", ACCELEROMETER_RANGE, "acceleration at which the accelerometer saturates",
          ACCELEROMETER_RANGES, "m/s^2", fixed=True),
    Param("timeout", 0.1, "time without IMU data that counts as an error", (0.02, 1.0), "s", fixed=True),
)
RECORDER = (
    Param("output", "", "new folder for the recording", fixed=True, required=True),
    Param("live", False, "print the latest state as one line of JSON, ten times a second", fixed=True),
)
ROBOT_MODEL = (
    Param("rate", 30.0, "joint states of all arms per second", (1.0, 100.0), "Hz", fixed=True),
    Param("meshes", "", "address of a folder with LINK.stl for each link, as package://NAME/FOLDER; empty: tubes",
          fixed=True),
)
# fmt: on


def motors_of(values: Mapping[str, Any]) -> tuple[JointMotor, ...]:
    """Return the four motors that parameter values describe, or raise ParameterError."""
    ids = values["can_id"]
    if len(set(ids)) != len(ids):
        raise ParameterError("can_id", ids, "4 different IDs")
    columns = ("motor", "wire_format", "velocity_range", "torque_range", "torque_per_ampere")
    specs = [_spec_of(*column) for column in zip(*(values[name] for name in columns), strict=True)]
    return tuple(
        JointMotor(spec, can_id, direction, zero, scale, FORMATS[wire_format])
        for spec, can_id, direction, zero, scale, wire_format in zip(
            specs, ids, *(values[name] for name in ("direction", "zero", "torque_scale", "wire_format")), strict=True
        )
    )


def _spec_of(
    name: str, wire_format: str, velocity_range: float, torque_range: float, torque_per_ampere: float
) -> MotorSpec:
    """Return a motor with the ranges of its firmware, 0 for the usual ones; raises ParameterError.

    A range that is usual on V1 and V2 boards is refused for another: it would scale every torque without an error.
    """
    usual = FORMATS[wire_format].ranged(MOTORS[name])
    for field, given in (("velocity_range", velocity_range), ("torque_range", torque_range)):
        own = getattr(usual, field)
        if given == getattr(MOTORS[name], field) != own:
            raise ParameterError(field, given, f"{own:g} or 0 for an {name} with wire_format = {wire_format}")
    spec = usual.with_ranges(velocity_range or usual.velocity_range, torque_range or usual.torque_range)
    return replace(spec, torque_per_ampere=torque_per_ampere or usual.torque_per_ampere)


def traffic_of(values: Mapping[str, Any], options: Mapping[str, Any]) -> Traffic:
    """Return the traffic on the bus of the four motors; options: those of python-can. Raises ParameterError."""
    interface, bitrate = values["can.interface"], options.get("bitrate")
    if bitrate is None and interface in NEED_BITRATE:
        raise ParameterError(f"{OPTIONS}.bitrate", bitrate, f"set for {interface}, as on the motors, e.g. {BITRATE}")
    replying = sum(FORMATS[name].replies for name in values["wire_format"])
    reporting = len(values["wire_format"]) - replying
    return Traffic(replying, reporting, status_rate=values["status_rate"], bitrate=bitrate or BITRATE)


def limits_of(values: Mapping[str, Any]) -> Limits:
    """Return the limits that `can_bridge`'s parameter values describe, or raise ParameterError."""
    return Limits(tuple(values["joint_names"]), **{param.name: values[param.name] for param in LIMIT_PARAMETERS})


def settings_of(values: Mapping[str, Any], anfis: AnfisLaw | None = None, path: PosePath | None = None) -> Settings:
    """Return the settings that `compensator`'s parameter values describe, or raise ParameterError.

    anfis: the model in `anfis_file`, path: the way in `spring.path_file`; None if no file is given.
    """
    robot = robot_of(values)
    mass, cog = wearer_of(values)
    return Settings(
        side=values["side"],
        robot=robot,
        wearer_mass=mass,
        wearer_cog=cog,
        shoulder_from_imu=tuple(values["shoulder_from_imu"]),
        use_imu=values["use_imu"],
        anfis=anfis,
        terms=term_settings_of(values, path),
        robot_by_mass=ArmModel(values["link_length"], values["robot.cog"], values["robot.mass"]),
        **{param.name: values[param.name] for param in params_of(Settings)},
    )


def robot_of(values: Mapping[str, Any]) -> ArmModel:
    """Return the robot's arm, by its moments if robot.first_moment is given, or raise ParameterError."""
    length, off_axis, rest = values["link_length"], values["robot.off_axis"], (values["gain"], values["gravity"])
    try:
        if any(values["robot.first_moment"]):
            return ArmModel.from_moments(length, values["robot.first_moment"], off_axis, *rest)
        return ArmModel(length, values["robot.cog"], values["robot.mass"], *rest, off_axis)
    except ParameterError as error:
        if error.name in ("mass", "cog", "first_moment", "off_axis"):
            raise ParameterError(f"robot.{error.name}", error.value, error.expected) from None
        raise


def wearer_of(values: Mapping[str, Any]) -> tuple[Sequence[float], Sequence[float]]:
    """Return mass and centre of gravity (4,) of the wearer on each link; explicit values override the table's."""
    if any(values["wearer.mass"]) or not values["wearer.body_mass"]:
        return values["wearer.mass"], values["wearer.cog"]
    person = {name: values[f"wearer.{name}"] for name in ("body_mass", "sex", "table", "segment_length")}
    try:
        load = Wearer(**person).on_links(values["link_length"])
    except ParameterError as error:
        raise ParameterError(f"wearer.{error.name}", error.value, error.expected) from None
    return load.mass.tolist(), load.cog.tolist()
