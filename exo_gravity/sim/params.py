# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The parameters of `simulator`, and the device that they describe."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from exo_gravity.core.arm.interface import MAX_GRAVITY, MAX_MASS, STANDARD_GRAVITY
from exo_gravity.core.arm.paper import MAX_LENGTH, ArmModel
from exo_gravity.core.arm.tilt import SIDES
from exo_gravity.core.compensation.settings import URDF_FILE, URDF_HAND
from exo_gravity.core.motors.joint_motor import MAX_STATUS_RATE, MOTOR_PARAMETERS, JointMotor, motors_of
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.params import Param, param_of, params_of, table_for
from exo_gravity.hardware.urdf_arm import read_urdf
from exo_gravity.sim.arm import DEFAULT_LINKS, ArmConfig, JointConfig, SimulatedArm
from exo_gravity.sim.device import SimulatedDevice, TruthRecords
from exo_gravity.sim.motors import class_of, simulated
from exo_gravity.sim.motors.ak import FIRMWARES, Firmware, Heat
from exo_gravity.sim.trunk_motion import ImuConfig
from exo_gravity.sim.urdf import UrdfConfig

# Parameters of the arm by the field of ArmConfig that owns each of them.
ARM_FIELDS = {
    "cog_y": "robot.cog_y",
    "cog_z": "robot.cog_z",
    "wearer_mass": "wearer.mass",
    "wearer_cog": "wearer.cog",
    "wearer_cog_y": "wearer.cog_y",
    "wearer_cog_z": "wearer.cog_z",
    "wearer_stiffness": "wearer.joint_stiffness",
    "wearer_rest": "wearer.joint_rest",
    "coulomb_friction": "friction.coulomb",
    "viscous_friction": "friction.viscous",
    "stribeck_friction": "friction.stribeck",
    "stribeck_speed": "friction.stribeck_speed",
    "load_friction": "friction.load",
    "spring_stiffness": "joint_spring.stiffness",
    "spring_rest": "joint_spring.rest",
    "joint_stiffness": "joint_stiffness",
    "backlash": "backlash",
    "position_min": "stop.min",
    "position_max": "stop.max",
}
ROTOR_INERTIA = replace(
    param_of(ArmConfig, "rotor_inertia", fixed=True),
    default=[0.0] * JOINT_COUNT,
    description="rotor inertia at the gear's output; 0: that of the motor",
)
USUAL = "usual"  # the firmware that a motor's wire format suggests
OF_VARIANT = -1.0  # the time-out of the variant
FIRMWARE = (
    Param(
        "firmware.variant",
        [USUAL] * JOINT_COUNT,
        "what the boards' firmware does (sim/motors/ak.py); usual: ak, v3, or that of the motor's family",
        choices=(USUAL, *FIRMWARES),
        fixed=True,
    ),
    Param(
        "firmware.timeout",
        OF_VARIANT,
        "CAN time-out of the motors; 0: none, -1: that of the variant",
        (-1.0, 60.0),
        "s",
        fixed=True,
    ),
    Param(
        "firmware.status_rate",
        0.0,
        "status frames of a V3 board; 0: as the variant sends",
        (0.0, MAX_STATUS_RATE),
        "1/s",
        fixed=True,
    ),
    param_of(Firmware, "reply_to_master", fixed=True),
    Param("reply_length", 0, "bytes of a reply, 6 to 8; 0: as the variant sends", (0, 8), fixed=True),
    param_of(Firmware, "current_noise", fixed=True),
    *(replace(param, name=f"heat.{param.name}") for param in params_of(Heat, fixed=True)),
)


def until_carried(count: int) -> float:
    """Return the s that a start takes from the motors being on, at most, with the pushes of `count` joints."""
    return 4.0 + 1.8 * count  # measured: 4.2 with one joint, 7.4 with three, 9.2 with four, 15.0 with seven


