"""MIT mode of V3 boards (CubeMars driver manual V3.0.0): 29-bit IDs, control mode << 8 | motor ID.

Command, control mode 8, 8 bytes, a big-endian bit stream, ranges in `RANGES`:

    kp 12 | kd 12 | position 16 | velocity 12 | torque 12        tau = kp (p - p_motor) + kd (v - v_motor) + torque

A command gets no reply. The board sends a status frame on its own timer, 1 to 500 times a second, ID 0x29 << 8 | motor
ID, big-endian integers:

    position 0.1 deg 16 | speed 10 electrical rpm 16 | current 0.01 A 16 | board temperature degC 8 | error 8

Speed and current are the motor's: pole pairs and gear ratio lead to the output's speed, `torque_per_ampere` to its
torque. No frame switches a motor on: its first command does. The current 0 A (control mode 1) switches it off. A
command without gains and torque comes before it (`MotorBus`), but is not enough: no 12-bit code is exactly 0 Nm.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, replace

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.motors.specs import MotorCommand, MotorReply, MotorSpec, from_code, to_code
from exo_gravity.core.motors.wire_formats.wire_format import COMMAND, EXTENDED, ID_BITS, OTHER, REPLY, Frame

MODE_CURRENT, MODE_MIT, LAST_MODE = 1, 8, 15
STATUS = 0x29
NO_CURRENT = bytes(4)  # int32, mA

POSITION_RANGE = 12.56  # rad
RANGES = {"AK60-6": (60.0, 12.0), "AK80-9": (65.0, 18.0)}  # rad/s, Nm
POSITION_STEP = math.radians(0.1)  # rad
SPEED_STEP = 10.0 * 2.0 * math.pi / 60.0  # electrical rad/s
CURRENT_STEP = 0.01  # A
_STATUS = struct.Struct(">hhhbB")


@dataclass(frozen=True)
class MitV3:
    """The `WireFormat` of V3 boards."""

    name = "mit_v3"
    replies = False
    is_extended = True

    def ranged(self, spec: MotorSpec) -> MotorSpec:
        """Return the motor with the ranges of manual V3.0.0."""
        velocity_range, torque_range = RANGES[spec.name]
        return replace(spec, position_range=POSITION_RANGE, velocity_range=velocity_range, torque_range=torque_range)

    def command_id(self, motor_id: int) -> int:
        """Return the 29-bit ID of commands in MIT mode."""
        return EXTENDED | MODE_MIT << 8 | motor_id

    def status_id(self, motor_id: int) -> int:
        """Return the 29-bit ID of a motor's status frames."""
        return EXTENDED | STATUS << 8 | motor_id

    def pack_command(
        self, spec: MotorSpec, position: float, velocity: float, kp: float, kd: float, torque: float
    ) -> bytes:
        """Return the 8 bytes of a command. Raises ParameterError on NaN, infinity or a value outside the range."""
        word = (
            to_code("kp", kp, 0.0, spec.kp_max, 0xFFF) << 52
            | to_code("kd", kd, 0.0, spec.kd_max, 0xFFF) << 40
            | to_code("position", position, -spec.position_range, spec.position_range, 0xFFFF) << 24
            | to_code("velocity", velocity, -spec.velocity_range, spec.velocity_range, 0xFFF) << 12
            | to_code("torque", torque, -spec.torque_range, spec.torque_range, 0xFFF)
        )
        return word.to_bytes(8, "big")

    def unpack_command(self, spec: MotorSpec, data: bytes | bytearray) -> MotorCommand:
        """Return the content of a command. Raises FrameError unless it is 8 bytes."""
        if len(data) != 8:
            raise FrameError(data, "8 bytes")
        word = int.from_bytes(data, "big")
        return MotorCommand(
            from_code(word >> 24 & 0xFFFF, -spec.position_range, spec.position_range, 0xFFFF),
            from_code(word >> 12 & 0xFFF, -spec.velocity_range, spec.velocity_range, 0xFFF),
            from_code(word >> 52, 0.0, spec.kp_max, 0xFFF),
            from_code(word >> 40 & 0xFFF, 0.0, spec.kd_max, 0xFFF),
            from_code(word & 0xFFF, -spec.torque_range, spec.torque_range, 0xFFF),
        )

    def pack_reply(self, spec: MotorSpec, reply: MotorReply) -> bytes:
        """Return the 8 bytes of a status frame. Raises ParameterError on NaN or a value that does not fit."""
        steps = (POSITION_STEP, _speed_step(spec), CURRENT_STEP * spec.torque_per_ampere)
        numbers = [
            _whole(name, value, step)
            for name, value, step in zip(("position", "velocity", "torque"), reply[1:4], steps, strict=True)
        ]
        return _STATUS.pack(*numbers, max(-128, min(127, reply.temperature or 0)), reply.error or 0)

    def unpack_reply(self, spec: MotorSpec, motor_id: int, data: bytes | bytearray) -> MotorReply:
        """Return the content of a status frame. Raises FrameError unless it is 8 bytes."""
        if len(data) != 8:
            raise FrameError(data, "a status frame of 8 bytes")
        position, speed, current, temperature, error = _STATUS.unpack(data)
        torque = current * CURRENT_STEP * spec.torque_per_ampere
        return MotorReply(motor_id, position * POSITION_STEP, speed * _speed_step(spec), torque, temperature, error)

    def enter(self, motor_id: int) -> tuple[Frame, ...]:
        """Return no frame."""
        return ()

    def exit(self, motor_id: int) -> tuple[Frame, ...]:
        """Return the current 0 A."""
        return ((EXTENDED | MODE_CURRENT << 8 | motor_id, NO_CURRENT),)

    def set_zero(self, motor_id: int) -> tuple[Frame, ...]:
        """Return no frame."""
        return ()

    def classify(self, frame_id: int, data: bytes | bytearray, motor_ids: frozenset[int]) -> tuple[str, int]:
        """Return what a frame with a 29-bit ID is; a frame of any control mode is a command."""
        motor_id, kind = frame_id & 0xFF, (frame_id & ID_BITS) >> 8
        if motor_id not in motor_ids:
            return OTHER, 0
        if kind == STATUS and len(data) == 8:
            return REPLY, motor_id
        return (COMMAND, motor_id) if kind <= LAST_MODE else (OTHER, 0)


def _speed_step(spec: MotorSpec) -> float:
    """Return the output's speed in rad/s that one step of a status frame means."""
    return SPEED_STEP / (spec.pole_pairs * spec.gear_ratio)


def _whole(name: str, value: float, step: float) -> int:
    limit = 0x7FFF * step
    if not abs(value) <= limit:
        raise ParameterError(name, value, f"from {-limit:g} to {limit:g}")
    return round(value / step)


MIT_V3 = MitV3()
