# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Damiao motors (OpenArm, i2rt's YAM): a record of each type, and their frames in MIT mode, on CAN and CAN FD.

Commands are those of MIT mode (`frames`), with the motor's ID, 1 to 15, as an 11-bit arbitration ID; FF x 7 and FC
switches a motor on, FD off, FE makes its present angle zero and FB clears an error. A motor replies to each, with the
ID that its register MST_ID holds, commonly its own + 0x10 (DM-J4310-2EC manual V1.0; docs of python-damiao-driver):

    state 4 | motor ID 4 | position 16 | velocity 12 | torque 12 | MOSFET degC 8 | coil degC 8

The state is 0 off, 1 on, or an error that has switched the motor off: so a reply says whether the motor is on. An error
stays until FB, and until then FC is ignored. D (communication lost) is one, too: a motor that gets no command for its
TIMEOUT lets go. It is no defect, so ENTER is FB and FC, and D counts as a motor that is off.

Registers are read with the arbitration ID 0x7FF: motor ID 16 | 33 | register 8 | 0 32, little-endian. The answer has
the motor's reply ID and the same first bytes, then the value, a float or an integer. 55 writes one, and CC asks for the
state alone. A joint is never near the position whose code these bytes would be in a reply.

A motor obeys every 11-bit ID with its own lowest 8 bits: bits 8 to 10 name a control mode, and special frames work in
each (read in a disassembled DM-J4310 firmware). So no reply ID may end with another motor's ID.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.motors.frames import (
    COMMAND,
    ELSEWHERE,
    ENTER,
    EXIT,
    EXTENDED,
    MALFORMED,
    OTHER,
    REPLY,
    RPM,
    SETTING,
    Family,
    Frame,
    MotorReply,
    MotorSpec,
    Setting,
    WireFormat,
    byte_of,
    state_of,
    unpack_fields,
)

FAMILY = "damiao"
CLEAR_ERROR = b"\xff" * 7 + b"\xfb"
LAST_ID = 15  # above it, the ID would cover the state
MASTER_OFFSET = 0x10  # of the usual reply ID
OFF, ON, LOST = 0x0, 0x1, 0xD  # states
ERRORS = {
    0x8: "over-voltage",
    0x9: "under-voltage",
    0xA: "over-current",
    0xB: "MOSFET over-temperature",
    0xC: "coil over-temperature",
    0xD: "communication lost: no command came for its time-out",
    0xE: "overload",
}
REGISTERS = 0x7FF  # arbitration ID
READ, WRITE, STORE, REFRESH = 0x33, 0x55, 0xAA, 0xCC  # third byte
MST_ID, TIMEOUT, CTRL_MODE, GEAR, PMAX, VMAX, TMAX = 7, 9, 10, 20, 21, 22, 23
FLOATS = frozenset((GEAR, PMAX, VMAX, TMAX))  # registers that hold a float; the others used here an integer
NAMES: Final = {MST_ID: "MST_ID", TIMEOUT: "TIMEOUT", CTRL_MODE: "CTRL_MODE", PMAX: "PMAX", VMAX: "VMAX", TMAX: "TMAX"}
MIT_MODE = 1  # of CTRL_MODE
TICK = 50e-6  # s, one step of TIMEOUT
SAME = 1e-3  # share by which a register may differ from the file's decimal

# What the motors have in common. The inertia of a rotor is that at its own shaft, times the gear ratio squared.
_motor = partial(
    MotorSpec,
    family=FAMILY,
    output_encoder=True,  # "magnetic, dual"
    can_fd=True,
    shuts_off_at=100.0,  # register OT_Value as recommended
    source="Damiao's table of motors, as Seeed's wiki prints it (Damiao Series, 2025)",
    assumed=frozenset(("shuts_off_at",)),
)