IMU_FIELDS = ("rate", "rotation_trunk_from_imu", "delay")
_LENGTH, _MASS, _COG = (a.tolist() for a in (DEFAULT_LINKS.length, DEFAULT_LINKS.mass, DEFAULT_LINKS.cog))
SIMULATOR = (
    Param("side", "right", "which arm; the right arm mirrors the left", choices=SIDES, fixed=True),
    *MOTOR_PARAMETERS,
    *FIRMWARE,
    Param("gravity", STANDARD_GRAVITY, "acceleration of gravity", (0.0, MAX_GRAVITY), "m/s^2", fixed=True),
    Param("link_length", _LENGTH, "true link lengths", (0.0, MAX_LENGTH), "m", fixed=True),
    Param("robot.mass", _MASS, "true link masses", (0.0, MAX_MASS), "kg", fixed=True),
    Param("robot.cog", _COG, "true centre of gravity from joint n", (0.0, MAX_LENGTH), "m", fixed=True),
    *(replace(param_of(ArmConfig, field, fixed=True), name=name) for field, name in ARM_FIELDS.items()),
    ROTOR_INERTIA,
    Param("imu.topic", "", "topic of the trunk's IMU; empty: this simulator has no IMU", fixed=True),
    *(replace(param_of(ImuConfig, field, fixed=True), name=f"imu.{field}") for field in IMU_FIELDS),
    Param("trunk.pitch", 0.0, "forward tilt of the trunk, approached at 0.5 rad/s", (-3.1, 3.1), "rad"),
    Param("trunk.roll", 0.0, "tilt of the trunk to the right, approached at 0.5 rad/s", (-3.1, 3.1), "rad"),
    Param("trial", "", "script of the virtual wearer; empty ends it"),
    Param(
        "trial_delay",
        until_carried(JOINT_COUNT),
        "time from the motors being on to the wearer's first step",
        (0.0, 60.0),
        "s",
        fixed=True,
    ),
    Param("truth", "", "file for the arm's true motion at 1 kHz (exo_gravity/sim/device.py); empty: none", fixed=True),
    Param("fault.unplugged", [False] * JOINT_COUNT, "motors without power"),
    Param("fault.unplugged_time", 0.0, "time until their power returns, motors off; 0: never", (0.0, 60.0), "s"),
    Param("fault.cable", [False] * JOINT_COUNT, "V3 boards with their cable plugged in, which ignore commands"),
    Param("fault.strength", [1.0] * JOINT_COUNT, "share of its torque that a motor gives, unreported", (0.1, 1.0)),
    Param("fault.cut_off", [False] * JOINT_COUNT, "motors with power, but without connection to the bus"),
    Param("fault.mute", [False] * JOINT_COUNT, "motors that obey, but whose replies are lost"),
    Param("fault.encoder_error", [0.0] * JOINT_COUNT, "error of the angles that the motors read", (-7.0, 7.0), "rad"),
    Param("fault.temperature", [30.0] * JOINT_COUNT, "motor temperatures", (-40.0, 215.0), "degC"),
    Param("fault.error", [0] * JOINT_COUNT, "motor error codes", (0, 255)),
    Param("fault.bus_silent", False, "the bus passes no frames"),
)
# What an arm from a URDF has in place of PAPER.
URDF = (
    replace(URDF_FILE, description="path of the URDF of another arm than the paper's", required=True),
    URDF_HAND,
    Param("joint_names", [""], "joints in the order of the URDF's chain", fixed=True, required=True, any_length=True),
    Param("home", [0.0] * JOINT_COUNT, "angles in which the arm begins", (-math.pi, math.pi), "rad", fixed=True),
)
PAPER = {"link_length", "robot.mass", "robot.cog", "robot.cog_y", "robot.cog_z", "wearer.cog_y", "wearer.cog_z"}
STOPS = {"stop.min", "stop.max"}


def simulator_table(given: Mapping[str, Any]) -> tuple[Param, ...]:
    """Return the parameters of `simulator` for a file with the parameters `given`."""
    if URDF_FILE.name not in given:
        return tuple(table_for(SIMULATOR, given))
    of_stops = {"default": [0.0] * JOINT_COUNT, "description": "joint stops; zeros: the URDF's limits"}
    of_urdf: dict[str, dict[str, Any]] = dict.fromkeys(STOPS, of_stops)
    of_urdf["trial_delay"] = {"default": until_carried(len(given.get("joint_names", [])))}
    shared = [replace(param, **of_urdf.get(param.name, {})) for param in SIMULATOR if param.name not in PAPER]
    return tuple(table_for((*shared, *URDF), given))


