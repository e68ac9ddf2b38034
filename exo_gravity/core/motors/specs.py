"""AK motors: a record of each type, and the frames of MIT mode on V1 and V2 boards.

Command, 8 bytes, a big-endian bit stream, arbitration ID = motor ID (CubeMars driver manual V1.0.15, "MIT mode"):

    position 16 | velocity 12 | kp 12 | kd 12 | torque 12        tau = kp (p - p_motor) + kd (v - v_motor) + torque

Reply, 6, 7 or 8 bytes, arbitration ID = the motor's ID or the master's (0):

    motor ID 8 | position 16 | velocity 12 | torque 12 | temperature + 40 8 | error 8

Older firmware ends after the torque. The open drive, from which the AK firmware descends, sends its supply voltage as
the seventh byte, and nothing after it.

All values refer to the output side of the gear. A field of b bits divides its range into 2^b - 1 steps, and values are
rounded to the nearest step: the manual's 2^b overflows at the maximum, and truncation would turn 0 Nm into a push. No
code is exactly 0 Nm.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.numbers import one_float

ENTER = b"\xff" * 7 + b"\xfc"
EXIT = b"\xff" * 7 + b"\xfd"
SET_ZERO = b"\xff" * 7 + b"\xfe"
# Seven bytes FF and this one, or a higher one, are no command on some firmware: EE is a query, F0 clears faults, FB
# starts the boot loader, and FC, FD and FE are the frames above.
LOWEST_SPECIAL = 0xEE
_TOP = b"\xff" * 7

WIRE_RANGE_BOUNDS = (1.0, 100.0)  # rad/s or Nm
REPLY_LENGTHS = (6, 7, 8)  # bytes
# What the error byte means in the manuals' table. One vendor's MIT firmware sends a bit mask instead: the whole byte is
# 2 above 81 degC and 6 above 120 degC, where it shuts off.
MOTOR_ERRORS = {
    0: "none",
    1: "motor over-temperature",
    2: "over-current",
    3: "over-voltage",
    4: "under-voltage",
    5: "encoder",
    6: "MOSFET over-temperature",
    7: "stall",
}
ERROR_BITS = {1: "warm, above 81 degC", 2: "shut off, above 120 degC"}  # by the number of the bit


@dataclass(frozen=True)
class MotorSpec:
    """All that is known of a motor type. Torque, velocity and inertia are those of the output. Raises ParameterError.

    The ranges of the wire format are not physical limits. No CAN message reports them, and some firmware has others.
    """

    name: str
    velocity_range: float  #: rad/s: the wire range of V1 and V2 boards is +- this value
    torque_range: float  #: Nm: likewise
    v3_ranges: tuple[float, float] | None  #: rad/s and Nm, those of a V3 board; None if they are not known
    rated_torque: float  #: Nm, for any time
    peak_torque: float  #: Nm, for seconds
    gear_ratio: int  #: turns of the rotor per turn of the output
    pole_pairs: int  #: of the rotor; only V3 boards report a speed of it
    #: Nm/A at the output, by which a V3 board divides torque for its current, which it reports: that of its firmware
    #: where known, else rated torque by rated current
    torque_per_ampere: float
    rotor_inertia: float  #: kg m^2, that of the rotor times the gear ratio squared
    position_range: float = 12.5  #: rad: the wire range is +- this value
    kp_max: float = 500.0  #: Nm/rad: the wire range starts at 0
    kd_max: float = 5.0  #: Nm s/rad: likewise

    def __post_init__(self) -> None:
        for name in ("velocity_range", "torque_range"):
            one_float(name, getattr(self, name), *WIRE_RANGE_BOUNDS)

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
        """The angle in rad of the output per turn of the rotor, by whole ones of which an angle after power-up is off.

        The encoder is on the rotor, and does not count its turns while the power is off.
        """
        return 2.0 * math.pi / self.gear_ratio

    @property
    def home_tolerance(self) -> float:
        """The angle in rad from zero at which an arm that hangs may start, too small to be off by a rotor's turn.

        Just under half a turn of the rotor, to the hundredth of a rad that a refusal shows.
        """
        return min(round(0.48 * self.rotor_turn, 2), 0.49 * self.rotor_turn)


# CubeMars driver manual V1.0.15, "MIT mode", and V3.0.0 for V3 boards; data sheets; published motor tables for the
# inertia of the rotors alone, 243.5 and 607 g cm^2.
MOTORS = {
    "AK60-6": MotorSpec(
        "AK60-6",
        velocity_range=45.0,
        torque_range=15.0,
        v3_ranges=(60.0, 12.0),
        rated_torque=3.0,
        peak_torque=9.0,
        gear_ratio=6,
        pole_pairs=14,
        torque_per_ampere=0.2997,  # of firmware V3.2; rated torque by rated current would be 0.405
        rotor_inertia=8.8e-4,
    ),
    "AK80-9": MotorSpec(
        "AK80-9",
        velocity_range=50.0,
        torque_range=18.0,
        v3_ranges=(65.0, 18.0),
        rated_torque=9.0,
        peak_torque=18.0,
        gear_ratio=9,
        pole_pairs=21,
        torque_per_ampere=9.0 / 10.3,
        rotor_inertia=4.9e-3,
    ),
}
USUAL_MOTORS = ("AK60-6", "AK80-9", "AK60-6", "AK60-6")  # of the paper's arm, from shoulder to elbow


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
    error: int | None  #: the error byte (`error_text`), None from firmware that replies with 6 or 7 bytes


def is_special(data: bytes | bytearray) -> bool:
    """Return whether some firmware takes these 8 bytes for something else than a command."""
    return len(data) == 8 and data[7] >= LOWEST_SPECIAL and data[:7] == _TOP


def error_text(error: int) -> str:
    """Return what the error byte of a V1 or V2 board means: by the manuals' table, and by one firmware's bit mask."""
    bits = [ERROR_BITS.get(bit, "unknown") for bit in range(8) if error >> bit & 1]
    return f"{MOTOR_ERRORS.get(error, 'unknown')}; as a bit mask: {', '.join(bits) or 'none'}"


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


def pack_reply(
    spec: MotorSpec,
    motor_id: int,
    position: float,
    velocity: float,
    torque: float,
    temperature: int | None = None,
    error: int | None = None,
) -> bytes:
    """Return the bytes of a reply: 8, or 6 without `temperature` (degC, -40..215) and `error` (0..255).

    Raises ParameterError on NaN, infinity or a value outside the spec's range.
    """
    word = pack_fields(spec, position=position, velocity=velocity, torque=torque)
    data = (int(one_float("motor_id", motor_id, 0, 255)) << 40 | word).to_bytes(6, "big")
    if temperature is None or error is None:
        return data
    warmth = one_float("temperature", temperature, -40, 215) + 40
    return data + bytes((int(warmth), int(one_float("error", error, 0, 255))))


def unpack_reply(spec: MotorSpec, data: bytes | bytearray) -> MotorReply:
    """Return the content of a reply. Raises FrameError unless it is 6, 7 or 8 bytes."""
    if len(data) not in REPLY_LENGTHS:
        raise FrameError(data, "a reply of 6, 7 or 8 bytes")
    position, velocity, torque = unpack_fields(spec, int.from_bytes(data[:6], "big"), *MotorReply._fields[1:4])
    temperature, error = (data[6] - 40, data[7]) if len(data) == 8 else (None, None)
    return MotorReply(data[0], position, velocity, torque, temperature, error)


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
