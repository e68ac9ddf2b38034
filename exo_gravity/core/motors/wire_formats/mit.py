"""MIT mode of V1 and V2 boards: the frames of `core.motors.specs`, with the motor's ID as an 11-bit arbitration ID.

A motor replies to each command, with its own ID or the master's (0); the first byte is the motor's ID. ENTER, EXIT and
SET_ZERO are special commands.
"""

from __future__ import annotations

from dataclasses import dataclass

from exo_gravity.core.motors.specs import (
    ENTER,
    EXIT,
    SET_ZERO,
    MotorReply,
    MotorSpec,
    pack_command,
    pack_reply,
    unpack_command,
    unpack_reply,
)
from exo_gravity.core.motors.wire_formats.wire_format import COMMAND, OTHER, REPLY, Frame

MASTER_ID = 0  # the arbitration ID of some firmwares' replies


@dataclass(frozen=True)
class Mit:
    """The `WireFormat` of V1 and V2 boards."""

    name = "mit"
    replies = True
    is_extended = False
    pack_command = staticmethod(pack_command)
    unpack_command = staticmethod(unpack_command)

    def ranged(self, spec: MotorSpec) -> MotorSpec:
        """Return the motor as it is in `MOTORS`."""
        return spec

    def command_id(self, motor_id: int) -> int:
        """Return the motor's ID."""
        return motor_id

    def pack_reply(self, spec: MotorSpec, reply: MotorReply) -> bytes:
        """Return 8 bytes, or 6 without temperature and error."""
        return pack_reply(spec, *reply)

    def unpack_reply(self, spec: MotorSpec, motor_id: int, data: bytes | bytearray) -> MotorReply:
        """Return the content of a reply, which contains the motor's ID. Raises FrameError."""
        return unpack_reply(spec, data)

    def enter(self, motor_id: int) -> tuple[Frame, ...]:
        """Return ENTER."""
        return ((motor_id, ENTER),)

    def exit(self, motor_id: int) -> tuple[Frame, ...]:
        """Return EXIT."""
        return ((motor_id, EXIT),)

    def set_zero(self, motor_id: int) -> tuple[Frame, ...]:
        """Return SET_ZERO."""
        return ((motor_id, SET_ZERO),)

    def classify(self, frame_id: int, data: bytes | bytearray, motor_ids: frozenset[int]) -> tuple[str, int]:
        """Return what a frame with an 11-bit ID is: the first byte of a command is never its motor's ID."""
        length = len(data)
        if length in (6, 8) and data[0] in motor_ids and frame_id in (MASTER_ID, data[0]):
            return REPLY, data[0]
        if length == 8 and frame_id in motor_ids and data[0] != frame_id:
            return COMMAND, frame_id
        return OTHER, 0


MIT = Mit()
