"""A motor on a joint: joint angle, effort and damping <-> the frames of its wire format."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.specs import MotorReply, MotorSpec, standstill
from exo_gravity.core.motors.wire_formats import MIT, WireFormat
from exo_gravity.core.motors.wire_formats.wire_format import Frame

# In the format `mit` the first byte of a reply is the motor's ID. The first byte of our commands is 0x7f or 0x80,
# because their position is always 0. With IDs below 0x7f a command echoed by the bus cannot look like a reply.
MAX_CAN_ID = 126
TORQUE_SCALE_BOUNDS = (0.2, 2.0)


@dataclass(frozen=True)
class JointMotor:
    """One motor on one joint.

    can_id: 1..MAX_CAN_ID. direction: +1 or -1; joint angle = direction * (motor angle - zero). zero: motor angle in rad
    at which the joint angle is 0. torque_scale: real output torque per commanded Nm (users report 0.75 for one AK80-9).
    wire_format: of the board. Raises ParameterError.
    """

    spec: MotorSpec
    can_id: int
    direction: int = 1
    zero: float = 0.0
    torque_scale: float = 1.0
    wire_format: WireFormat = MIT

    def __post_init__(self) -> None:
        if not isinstance(self.can_id, int) or not 1 <= self.can_id <= MAX_CAN_ID:
            raise ParameterError("can_id", self.can_id, f"a whole number from 1 to {MAX_CAN_ID}")
        if self.direction not in (1, -1):
            raise ParameterError("direction", self.direction, "1 or -1")
        if not abs(self.zero) <= self.spec.position_range - math.pi:
            limit = self.spec.position_range - math.pi
            raise ParameterError("zero", self.zero, f"from {-limit:.2f} to {limit:.2f} rad, or the angle would wrap")
        low, high = TORQUE_SCALE_BOUNDS
        if not low <= self.torque_scale <= high:
            raise ParameterError("torque_scale", self.torque_scale, f"from {low:g} to {high:g}")

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
        return self.wire_format.command_id(self.can_id)

    @property
    def enter(self) -> tuple[Frame, ...]:
        """The frames that switch the motor on, before its next command."""
        return self.wire_format.enter(self.can_id)

    @property
    def exit(self) -> tuple[Frame, ...]:
        """The frames that switch the motor off."""
        return self.wire_format.exit(self.can_id)

    def command(self, effort: float, damping: float) -> bytes:
        """Return the data of a command: a joint `effort` in Nm and `damping` in Nm s/rad, clamped to the wire format.

        Raises ParameterError on NaN or infinity.
        """
        spec = self.spec
        torque = self.direction * effort / self.torque_scale
        kd = min(damping / self.torque_scale, spec.kd_max)
        if kd:  # no code is exactly 0 rad/s: the nearest one would push with kd times its velocity
            torque -= kd * standstill(spec)
        most = spec.torque_range
        if not -most <= torque <= most and math.isfinite(torque):
            torque = math.copysign(most, torque)
        return self.wire_format.pack_command(spec, 0.0, 0.0, 0.0, kd, torque)

    def joint_reply(self, data: bytes | bytearray) -> MotorReply:
        """Return the content of a reply or status frame in the joint's rad, rad/s and Nm. Raises FrameError."""
        reply = self.wire_format.unpack_reply(self.spec, self.can_id, data)
        return MotorReply(
            reply.motor_id,
            self.joint_position(reply.position),
            self.direction * reply.velocity,
            self.joint_effort(reply.torque),
            reply.temperature,
            reply.error,
        )

    def joint_position(self, motor_position: float) -> float:
        """Return the joint angle in rad for a motor angle in rad."""
        return self.direction * (motor_position - self.zero)

    def motor_position(self, joint_position: float) -> float:
        """Return the motor angle in rad for a joint angle in rad."""
        return self.direction * joint_position + self.zero

    def joint_effort(self, motor_torque: float) -> float:
        """Return the joint torque in Nm for a torque in the motor's Nm."""
        return self.direction * motor_torque * self.torque_scale


class Peaks(NamedTuple):
    """The most that the motors of an arm apply at its joints: effort (4,) in Nm, damping (4,) in Nm s/rad."""

    effort: tuple[float, ...]
    damping: tuple[float, ...] = (math.inf,) * 4


def peaks_of(motors: Sequence[JointMotor]) -> Peaks:
    """Return what `motors` apply at most."""
    return Peaks(tuple(motor.peak_effort for motor in motors), tuple(motor.peak_damping for motor in motors))
