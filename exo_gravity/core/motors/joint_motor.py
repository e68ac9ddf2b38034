"""A motor on a joint, its parameters, and what they say about the bus.

A `JointMotor` translates joint angle, effort and damping to the frames of its wire format, and back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.bus_load import BITRATE, Traffic
from exo_gravity.core.motors.specs import MOTORS, WIRE_RANGE_BOUNDS, MotorReply, MotorSpec
from exo_gravity.core.motors.wire_formats import FORMATS, MIT, Frame, WireFormat
from exo_gravity.core.numbers import one_float
from exo_gravity.core.params import Param

# In the format `mit` the first byte of a reply is the motor's ID. The position of our commands is 0, unless they hold a
# joint (`MotorBus`), so their first byte is 0x7f or 0x80: with IDs below 0x7f their echoes cannot look like replies.
MAX_CAN_ID = 126
TORQUE_SCALE_BOUNDS = (0.2, 2.0)
OPTIONS = "can.options"  # parameters below this prefix go to python-can unchanged
# python-can's interfaces that open a bus at another bit rate than the motors' unless they are given one.
NEED_BITRATE = ("cantact", "gs_usb", "ixxat", "kvaser", "pcan", "slcan", "usb2can", "vector")


@dataclass(frozen=True)
class JointMotor:
    """One motor on one joint. Raises ParameterError."""

    spec: MotorSpec
    can_id: int  #: 1 to MAX_CAN_ID
    direction: int = 1  #: 1 or -1: joint angle = direction * (motor angle - zero)
    zero: float = 0.0  #: motor angle in rad at which the joint angle is 0
    torque_scale: float = 1.0  #: real output torque per commanded Nm (users report 0.75 for one AK80-9)
    wire_format: WireFormat = MIT  #: of the motor's board

    def __post_init__(self) -> None:
        if not isinstance(self.can_id, int) or not 1 <= self.can_id <= MAX_CAN_ID:
            raise ParameterError("can_id", self.can_id, f"a whole number from 1 to {MAX_CAN_ID}")
        if self.direction not in (1, -1):
            raise ParameterError("direction", self.direction, "1 or -1")
        limit = self.spec.position_range - math.pi
        if not abs(self.zero) <= limit:
            raise ParameterError("zero", self.zero, f"from {-limit:.2f} to {limit:.2f} rad, or the angle would wrap")
        one_float("torque_scale", self.torque_scale, *TORQUE_SCALE_BOUNDS)

    @property
    def rated_effort(self) -> float:
        """The largest torque in Nm at the joint that the motor bears for any time.

        A motor that gives less than commanded already has its rated current when its rated torque is commanded.
        """
        return self.spec.rated_torque * min(1.0, self.torque_scale)

    @property
    def peak_effort(self) -> float:
        """The largest torque in Nm at the joint, for seconds."""
        return min(self.spec.peak_torque, self.spec.torque_range) * self.torque_scale

    @property
    def peak_damping(self) -> float:
        """The largest damping in Nm s/rad at the joint that a command can ask for."""
        return self.spec.kd_max * self.torque_scale

    @property
    def command_id(self) -> int:
        """The arbitration ID of commands to this motor."""
        return self.wire_format.first_id + self.can_id

    @property
    def enter(self) -> tuple[Frame, ...]:
        """The frames that switch the motor on, before its next command."""
        return self._own(self.wire_format.on)

    @property
    def exit(self) -> tuple[Frame, ...]:
        """The frames that switch the motor off."""
        return self._own(self.wire_format.off)

    @property
    def set_zero(self) -> tuple[Frame, ...]:
        """The frames that make the motor's present angle zero; none if its board has no such frame."""
        return self._own(self.wire_format.zero)

    def _own(self, frames: Sequence[Frame]) -> tuple[Frame, ...]:
        return tuple((first + self.can_id, data) for first, data in frames)

    def command(self, effort: float, damping: float, stiffness: float = 0.0, position: float = 0.0) -> bytes:
        """Return the data of a command: a joint `effort` in Nm and `damping` in Nm s/rad, clamped to the wire format.

        With a `stiffness` in Nm/rad, the motor also pulls the joint to `position` in rad.

        Raises ParameterError on NaN or infinity.
        """
        spec = self.spec
        torque = self.direction * effort / self.torque_scale
        kd = min(damping / self.torque_scale, spec.kd_max)
        if kd:  # no code is exactly 0 rad/s: the nearest one would push with kd times its velocity
            torque -= kd * spec.standstill
        most = spec.torque_range
        if not -most <= torque <= most and math.isfinite(torque):
            torque = math.copysign(most, torque)
        kp = stiffness / self.torque_scale
        return self.wire_format.pack_command(spec, self.motor_position(position) if kp else 0.0, 0.0, kp, kd, torque)

    def joint_reply(self, data: bytes | bytearray) -> MotorReply:
        """Return the content of a reply or status frame in the joint's rad, rad/s and Nm. Raises FrameError."""
        reply = self.wire_format.unpack_reply(self.spec, self.can_id, data)
        sign, torque = self.direction, self.direction * reply.torque * self.torque_scale
        return MotorReply(
            reply.motor_id, sign * (reply.position - self.zero), sign * reply.velocity, torque, *reply[4:]
        )

    def motor_position(self, joint_position: float) -> float:
        """Return the motor angle in rad for a joint angle in rad."""
        return self.direction * joint_position + self.zero


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
)
# fmt: on
_OF_A_MOTOR = tuple(param.name for param in MOTOR_PARAMETERS if isinstance(param.default, list))


def motors_of(values: Mapping[str, Any]) -> tuple[JointMotor, ...]:
    """Return the four motors that parameter values describe, or raise ParameterError."""
    ids = values["can_id"]
    if len(set(ids)) != len(ids):
        raise ParameterError("can_id", ids, "4 different IDs")
    return tuple(_motor_of({name: values[name][joint] for name in _OF_A_MOTOR}) for joint in range(len(ids)))


def _motor_of(given: Mapping[str, Any]) -> JointMotor:
    """Return one motor with the ranges of its firmware, 0 for the usual ones; raises ParameterError.

    A range that is usual on V1 and V2 boards is refused for another: it would scale every torque without an error.
    """
    plain, board = MOTORS[given["motor"]], FORMATS[given["wire_format"]]
    usual = board.ranged(plain)
    for name in ("velocity_range", "torque_range"):
        own = getattr(usual, name)
        if given[name] == getattr(plain, name) != own:
            raise ParameterError(name, given[name], f"{own:g} or 0 for an {plain.name} with wire_format = {board.name}")
    spec = replace(usual, **{name: given[name] for name in ("velocity_range", "torque_range") if given[name]})
    return JointMotor(spec, given["can_id"], given["direction"], given["zero"], given["torque_scale"], board)


def traffic_of(values: Mapping[str, Any], options: Mapping[str, Any]) -> Traffic:
    """Return the traffic on the bus of the four motors; options: those of python-can. Raises ParameterError."""
    interface, bitrate = values["can.interface"], options.get("bitrate")
    if bitrate is None and interface in NEED_BITRATE:
        raise ParameterError(f"{OPTIONS}.bitrate", bitrate, f"set for {interface}, as on the motors, e.g. {BITRATE}")
    replying = sum(FORMATS[name].replies for name in values["wire_format"])
    return Traffic(replying, len(values["wire_format"]) - replying, bitrate or BITRATE)
