"""What a wire format provides: the frames of one kind of board, as pure functions of motor, ID and values.

A further format is one file with a class like those in `mit.py` and `mit_v3.py`, and one line in `FORMATS`.
"""

from __future__ import annotations

from typing import Protocol

from exo_gravity.core.motors.specs import MotorCommand, MotorReply, MotorSpec

EXTENDED = 1 << 31  # set in the arbitration ID of a frame with a 29-bit ID, as in SocketCAN
ID_BITS = 0x1FFFFFFF  # of an arbitration ID

Frame = tuple[int, bytes]  # arbitration ID and data
REPLY, COMMAND, OTHER = "reply", "command", "other"


class WireFormat(Protocol):
    """The frames of one kind of board."""

    @property
    def name(self) -> str:
        """The value of the parameter `wire_format`."""
        ...

    @property
    def replies(self) -> bool:
        """Whether a motor replies to each command, and only then; if not, it sends its state on its own timer."""
        ...

    @property
    def is_extended(self) -> bool:
        """Whether its IDs have 29 bits."""
        ...

    def ranged(self, spec: MotorSpec) -> MotorSpec:
        """Return the motor with the usual ranges of this format."""
        ...

    def command_id(self, motor_id: int) -> int:
        """Return the arbitration ID of commands to a motor."""
        ...

    def pack_command(
        self, spec: MotorSpec, position: float, velocity: float, kp: float, kd: float, torque: float
    ) -> bytes:
        """Return the data of a command: rad, rad/s, Nm/rad, Nm s/rad, Nm. Raises ParameterError beyond the ranges."""
        ...

    def unpack_command(self, spec: MotorSpec, data: bytes | bytearray) -> MotorCommand:
        """Return the content of a command. Raises FrameError."""
        ...

    def pack_reply(self, spec: MotorSpec, reply: MotorReply) -> bytes:
        """Return the data of a motor's reply or status frame. Raises ParameterError beyond the ranges."""
        ...

    def unpack_reply(self, spec: MotorSpec, motor_id: int, data: bytes | bytearray) -> MotorReply:
        """Return the content of a reply or status frame of the motor `motor_id`. Raises FrameError."""
        ...

    def enter(self, motor_id: int) -> tuple[Frame, ...]:
        """Return the frames that switch a motor on, before its first command; none if the command itself does."""
        ...

    def exit(self, motor_id: int) -> tuple[Frame, ...]:
        """Return the frames that switch a motor off."""
        ...

    def set_zero(self, motor_id: int) -> tuple[Frame, ...]:
        """Return the frames that make the present angle zero; none if the board has no such frame."""
        ...

    def classify(self, frame_id: int, data: bytes | bytearray, motor_ids: frozenset[int]) -> tuple[str, int]:
        """Return what a frame is, REPLY, COMMAND or OTHER, and the ID of the motor in `motor_ids`, 0 for none."""
        ...
