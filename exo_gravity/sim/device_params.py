"""The parameters of `simulator`, and the device that their values describe."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from exo_gravity.core.arm import MAX_LENGTH, MAX_MASS, STANDARD_GRAVITY, ArmModel
from exo_gravity.core.control_params import MOTOR_PARAMETERS, motors_of
from exo_gravity.core.param_table import Param
from exo_gravity.core.tilt import SIDES
from exo_gravity.sim.arm import ArmConfig, SimulatedArm
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.imu import ImuConfig
from exo_gravity.sim.motor import Firmware, SimulatedMotor

ARM = ArmConfig()

# fmt: off
SIMULATOR = (
    Param("side", "right", "which arm: its base is mirrored", choices=SIDES, fixed=True),
    *MOTOR_PARAMETERS,
    Param("reply_to_master", False, "replies carry ID 0 instead of the motor's own", fixed=True),
    Param("reply_length", 8, "bytes of a reply, 6 or 8", (6, 8), fixed=True),
    Param("gravity", STANDARD_GRAVITY, "m/s^2", (0.0, 25.0), fixed=True),
    Param("link_length", ARM.links.length.tolist(), "link lengths in m", (0.0, MAX_LENGTH), fixed=True),
    Param("robot.mass", ARM.links.mass.tolist(), "true link masses in kg", (0.0, MAX_MASS), fixed=True),
    Param("robot.cog", ARM.links.cog.tolist(), "true centres of gravity in m", (0.0, MAX_LENGTH), fixed=True),
    Param("wearer.mass", [0.0, 0.0, 0.0, 0.0], "passive wearer's mass on each link in kg", (0.0, MAX_MASS), fixed=True),
    Param("wearer.cog", [0.0, 0.0, 0.0, 0.0], "its centre of gravity in m", (0.0, MAX_LENGTH), fixed=True),
    Param("rotor_inertia", ARM.rotor_inertia.tolist(), "at the output in kg m^2", (0.0, 1.0), fixed=True),
    Param("friction.coulomb", ARM.coulomb_friction.tolist(), "Nm", (0.0, 10.0), fixed=True),
    Param("friction.viscous", ARM.viscous_friction.tolist(), "Nm s/rad", (0.0, 10.0), fixed=True),
    Param("stop.min", ARM.position_min.tolist(), "lower joint stops in rad", (-math.pi, math.pi), fixed=True),
    Param("stop.max", ARM.position_max.tolist(), "upper joint stops in rad", (-math.pi, math.pi), fixed=True),
    Param("imu.topic", "", "where the trunk's IMU is published; empty: this simulator has none", fixed=True),
    Param("imu.rate", 100.0, "IMU samples per second", (10.0, 1000.0), fixed=True),
    Param("imu.rotation_trunk_from_imu", [0.0, 0.0, 0.0, 1.0], "quaternion x, y, z, w", (-1.0, 1.0), fixed=True),
    Param("trunk.pitch", 0.0, "bow of the trunk in rad; it gets there at 0.5 rad/s", (-1.5, 1.5)),
    Param("trunk.roll", 0.0, "lean of the trunk to the right in rad", (-1.5, 1.5)),
    Param("trial", "", "protocol file for the virtual wearer; set later, he begins at once"),
    Param("trial_delay", 6.0, "s from the motors being on to the wearer's first step", (0.0, 60.0), fixed=True),
    Param("fault.unplugged", [False, False, False, False], "motors without power"),
    Param("fault.temperature", [30.0, 30.0, 30.0, 30.0], "motor temperatures in degC", (-40.0, 215.0)),
    Param("fault.error", [0, 0, 0, 0], "motor error codes", (0, 255)),
    Param("fault.bus_silent", False, "no frame passes in either direction"),
)
# fmt: on


def device_of(values: Mapping[str, Any]) -> SimulatedDevice:
    """Return the device that parameter values describe, its trunk tilted, or raise ParameterError."""
    arm = ArmConfig(
        links=ArmModel(values["link_length"], values["robot.cog"], values["robot.mass"], gravity=values["gravity"]),
        wearer_mass=values["wearer.mass"],
        wearer_cog=values["wearer.cog"],
        rotor_inertia=values["rotor_inertia"],
        coulomb_friction=values["friction.coulomb"],
        viscous_friction=values["friction.viscous"],
        position_min=values["stop.min"],
        position_max=values["stop.max"],
    )
    firmware = Firmware(values["reply_to_master"], values["reply_length"])
    motors = [SimulatedMotor(motor, firmware) for motor in motors_of(values)]
    device = SimulatedDevice(SimulatedArm(arm), motors, values["side"])
    device.pitch, device.roll = values["trunk.pitch"], values["trunk.roll"]
    return device


def set_faults(device: SimulatedDevice, values: Mapping[str, Any]) -> None:
    """Let `device` have the faults that parameter values describe."""
    device.bus_silent = values["fault.bus_silent"]
    faults = (values["fault.unplugged"], values["fault.temperature"], values["fault.error"])
    for motor, *fault in zip(device.motors, *faults, strict=True):
        motor.unplugged, motor.temperature, motor.error = fault


def imu_of(values: Mapping[str, Any]) -> ImuConfig:
    """Return the trunk's IMU that parameter values describe, or raise ParameterError."""
    return ImuConfig(values["imu.rotation_trunk_from_imu"], values["imu.rate"], gravity=values["gravity"])