_ALL = (
    _motor(
        name="DM-J3507",
        velocity_range=50.0,
        torque_range=5.0,
        rated_torque=0.8,
        peak_torque=3.0,
        rated_speed=150.0 * RPM,
        no_load_speed=460.0 * RPM,
        gear_ratio=7,
        pole_pairs=14,
        torque_per_ampere=0.5439,
        rotor_inertia=8.7e-6 * 7**2,
        position_range=12.566,
    ),
    _motor(
        name="DM-J4310",
        velocity_range=30.0,
        torque_range=10.0,
        rated_torque=3.0,
        peak_torque=7.0,
        rated_speed=120.0 * RPM,
        no_load_speed=200.0 * RPM,
        gear_ratio=10,
        pole_pairs=14,
        torque_per_ampere=0.945,
        rotor_inertia=1.8e-5 * 10**2,
    ),
    _motor(
        name="DM-J4340",
        velocity_range=8.0,  # other tables have 10 rad/s: the motor's register decides
        torque_range=28.0,
        rated_torque=9.0,
        peak_torque=27.0,
        rated_speed=36.0 * RPM,
        no_load_speed=52.5 * RPM,
        gear_ratio=40,
        pole_pairs=14,
        torque_per_ampere=4.074,
        rotor_inertia=2.0e-5 * 40**2,
        assumed=frozenset(("shuts_off_at", "velocity_range")),
    ),
    _motor(
        name="DM-J6006",
        velocity_range=45.0,
        torque_range=20.0,
        rated_torque=4.0,
        peak_torque=11.0,
        rated_speed=150.0 * RPM,
        no_load_speed=408.0 * RPM,
        gear_ratio=6,
        pole_pairs=14,
        torque_per_ampere=0.7308,
        rotor_inertia=5.8e-5 * 6**2,
        can_fd=False,
    ),
    _motor(
        name="DM-J8006",
        velocity_range=45.0,
        torque_range=40.0,
        rated_torque=8.0,
        peak_torque=20.0,
        rated_speed=120.0 * RPM,
        no_load_speed=392.8 * RPM,
        gear_ratio=6,
        pole_pairs=21,
        torque_per_ampere=1.0206,
        rotor_inertia=1.15e-4 * 6**2,
        can_fd=False,
    ),
    _motor(
        name="DM-J8009",
        velocity_range=45.0,
        torque_range=54.0,
        rated_torque=20.0,
        peak_torque=40.0,
        rated_speed=200.0 * RPM,
        no_load_speed=335.0 * RPM,
        gear_ratio=9,
        pole_pairs=21,
        torque_per_ampere=1.261575,
        rotor_inertia=1.95e-4 * 9**2,
    ),
    _motor(
        name="DM-J10010",
        velocity_range=20.0,
        torque_range=200.0,
        rated_torque=40.0,
        peak_torque=150.0,
        rated_speed=100.0 * RPM,
        no_load_speed=150.0 * RPM,
        gear_ratio=10,
        pole_pairs=21,
        torque_per_ampere=2.59875,
        rotor_inertia=5.5e-4 * 10**2,
    ),
    _motor(
        name="DM-J10010L",
        velocity_range=25.0,
        torque_range=200.0,
        rated_torque=40.0,
        peak_torque=120.0,
        rated_speed=100.0 * RPM,
        no_load_speed=200.0 * RPM,
        gear_ratio=10,
        pole_pairs=21,
        torque_per_ampere=2.00025,
        rotor_inertia=5.56e-4 * 10**2,
    ),
)
MOTORS = {spec.name: spec for spec in _ALL}


