"""The parameters of the motors on a bus, and the motors and the traffic that they describe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.bus_load import BITRATE, MAX_STATUS_RATE, Traffic
from exo_gravity.core.motors.joint_motor import MAX_CAN_ID, TORQUE_SCALE_BOUNDS, JointMotor
from exo_gravity.core.motors.specs import MOTORS, WIRE_RANGE_BOUNDS, MotorSpec
from exo_gravity.core.motors.wire_formats import FORMATS
from exo_gravity.core.params import Param

OPTIONS = "can.options"  # parameters below this prefix go to python-can unchanged
# python-can's interfaces that open a bus at another bit rate than the motors' unless they are given one.
NEED_BITRATE = ("cantact", "gs_usb", "ixxat", "kvaser", "pcan", "slcan", "usb2can", "vector")

# fmt: off
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
