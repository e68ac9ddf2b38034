"""The wire formats of AK motors' boards: the frames of `mit` (V1 and V2 boards) and `mit_v3` (V3 boards).

`mit`: the frames of `core.motors.specs`, with the motor's ID as an 11-bit arbitration ID. A motor replies to each
command, with its own ID or the master's (0); the first byte is the motor's ID. ENTER, EXIT and SET_ZERO are special
commands.

`mit_v3` (CubeMars driver manual V3.0.0): 29-bit IDs, control mode << 8 | motor ID. Command, control mode 8, 8 bytes, a
big-endian bit stream, ranges in `MotorSpec.v3_ranges`:

    kp 12 | kd 12 | position 16 | velocity 12 | torque 12        tau = kp (p - p_motor) + kd (v - v_motor) + torque

A command gets no reply. The board sends a status frame on its own timer, 1 to 500 times a second, ID 0x29 << 8 | motor
ID, big-endian integers:

    position 0.1 deg 16 | speed 10 electrical rpm 16 | current 0.01 A 16 | board temperature degC 8 | error 8

Speed and current are the motor's: pole pairs and gear ratio lead to the output's speed, `torque_per_ampere` to its
torque. No frame switches a motor on: its first command does. The current 0 A (control mode 1) switches it off. A
command without gains and torque comes before it (`MotorBus`), but is not enough: no 12-bit code is exactly 0 Nm.

A motor also obeys frames that are not addressed to it as ours are, and shorter ones, so that these count as commands of
another sender. The open drive compares the lowest 7 bits of an ID alone. Some firmware obeys short and remote frames,
and completes them with bytes of an earlier frame. V3.2 boards obey the ID 0xFF.

A further format is one subclass of `WireFormat` that overrides what differs, and one entry in `FORMATS`.
"""

import math
import struct
from dataclasses import dataclass, replace

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.motors import specs
from exo_gravity.core.motors.specs import ENTER, EXIT, SET_ZERO, MotorCommand, MotorReply, MotorSpec

EXTENDED = 1 << 31  # set in the arbitration ID of a frame with a 29-bit ID, as in SocketCAN
ID_BITS = 0x1FFFFFFF  # of an arbitration ID
MASTER_ID = 0  # the arbitration ID of replies from some firmware versions of V1 and V2 boards

MODE_CURRENT, MODE_MIT, LAST_MODE = 1, 8, 15  # control modes of V3 boards
STATUS = 0x29
BROADCAST_ID = 0xFF  # of a command to all V3 boards of a bus
NO_CURRENT = bytes(4)  # int32, mA
V3_POSITION_RANGE = 12.56  # rad
POSITION_STEP = math.radians(0.1)  # rad
SPEED_STEP = 10.0 * 2.0 * math.pi / 60.0  # electrical rad/s
CURRENT_STEP = 0.01  # A
_STATUS = struct.Struct(">hhhbB")

Frame = tuple[int, bytes]  # arbitration ID and data
OPEN_DRIVE_BITS = 0x7F  # of an ID that the open drive compares
OPEN_DRIVE_LENGTH = 7  # bytes of its reply, which no other board is known to send
# What a frame is. MALFORMED is a reply of a wrong length; SERVO the status frame of a motor that does not speak `mit`:
# a V1 or V2 board in servo mode, or a V3 board.
REPLY, COMMAND, MALFORMED, SERVO, OTHER = "reply", "command", "malformed reply", "servo mode", "other"


@dataclass(frozen=True)
class WireFormat:
    """The frames of one kind of board, as pure functions; here those of V1 and V2 boards.

    The arbitration IDs of the fields are those of motor 0: a motor adds its own ID.
    """

    name: str = "mit"  #: the value of the parameter `wire_format`
    #: whether a motor replies to each command, and only then; if not, it sends its state on its own timer
    replies: bool = True
    first_id: int = 0  #: of commands
    #: frames that switch a motor on, before its first command; none if the command itself does
    on: tuple[Frame, ...] = ((0, ENTER),)
    off: tuple[Frame, ...] = ((0, EXIT),)  #: frames that switch a motor off
    #: frames that make the present angle zero; none if the board has no such frame
    zero: tuple[Frame, ...] = ((0, SET_ZERO),)
    reply_lengths: tuple[int, ...] = specs.REPLY_LENGTHS  #: bytes of a reply or status frame

    def ranged(self, spec: MotorSpec) -> MotorSpec:
        """Return the motor with the usual ranges of this format. Raises ParameterError if they are not known."""
        return spec

    def reply_id(self, motor_id: int) -> int:
        """Return the arbitration ID of a motor's replies or status frames; firmware may have another."""
        return motor_id

    # Data of a command, as in `core.motors.specs`.
    pack_command = staticmethod(specs.pack_command)
    unpack_command = staticmethod(specs.unpack_command)

    def pack_reply(self, spec: MotorSpec, reply: MotorReply) -> bytes:
        """Return the data of a reply or status frame. Raises ParameterError on NaN or a value that does not fit."""
        return specs.pack_reply(spec, *reply)

    def unpack_reply(self, spec: MotorSpec, motor_id: int, data: bytes | bytearray) -> MotorReply:
        """Return the content of a reply or status frame of the motor `motor_id`. Raises FrameError."""
        return specs.unpack_reply(spec, data)

    def classify(
        self, frame_id: int, data: bytes | bytearray, motor_ids: frozenset[int], is_remote: bool = False
    ) -> tuple[str, int]:
        """Return what a frame is, and the ID of its motor in `motor_ids`, BROADCAST_ID for all, 0 for none.

        The first byte of a command is never its motor's ID.
        """
        if is_status(frame_id, motor_ids):
            return SERVO, frame_id & 0xFF
        own, length = frame_id & OPEN_DRIVE_BITS, len(data)
        if frame_id >= EXTENDED:
            return OTHER, 0
        if length and data[0] in motor_ids and frame_id in (MASTER_ID, data[0]) and not is_remote:
            return (REPLY if length in self.reply_lengths else MALFORMED), data[0]
        return (COMMAND, own) if own in motor_ids else (OTHER, 0)


