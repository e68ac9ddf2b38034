# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""AK motors (CubeMars, T-Motor): a record of each type, and the frames of their boards.

`mit`, V1 and V2 boards (CubeMars driver manual V1.0.15, "MIT mode"): commands of MIT mode (`frames`) with the motor's
ID as an 11-bit arbitration ID; ENTER, EXIT and SET_ZERO are special commands. A motor replies to each command, with its
own ID or the master's (0). Reply, 6, 7 or 8 bytes:

    motor ID 8 | position 16 | velocity 12 | torque 12 | temperature + 40 8 | error 8

Older firmware ends after the torque. The open drive, from which the AK firmware descends, sends its supply voltage as
the seventh byte, and nothing after it. No reply says whether the motor is on.

`mit_v3`, V3 boards (CubeMars driver manual V3.0.0): 29-bit IDs, control mode << 8 | motor ID. Command, control mode 8,
8 bytes, a big-endian bit stream, ranges in V3_RANGES:

    kp 12 | kd 12 | position 16 | velocity 12 | torque 12        tau = kp (p - p_motor) + kd (v - v_motor) + torque

A command gets no reply. The board sends a status frame on its own timer, 1 to 500 times a second, ID 0x29 << 8 | motor
ID, big-endian integers:

    position 0.1 deg 16 | speed 10 electrical rpm 16 | current 0.01 A 16 | board temperature degC 8 | error 8

Speed and current are the motor's: pole pairs and gear ratio lead to the output's speed, `torque_per_ampere` to its
torque. No frame switches a motor on: its first command does. The current 0 A (control mode 1) switches it off. A
command without gains and torque comes before it (`MotorBus`), but is not enough: no 12-bit code is exactly 0 Nm.