@dataclass(frozen=True)
class DamiaoFormat(WireFormat):
    """The frames of Damiao motors in MIT mode; the methods are those of `WireFormat`."""

    def reply_id(self, motor_id: int, master_id: int = 0) -> int:
        """Return the arbitration ID of a motor's replies. Raises ParameterError."""
        reply_id = master_id or motor_id + MASTER_OFFSET
        if reply_id & 0xFF == motor_id or not 0 < reply_id < REGISTERS:
            expected = f"from 1 to {REGISTERS - 1}, without the last two hexadecimal digits of can_id = {motor_id}"
            raise ParameterError("master_id", master_id, expected)
        return reply_id

    def pack_reply(self, spec: MotorSpec, reply: MotorReply, on: bool) -> bytes:
        """Return the data of a reply, whose temperature is that of both parts. Raises ParameterError."""
        state = reply.error or (ON if on else OFF)
        warmth = byte_of("temperature", reply.temperature or 0)
        return bytes((state << 4 | reply.motor_id,)) + state_of(spec, reply) + bytes((warmth, warmth))

    def unpack_reply(self, spec: MotorSpec, motor_id: int, data: bytes | bytearray) -> MotorReply:
        """Return the content of a reply, with the higher temperature. Raises FrameError."""
        if len(data) != 8:
            raise FrameError(data, "a reply of 8 bytes")
        state = data[0] >> 4
        position, velocity, torque = unpack_fields(spec, int.from_bytes(data[1:6], "big"), *MotorReply._fields[1:4])
        error = 0 if state in (OFF, ON) else state
        return MotorReply(data[0] & 0xF, position, velocity, torque, max(data[6], data[7]), error)

    def says_on(self, data: bytes | bytearray) -> bool | None:
        """Return whether the motor is on: in every other state it is off."""
        return data[0] >> 4 == ON

    def error_text(self, error: int) -> str:
        """Return what a state above 1 means."""
        return ERRORS.get(error, "unknown")

    def classify(
        self, frame_id: int, data: bytes | bytearray, reply_ids: Mapping[int, int], is_remote: bool = False
    ) -> tuple[str, int]:
        """Return what a frame is; a reply ID of 0 stands for any.

        Whoever writes a register may change what commands mean: that counts as a command.
        """
        if frame_id >= EXTENDED:
            return OTHER, 0
        if frame_id == REGISTERS:
            is_change = len(data) > 2 and data[2] in (WRITE, STORE) and data[0] in reply_ids
            return (COMMAND, data[0]) if is_change else (OTHER, 0)
        if (own := frame_id & 0xFF) in reply_ids:
            return COMMAND, own
        if is_remote or not data or (own := data[0] & 0xF) not in reply_ids:
            return OTHER, 0
        if len(data) != 8:
            return (MALFORMED, own) if frame_id == reply_ids[own] else (OTHER, 0)
        if reply_ids[own] not in (0, frame_id):
            return ELSEWHERE, own
        if data[0] == own and data[1] == 0 and data[2] in (READ, WRITE, STORE):
            return (SETTING, own) if data[2] == READ else (OTHER, 0)
        return REPLY, own

    def settings(self, spec: MotorSpec, motor_id: int, reply_id: int, timeout: float) -> Sequence[Setting]:
        """Return the registers without whose values a command would mean something else than the file says."""
        rows = (
            (CTRL_MODE, MIT_MODE, "", 1.0),
            (MST_ID, reply_id, "master_id", 1.0),
            (TIMEOUT, timeout / TICK, "motor_timeout", TICK),
            (PMAX, spec.position_range, "position_range", 1.0),
            (VMAX, spec.velocity_range, "velocity_range", 1.0),
            (TMAX, spec.torque_range, "torque_range", 1.0),
        )
        return tuple(
            Setting(NAMES[number], number, read(motor_id, number), value * (1 - SAME), value * (1 + SAME), name, unit)
            for number, value, name, unit in rows
        )

    def unpack_setting(self, data: bytes | bytearray) -> tuple[int, float]:
        """Return the number and the value of a register."""
        (value,) = struct.unpack("<f" if data[3] in FLOATS else "<I", data[4:8])
        return data[3], float(value)

    def questions(self, motor_id: int) -> tuple[Frame, ...]:
        """Return the question for the state, which commands nothing."""
        return ((REGISTERS, bytes((motor_id, 0, REFRESH, 0, 0, 0, 0, 0))),)


def read(motor_id: int, register: int) -> Frame:
    """Return the frame that asks a motor for a register."""
    return REGISTERS, bytes((motor_id, 0, READ, register, 0, 0, 0, 0))


DAMIAO_MIT = DamiaoFormat(
    "mit",
    FAMILY,
    last_id=LAST_ID,
    id_bits=8,
    on=((0, CLEAR_ERROR), (0, ENTER)),
    clear_error=((0, CLEAR_ERROR),),
    stops=frozenset((EXIT, CLEAR_ERROR)),
    needs_timeout=True,
    let_go=frozenset((LOST,)),
)
DAMIAO = Family(FAMILY, MOTORS, {DAMIAO_MIT.name: DAMIAO_MIT})