class V3Format(WireFormat):
    """The frames of V3 boards; the methods are those of `WireFormat`."""

    def ranged(self, spec: MotorSpec) -> MotorSpec:
        """Return the motor with the ranges of manual V3.0.0. Raises ParameterError if it has none for the motor."""
        if spec.v3_ranges is None:
            expected = f"another format for an {spec.name}, because the ranges of a V3 board of it are not known"
            raise ParameterError("wire_format", self.name, expected)
        velocity, torque = spec.v3_ranges
        return replace(spec, position_range=V3_POSITION_RANGE, velocity_range=velocity, torque_range=torque)

    def reply_id(self, motor_id: int) -> int:
        """Return the 29-bit ID of a motor's status frames."""
        return EXTENDED | STATUS << 8 | motor_id

    @staticmethod
    def pack_command(spec: MotorSpec, position: float, velocity: float, kp: float, kd: float, torque: float) -> bytes:
        """Return the data of a command."""
        word = specs.pack_fields(spec, kp=kp, kd=kd, position=position, velocity=velocity, torque=torque)
        return word.to_bytes(8, "big")

    @staticmethod
    def unpack_command(spec: MotorSpec, data: bytes | bytearray) -> MotorCommand:
        """Return the content of a command. Raises FrameError."""
        if len(data) != 8:
            raise FrameError(data, "8 bytes")
        order = "kp", "kd", "position", "velocity", "torque"
        values = specs.unpack_fields(spec, int.from_bytes(data, "big"), *order)
        return MotorCommand(**dict(zip(order, values, strict=True)))

    def pack_reply(self, spec: MotorSpec, reply: MotorReply) -> bytes:
        """Return the data of a status frame. Raises ParameterError."""
        numbers = []
        for name, value, step in zip(MotorReply._fields[1:4], reply[1:4], _steps(spec), strict=True):
            limit = 0x7FFF * step
            if not abs(value) <= limit:
                raise ParameterError(name, value, f"from {-limit:g} to {limit:g}")
            numbers.append(round(value / step))
        return _STATUS.pack(*numbers, max(-128, min(127, reply.temperature or 0)), reply.error or 0)

    def unpack_reply(self, spec: MotorSpec, motor_id: int, data: bytes | bytearray) -> MotorReply:
        """Return the content of a status frame. Raises FrameError."""
        if len(data) != _STATUS.size:
            raise FrameError(data, "a status frame of 8 bytes")
        position, speed, current, temperature, error = _STATUS.unpack(data)
        steps = _steps(spec)
        return MotorReply(motor_id, position * steps[0], speed * steps[1], current * steps[2], temperature, error)

    def classify(
        self, frame_id: int, data: bytes | bytearray, motor_ids: frozenset[int], is_remote: bool = False
    ) -> tuple[str, int]:
        """Return what a frame is: one of any control mode is a command."""
        if is_status(frame_id, motor_ids) and not is_remote:
            return (REPLY if len(data) in self.reply_lengths else MALFORMED), frame_id & 0xFF
        motor_id, mode = frame_id & 0xFF, (frame_id & ID_BITS) >> 8
        is_ours = motor_id in motor_ids or motor_id == BROADCAST_ID
        return (COMMAND, motor_id) if frame_id >= EXTENDED and mode <= LAST_MODE and is_ours else (OTHER, 0)


def is_status(frame_id: int, motor_ids: frozenset[int]) -> bool:
    """Return whether a frame has the ID of status frames of one of these motors."""
    return frame_id & ~0xFF == EXTENDED | STATUS << 8 and frame_id & 0xFF in motor_ids


def _steps(spec: MotorSpec) -> tuple[float, float, float]:
    """Return the output's rad, rad/s and Nm that one step of a status frame means."""
    return POSITION_STEP, SPEED_STEP / (spec.pole_pairs * spec.gear_ratio), CURRENT_STEP * spec.torque_per_ampere


MIT = WireFormat()
MIT_V3 = V3Format(
    "mit_v3", False, EXTENDED | MODE_MIT << 8, (), ((EXTENDED | MODE_CURRENT << 8, NO_CURRENT),), (), (_STATUS.size,)
)
FORMATS: dict[str, WireFormat] = {MIT.name: MIT, MIT_V3.name: MIT_V3}