A motor also obeys frames that are not addressed to it as ours are, and shorter ones, so that these count as commands of
another sender. The open drive, whose replies have 7 bytes, compares the lowest 7 bits of an ID alone. Some firmware
obeys short and remote frames, and completes them with bytes of an earlier frame. V3.2 boards obey the ID 0xFF.
"""

import math
import struct
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import partial

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.motors.frames import (
    ALIAS,
    BROADCAST_ID,
    COMMAND,
    EXTENDED,
    ID_BITS,
    MALFORMED,
    OTHER,
    REPLY,
    RPM,
    SERVO,
    Family,
    Frame,
    MotorCommand,
    MotorReply,
    MotorSpec,
    WireFormat,
    byte_of,
    pack_fields,
    state_of,
    unpack_fields,
)

FAMILY = "ak"
MASTER_ID = 0  # the arbitration ID of replies from some firmware versions of V1 and V2 boards
REPLY_LENGTHS = (6, 7, 8)  # bytes
TEMPERATURE_OFFSET = 40  # of the byte, degC
OPEN_DRIVE_BITS = 0x7F  # of an ID that the open drive compares: 7
OPEN_DRIVE_LENGTH = 7  # bytes of its reply, which no other board is known to send
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

MODE_CURRENT, MODE_MIT, LAST_MODE = 1, 8, 15  # control modes of V3 boards
STATUS = 0x29
NO_CURRENT = bytes(4)  # int32, mA
V3_POSITION_RANGE = 12.56  # rad
# rad/s and Nm, the wire ranges of V3 boards by motor (manual V3.0.0, table of force control mode); of others none are
# known. Public drivers disagree about the AK10-9: 28 and 54, or 33 and 65.
V3_RANGES = {"AK10-9": (28.0, 54.0), "AK60-6": (60.0, 12.0), "AK80-9": (65.0, 18.0)}
POSITION_STEP = math.radians(0.1)  # rad
SPEED_STEP = 10.0 * 2.0 * math.pi / 60.0  # electrical rad/s
CURRENT_STEP = 0.01  # A
_STATUS = struct.Struct(">hhhbB")

# What the motors have in common.
_motor = partial(
    MotorSpec,
    family=FAMILY,
    output_encoder=False,
    can_fd=False,
    shuts_off_at=120.0,  # of the one firmware that was run (sim/motors/ak.py)
    assumed=frozenset(("shuts_off_at",)),
)
_SOURCE = "wire ranges: driver manual V1.0.15, table of MIT mode; CubeMars product page, "

# Torque per ampere is rated torque by rated current, unless a firmware was read. An AK10-9 has a second encoder at the
# output; whether its angle after power-up is that one's is not known, so that it counts as ambiguous.
_ALL = (
    _motor(
        name="AK10-9",
        velocity_range=50.0,
        torque_range=65.0,
        rated_torque=18.0,
        peak_torque=48.0,
        rated_speed=228.0 * RPM,
        no_load_speed=320.0 * RPM,
        gear_ratio=9,
        pole_pairs=21,
        torque_per_ampere=18.0 / 10.6,
        rotor_inertia=8.12e-3,  # 1002 g cm^2 times the gear ratio squared
        source=_SOURCE + "AK10-9 V2.0 KV60 at 48 V",
        assumed=frozenset(("shuts_off_at", "output_encoder")),
    ),
    _motor(
        name="AK60-6",
        velocity_range=45.0,
        torque_range=15.0,
        rated_torque=3.0,
        peak_torque=9.0,
        rated_speed=420.0 * RPM,
        no_load_speed=560.0 * RPM,
        gear_ratio=6,
        pole_pairs=14,
        torque_per_ampere=0.2997,  # of firmware V3.2; rated torque by rated current would be 0.405
        rotor_inertia=8.8e-4,  # 243.5 g cm^2
        source=_SOURCE + "AK60-6 V1.1 KV140 at 24 V",
        assumed=frozenset(("shuts_off_at", "no_load_speed")),  # Kv times 24 V by the gear ratio
    ),
    _motor(
        name="AK70-10",
        velocity_range=50.0,
        torque_range=25.0,
        rated_torque=8.3,
        peak_torque=24.8,
        rated_speed=310.0 * RPM,
        no_load_speed=480.0 * RPM,
        gear_ratio=10,
        pole_pairs=21,
        torque_per_ampere=8.3 / 7.2,
        rotor_inertia=4.14e-3,  # 414 g cm^2; an older page has 753
        source=_SOURCE + "AK70-10 KV100 at 48 V",
    ),
    _motor(
        name="AK80-6",
        velocity_range=76.0,
        torque_range=12.0,
        rated_torque=6.0,
        peak_torque=12.0,
        rated_speed=603.0 * RPM,
        no_load_speed=800.0 * RPM,
        gear_ratio=6,
        pole_pairs=21,
        torque_per_ampere=6.0 / 9.7,
        rotor_inertia=2.19e-3,  # 607 g cm^2
        source=_SOURCE + "AK80-6 KV100 at 48 V",
    ),
    _motor(
        name="AK80-9",
        velocity_range=50.0,
        torque_range=18.0,
        rated_torque=9.0,
        peak_torque=18.0,
        rated_speed=390.0 * RPM,
        no_load_speed=570.0 * RPM,
        gear_ratio=9,
        pole_pairs=21,
        torque_per_ampere=9.0 / 10.3,
        rotor_inertia=4.9e-3,  # 607 g cm^2
        source=_SOURCE + "AK80-9 KV100 at 48 V",
    ),
    _motor(
        name="AK80-64",
        velocity_range=8.0,
        torque_range=144.0,
        rated_torque=48.0,
        peak_torque=120.0,
        rated_speed=48.0 * RPM,
        no_load_speed=75.0 * RPM,
        gear_ratio=64,
        pole_pairs=21,
        torque_per_ampere=48.0 / 7.0,
        rotor_inertia=0.231,  # 564.5 g cm^2
        source=_SOURCE + "AK80-64 KV80 at 48 V",
    ),
)
MOTORS = {spec.name: spec for spec in _ALL}
USUAL_MOTORS = ("AK60-6", "AK80-9", "AK60-6", "AK60-6")  # of the paper's arm, from shoulder to elbow


def error_text(error: int) -> str:
    """Return what the error byte of a V1 or V2 board means: by the manuals' table, and by one firmware's bit mask."""
    bits = [ERROR_BITS.get(bit, "unknown") for bit in range(8) if error >> bit & 1]
    return f"{MOTOR_ERRORS.get(error, 'unknown')}; as a bit mask: {', '.join(bits) or 'none'}"


@dataclass(frozen=True)
class MitFormat(WireFormat):
    """The frames of V1 and V2 boards; the methods are those of `WireFormat`."""

    reply_lengths: tuple[int, ...] = REPLY_LENGTHS
    alias_length: int = OPEN_DRIVE_LENGTH
    id_bits: int = 7
    error_text = staticmethod(error_text)

    def pack_reply(self, spec: MotorSpec, reply: MotorReply, on: bool = False) -> bytes:
        """Return the data of a reply, which is the same on or off. Raises ParameterError."""
        data = bytes((byte_of("motor_id", reply.motor_id),)) + state_of(spec, reply)
        if reply.temperature is None or reply.error is None:
            return data
        warmth = byte_of("temperature", reply.temperature, -40.0, 215.0, TEMPERATURE_OFFSET)
        return data + bytes((warmth, byte_of("error", reply.error)))

    def unpack_reply(self, spec: MotorSpec, motor_id: int, data: bytes | bytearray) -> MotorReply:
        """Return the content of a reply. Raises FrameError unless it is 6, 7 or 8 bytes."""
        if len(data) not in REPLY_LENGTHS:
            raise FrameError(data, "a reply of 6, 7 or 8 bytes")
        position, velocity, torque = unpack_fields(spec, int.from_bytes(data[:6], "big"), *MotorReply._fields[1:4])
        temperature, error = (data[6] - TEMPERATURE_OFFSET, data[7]) if len(data) == 8 else (None, None)
        return MotorReply(data[0], position, velocity, torque, temperature, error)

    def classify(
        self, frame_id: int, data: bytes | bytearray, reply_ids: Collection[int], is_remote: bool = False
    ) -> tuple[str, int]:
        """Return what a frame is. The first byte of a command is never its motor's ID."""
        own, length = frame_id & OPEN_DRIVE_BITS, len(data)
        if frame_id >= EXTENDED:
            return (SERVO, frame_id & 0xFF) if is_status(frame_id, reply_ids) else (OTHER, 0)
        if length and data[0] in reply_ids and frame_id in (MASTER_ID, data[0]) and not is_remote:
            return (REPLY if length in self.reply_lengths else MALFORMED), data[0]
        if own not in reply_ids:
            return OTHER, 0
        return (COMMAND if frame_id == own else ALIAS), own


