# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What all motor families share: the record of a motor, the frames of MIT mode, and what a wire format is.

MIT mode (Ben Katz's drive, from which AK and Damiao firmware descend) is a big-endian bit stream of 8 bytes:

    position 16 | velocity 12 | kp 12 | kd 12 | torque 12        tau = kp (p - p_motor) + kd (v - v_motor) + torque

All values refer to the output side of the gear. A field of b bits divides its range into 2^b - 1 steps, and values are
rounded to the nearest step: the AK manual's 2^b overflows at the maximum, and truncation would turn 0 Nm into a push.
No code is exactly 0 Nm. Seven bytes FF and a high last byte are special frames that switch a motor on or off.

A family is one module with its motors and its wire formats (`ak`, `damiao`), which `families` finds. A wire format is a
subclass of `WireFormat` that overrides what differs.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.numbers import one_float

ENTER = b"\xff" * 7 + b"\xfc"
EXIT = b"\xff" * 7 + b"\xfd"
SET_ZERO = b"\xff" * 7 + b"\xfe"
# Seven bytes FF and this one, or a higher one, are no command on some firmware: EE is a query, F0 clears faults, FB
# starts the boot loader or clears an error, and FC, FD and FE are the frames above.
LOWEST_SPECIAL = 0xEE
_TOP = b"\xff" * 7
DAMPED = bytes.fromhex("80008000 00fff800")  # a command with full damping alone: the same for all motors

EXTENDED = 1 << 31  # set in the arbitration ID of a frame with a 29-bit ID, as in SocketCAN
ID_BITS = 0x1FFFFFFF  # of an arbitration ID
Frame = tuple[int, bytes]  # arbitration ID and data
# What a frame is. MALFORMED is a reply of a wrong length; SERVO the status frame of a motor that does not speak `mit`:
# a V1 or V2 board in servo mode, or a V3 board; SETTING a board's answer to the question for one of its settings;
# ELSEWHERE a reply that a motor sends with another ID than the file says; ALIAS a command that only boards obey whose
# replies have `alias_length`.
REPLY, COMMAND, MALFORMED, SERVO, OTHER = "reply", "command", "malformed reply", "servo mode", "other"
SETTING, ELSEWHERE, ALIAS = "setting", "reply with another ID", "command with another ID"
BROADCAST_ID = 0xFF  # stands for all motors of a bus whose boards obey it
RPM = 2.0 * math.pi / 60.0  # rad/s
HANGING_TOLERANCE = 0.5  # rad from zero, at most, of an arm that hangs, where its encoders leave no doubt


@dataclass(frozen=True)
class MotorSpec:
    """All that is known of a motor type. Torque, speed and inertia are those of the output. Raises ParameterError.

    The ranges of the wire format are not physical limits. Some firmware has others.
    """

    name: str
    family: str  #: that has its wire formats
    velocity_range: float  #: rad/s: the wire range is +- this value
    torque_range: float  #: Nm: likewise
    rated_torque: float  #: Nm, for any time
    peak_torque: float  #: Nm, for seconds
    rated_speed: float  #: rad/s, at which it gives its rated torque
    no_load_speed: float  #: rad/s, at the highest rated voltage
    gear_ratio: float  #: turns of the rotor per turn of the output
    pole_pairs: int  #: of the rotor
    torque_per_ampere: float  #: Nm/A, by which its firmware divides torque for its current
    rotor_inertia: float  #: kg m^2, that of the rotor times the gear ratio squared
    output_encoder: bool  #: whether its angle after power-up is that of the output, not only of a turn of the rotor
    can_fd: bool  #: whether it speaks CAN FD, too
    shuts_off_at: float  #: degC from which on its own protection may switch it off
    source: str  #: of these figures
    assumed: frozenset[str] = frozenset()  #: the fields that no source states
    position_range: float = 12.5  #: rad: the wire range is +- this value
    kp_max: float = 500.0  #: Nm/rad: the wire range starts at 0
    kd_max: float = 5.0  #: Nm s/rad: likewise

    def __post_init__(self) -> None:
        for name in ("position_range", "velocity_range", "torque_range"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ParameterError(name, value, "a positive number")

    @cached_property
    def fields(self) -> dict[str, tuple[float, float, int, float, float]]:
        """Of each field on the wire: lowest and highest value, bits, codes per unit and units per code."""
        position, velocity, torque = self.position_range, self.velocity_range, self.torque_range
        table = {
            "position": (-position, position, 16),
            "velocity": (-velocity, velocity, 12),
            "kp": (0.0, self.kp_max, 12),
            "kd": (0.0, self.kd_max, 12),
            "torque": (-torque, torque, 12),
        }
        spans = ((name, field, (1 << field[2]) - 1, field[1] - field[0]) for name, field in table.items())
        return {name: (*field, codes / span, span / codes) for name, field, codes, span in spans}

    @cached_property
    def standstill(self) -> float:
        """The velocity in rad/s that the motor decodes from a command of 0 rad/s."""
        return unpack_fields(self, pack_fields(self, velocity=0.0), "velocity")[0]

    @property
    def rotor_turn(self) -> float:
        """The angle in rad of the output per turn of the rotor.

        Without an encoder at the output, an angle after power-up is off by whole ones: an encoder on the rotor does not
        count its turns while the power is off.
        """
        return 2.0 * math.pi / self.gear_ratio

    @property
    def home_tolerance(self) -> float:
        """The angle in rad from zero at which an arm that hangs may start, too small to be off by a rotor's turn.

        Just under half a turn of the rotor, to the hundredth of a rad that a refusal shows.
        """
        if self.output_encoder:
            return HANGING_TOLERANCE
        return min(round(0.48 * self.rotor_turn, 2), 0.49 * self.rotor_turn)


class MotorCommand(NamedTuple):
    """The content of a command frame: rad, rad/s, Nm/rad, Nm s/rad, Nm."""

    position: float
    velocity: float
    kp: float
    kd: float
    torque: float


class MotorReply(NamedTuple):
    """The content of a reply."""

    motor_id: int
    position: float  #: rad
    velocity: float  #: rad/s
    torque: float  #: Nm
    temperature: int | None  #: degC, None from firmware that replies with 6 or 7 bytes
    error: int | None  #: the board's code of an error, 0 for none; None from firmware that replies with 6 or 7 bytes


class Setting(NamedTuple):
    """A value on a motor's board that must agree with the parameters of the arm."""

    name: str  #: the maker's
    number: int  #: by which the board's answer names it
    question: Frame  #: which the board answers with the value
    low: float  #: the least value that is right
    high: float  #: and the largest
    parameter: str  #: of the file that states it, '' for none
    unit: float  #: by which the board's value is multiplied to give that parameter


def is_special(data: bytes | bytearray) -> bool:
    """Return whether some firmware takes these 8 bytes for something else than a command."""
    return len(data) == 8 and data[7] >= LOWEST_SPECIAL and data[:7] == _TOP


def pack_command(spec: MotorSpec, position: float, velocity: float, kp: float, kd: float, torque: float) -> bytes:
    """Return the 8 bytes of a command, which no firmware takes for a special frame.

    position rad, velocity rad/s, kp 0..500 Nm/rad, kd 0..5 Nm s/rad, torque Nm. With all other fields at their maximum
    and a torque within 17 codes of its maximum (0.42 % of the range's width, 0.13 Nm of +-15), the torque is lowered to
    the code below these. Raises ParameterError on NaN, infinity or a value outside the spec's range.
    """
    word = pack_fields(spec, position=position, velocity=velocity, kp=kp, kd=kd, torque=torque)
    data = word.to_bytes(8, "big")
    return data if data[0] != 0xFF or not is_special(data) else data[:7] + bytes((LOWEST_SPECIAL - 1,))


def unpack_command(spec: MotorSpec, data: bytes | bytearray) -> MotorCommand:
    """Return the content of a command frame. Raises FrameError unless it is 8 bytes and not a special frame."""
    if len(data) != 8 or is_special(data):
        raise FrameError(data, "8 bytes and not a special frame")
    return MotorCommand(*unpack_fields(spec, int.from_bytes(data, "big"), *MotorCommand._fields))


def pack_fields(spec: MotorSpec, **values: float) -> int:
    """Return the bit stream of these fields, in their order. Raises ParameterError for a value outside its range."""
    word, fields = 0, spec.fields
    for name, value in values.items():
        low, high, bits, codes, _ = fields[name]
        if not low <= value <= high:  # rejects NaN too
            raise ParameterError(name, value, f"from {low:g} to {high:g}")
        word = word << bits | round((value - low) * codes)
    return word


def unpack_fields(spec: MotorSpec, word: int, *names: str) -> list[float]:
    """Return the values of the fields `names`, with which the bit stream `word` ends."""
    values, fields = [], spec.fields
    for name in reversed(names):
        low, _, bits, _, unit = fields[name]
        values.append(low + (word & (1 << bits) - 1) * unit)
        word >>= bits
    return values[::-1]


def state_of(spec: MotorSpec, reply: MotorReply) -> bytes:
    """Return position, velocity and torque of a reply in MIT mode, 5 bytes. Raises ParameterError."""
    word = pack_fields(spec, position=reply.position, velocity=reply.velocity, torque=reply.torque)
    return word.to_bytes(5, "big")


def byte_of(name: str, value: float, low: float = 0.0, high: float = 255.0, offset: int = 0) -> int:
    """Return a value that is sent as one byte, `offset` above it. Raises ParameterError unless it is low to high."""
    return int(one_float(name, value, low, high)) + offset


@dataclass(frozen=True)
class WireFormat(ABC):
    """The frames of one kind of board, as pure functions; here those that most boards in MIT mode have in common.

    The arbitration IDs of the fields are those of motor 0: a motor adds its own ID.
    """

    name: str  #: the value of the parameter `wire_format`
    family: str  #: of its motors
    #: whether a motor replies to each command, and only then; if not, it sends its state on its own timer
    replies: bool = True
    first_id: int = 0  #: of commands
    last_id: int = 126  #: the largest ID of a motor
    id_bits: int = 11  #: of an 11-bit ID that some of these boards compare with their own
    #: frames that switch a motor on, before its first command; none if the command itself does
    on: tuple[Frame, ...] = ((0, ENTER),)
    off: tuple[Frame, ...] = ((0, EXIT),)  #: frames that switch a motor off
    clear_error: tuple[Frame, ...] = ()  #: frames that clear an error of a motor, which stays off; none if none does
    #: frames that make the present angle zero; none if the board has no such frame
    zero: tuple[Frame, ...] = ((0, SET_ZERO),)
    stops: frozenset[bytes] = frozenset((EXIT,))  #: data of all commands that switch a motor off
    reply_lengths: tuple[int, ...] = (8,)  #: bytes of a reply or status frame
    alias_length: int = 0  #: bytes of a reply that shows a board which obeys other IDs than its own, too; 0: none does
    needs_timeout: bool = False  #: whether a motor's own time-out must be set
    #: codes of errors that say no more than that the motor has switched itself off, and can be switched on again
    let_go: frozenset[int] = frozenset()

    def ranged(self, spec: MotorSpec) -> MotorSpec:
        """Return the motor with the usual ranges of this format. Raises ParameterError if they are not known."""
        return spec

    def reply_id(self, motor_id: int, master_id: int = 0) -> int:
        """Return the arbitration ID of a motor's replies or status frames.

        master_id: as the file has it, 0 for the usual one. Raises ParameterError if there is no choice.
        """
        if master_id:
            raise ParameterError("master_id", master_id, f"0 for a motor with wire_format = {self.name}")
        return self.first_id + motor_id

    # Data of a command.
    pack_command = staticmethod(pack_command)
    unpack_command = staticmethod(unpack_command)

    @abstractmethod
    def pack_reply(self, spec: MotorSpec, reply: MotorReply, on: bool) -> bytes:
        """Return the data of a reply or status frame of a motor that is on or off.

        Raises ParameterError on NaN or a value that does not fit.
        """

    @abstractmethod
    def unpack_reply(self, spec: MotorSpec, motor_id: int, data: bytes | bytearray) -> MotorReply:
        """Return the content of a reply or status frame of the motor `motor_id`. Raises FrameError."""

    def says_on(self, data: bytes | bytearray) -> bool | None:
        """Return whether a reply that `unpack_reply` can read says that the motor is on; None if it does not say."""
        return None

    @abstractmethod
    def error_text(self, error: int) -> str:
        """Return what the code of an error means."""

    @abstractmethod
    def classify(
        self, frame_id: int, data: bytes | bytearray, reply_ids: Mapping[int, int], is_remote: bool = False
    ) -> tuple[str, int]:
        """Return what a frame is, and the ID of its motor, BROADCAST_ID for all of a bus, 0 for none.

        reply_ids: of the motors, with the ID of each one's replies.
        """

    def settings(self, spec: MotorSpec, motor_id: int, reply_id: int, timeout: float) -> Sequence[Setting]:
        """Return what a motor's board must be asked for, and how it must be set, before the motor is switched on.

        timeout: of the motor, s.
        """
        return ()

    def unpack_setting(self, data: bytes | bytearray) -> tuple[int, float]:
        """Return the number of a setting and its value, from a frame that `classify` calls SETTING."""
        raise FrameError(data, "a reply: these boards have no settings to be asked for")

    def questions(self, motor_id: int) -> tuple[Frame, ...]:
        """Return frames that a motor answers with its state, and that move nothing; none if it reports by itself."""
        return ((self.first_id + motor_id, DAMPED),)


class Family(NamedTuple):
    """The motors of one maker whose boards speak the same wire formats."""

    name: str
    motors: Mapping[str, MotorSpec]  #: by the value of the parameter `motor`
    formats: Mapping[str, WireFormat]  #: by the value of the parameter `wire_format`