def device_of(values: Mapping[str, Any]) -> SimulatedDevice:
    """Return the device that parameter values describe, with its trunk tilted. Raises ParameterError."""
    joints = motors_of(values)
    given = zip(values[ROTOR_INERTIA.name], joints, strict=True)
    rotors = [inertia or joint.spec.rotor_inertia for inertia, joint in given]
    arm = SimulatedArm(_arm_of(values, rotors))
    heat = Heat(**{param.name: values[f"heat.{param.name}"] for param in params_of(Heat)})
    variants = zip(joints, values["firmware.variant"], strict=True)
    motors = [simulated(joint, firmware_of(joint, variant, values), heat) for joint, variant in variants]
    device = SimulatedDevice(arm, motors, values["side"])
    device.pitch, device.roll = values["trunk.pitch"], values["trunk.roll"]
    if "home" in values:
        arm.reset(values["home"])
    if values["truth"]:
        device.truth = TruthRecords(values["truth"])
    return device


def _arm_of(values: Mapping[str, Any], rotors: Sequence[float]) -> JointConfig:
    """Return the paper's arm, or that of the URDF. rotors: inertia (n,) in kg m^2. Raises ParameterError."""
    given = {field: values[name] for field, name in ARM_FIELDS.items() if name in values}
    if URDF_FILE.name not in values:
        links = ArmModel(values["link_length"], values["robot.cog"], values["robot.mass"], gravity=values["gravity"])
        return ArmConfig(links, rotor_inertia=rotors, **given)
    if not any((*values["stop.min"], *values["stop.max"])):
        del given["position_min"], given["position_max"]
    return UrdfConfig(
        text=read_urdf(values[URDF_FILE.name]),
        joint_names=values["joint_names"],
        hand=values[URDF_HAND.name],
        gravity=values["gravity"],
        rotor_inertia=rotors,
        **given,
    )


def firmware_of(joint: JointMotor, variant: str, values: Mapping[str, Any]) -> Firmware:
    """Return the firmware of a motor: that of a variant, as parameter values change it. Raises ParameterError."""
    firmware = class_of(joint.spec.family).usual_firmware(joint) if variant == USUAL else FIRMWARES[variant]
    timeout = values["firmware.timeout"]
    return replace(
        firmware,
        reply_to_master=values["reply_to_master"] or firmware.reply_to_master,
        reply_length=values["reply_length"] or firmware.reply_length,
        current_noise=values["current_noise"],
        status_rate=values["firmware.status_rate"] or firmware.status_rate,
        timeout=firmware.timeout if timeout < 0.0 else timeout,
    )


def set_faults(device: SimulatedDevice, values: Mapping[str, Any], changed: Collection[str] | None = None) -> None:
    """Set the faults of `device` that parameter values describe.

    changed: the parameters that have changed; by default all. A motor's power is cut only by a change that asks for it.
    """
    device.bus_silent = values["fault.bus_silent"]
    device.cut_off, device.encoder_error = values["fault.cut_off"], values["fault.encoder_error"]
    device.mute = values["fault.mute"]
    if changed is None or "fault.unplugged" in changed:
        for joint, unplugged in enumerate(values["fault.unplugged"]):
            if unplugged:
                device.unplug(joint, values["fault.unplugged_time"] or math.inf)
            else:
                device.motors[joint].unplugged = False
    if changed is None or "fault.temperature" in changed:
        for motor, temperature in zip(device.motors, values["fault.temperature"], strict=True):
            motor.ambient = motor.temperature = temperature
    faults = (values["fault.error"], values["fault.cable"], values["fault.strength"])
    for motor, error, cable, strength in zip(device.motors, *faults, strict=True):
        motor.error, motor.cable, motor.strength = error, cable, strength


def imu_of(values: Mapping[str, Any]) -> ImuConfig:
    """Return the trunk's IMU that parameter values describe. Raises ParameterError."""
    return ImuConfig(**{field: values[f"imu.{field}"] for field in IMU_FIELDS}, gravity=values["gravity"])