@dataclass(frozen=True)
class V3Format(WireFormat):
    """The frames of V3 boards; the methods are those of `WireFormat`."""

    def ranged(self, spec: MotorSpec) -> MotorSpec:
        """Return the motor with the ranges of manual V3.0.0. Raises ParameterError if it has none for the motor."""
        if spec.name not in V3_RANGES:
            expected = f"another format for an {spec.name}, because the ranges of a V3 board of it are not known"
            raise ParameterError("wire_format", self.name, expected)
        velocity, torque = V3_RANGES[spec.name]
        return replace(spec, position_range=V3_POSITION_RANGE, velocity_range=velocity, torque_range=torque)

    def reply_id(self, motor_id: int, master_id: int = 0) -> int:
        """Return the 29-bit ID of a motor's status frames. Raises ParameterError."""
        super().reply_id(motor_id, master_id)
        return EXTENDED | STATUS << 8 | motor_id

    @staticmethod
    def pack_command(spec: MotorSpec, position: float, velocity: float, kp: float, kd: float, torque: float) -> bytes:
        """Return the data of a command."""
        word = pack_fields(spec, kp=kp, kd=kd, position=position, velocity=velocity, torque=torque)
        return word.to_bytes(8, "big")

    @staticmethod
    def unpack_command(spec: MotorSpec, data: bytes | bytearray) -> MotorCommand:
        """Return the content of a command. Raises FrameError."""
        if len(data) != 8:
            raise FrameError(data, "8 bytes")
        order = "kp", "kd", "position", "velocity", "torque"
        values = unpack_fields(spec, int.from_bytes(data, "big"), *order)
        return MotorCommand(**dict(zip(order, values, strict=True)))

    def pack_reply(self, spec: MotorSpec, reply: MotorReply, on: bool = False) -> bytes:
        """Return the data of a status frame, which is the same on or off. Raises ParameterError."""
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

    error_text = staticmethod(error_text)

    def questions(self, motor_id: int) -> tuple[Frame, ...]:
        """Return none: a board reports by itself, and a command would switch its motor on."""
        return ()

    def classify(
        self, frame_id: int, data: bytes | bytearray, reply_ids: Collection[int], is_remote: bool = False
    ) -> tuple[str, int]:
        """Return what a frame is: one of any control mode is a command."""
        if is_status(frame_id, reply_ids) and not is_remote:
            return (REPLY if len(data) in self.reply_lengths else MALFORMED), frame_id & 0xFF
        motor_id, mode = frame_id & 0xFF, (frame_id & ID_BITS) >> 8
        is_ours = motor_id in reply_ids or motor_id == BROADCAST_ID
        return (COMMAND, motor_id) if frame_id >= EXTENDED and mode <= LAST_MODE and is_ours else (OTHER, 0)


def is_status(frame_id: int, motor_ids: Collection[int]) -> bool:
    """Return whether a frame has the ID of status frames of one of these motors."""
    return frame_id & ~0xFF == EXTENDED | STATUS << 8 and frame_id & 0xFF in motor_ids


def _steps(spec: MotorSpec) -> tuple[float, float, float]:
    """Return the output's rad, rad/s and Nm that one step of a status frame means."""
    return POSITION_STEP, SPEED_STEP / (spec.pole_pairs * spec.gear_ratio), CURRENT_STEP * spec.torque_per_ampere


MIT = MitFormat("mit", FAMILY)
MIT_V3 = V3Format(
    "mit_v3",
    FAMILY,
    replies=False,
    first_id=EXTENDED | MODE_MIT << 8,
    on=(),
    off=((EXTENDED | MODE_CURRENT << 8, NO_CURRENT),),
    zero=(),
    stops=frozenset((NO_CURRENT,)),
    reply_lengths=(_STATUS.size,),
)
AK = Family(FAMILY, MOTORS, {MIT.name: MIT, MIT_V3.name: MIT_V3})


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
    return MIT.pack_reply(spec, MotorReply(motor_id, position, velocity, torque, temperature, error))


def unpack_reply(spec: MotorSpec, data: bytes | bytearray) -> MotorReply:
    """Return the content of a reply. Raises FrameError unless it is 6, 7 or 8 bytes."""
    return MIT.unpack_reply(spec, 0, data)
