# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""AK motors that answer real frames: MIT mode of V1 and V2 boards, and of V3 boards.

What all firmware of V1 and V2 boards does (CubeMars driver manual V1.0.15; Ben Katz's drive, from which it descends):
- It replies to commands, on or off, and never sends anything else.
- Torque flows only between ENTER and EXIT. ENTER carries out the last command at once.
- SET_ZERO makes the present angle zero.

What a V3 board does (CubeMars driver manual V3.0.0; frames in core/motors/ak.py):
- A command in MIT mode switches the motor on and stays in force until the next one. A current is a command too; 0 A
  switches the motor off. Other control modes are ignored here.
- It replies to nothing. It sends its state `status_rate` times a second, on or off.

Where firmwares differ, `Firmware` says what is done. A further wire format needs nothing here: the frames that
switch a motor on and off and set its zero, whether it replies, its commands and its replies all come from its
`WireFormat`.
"""

import math
import random
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.motors.ak import MASTER_ID, MIT, MIT_V3, V3Format
from exo_gravity.core.motors.frames import (
    BROADCAST_ID,
    EXTENDED,
    Frame,
    MotorCommand,
    MotorReply,
    WireFormat,
    unpack_fields,
)
from exo_gravity.core.motors.joint_motor import MAX_STATUS_RATE, JointMotor
from exo_gravity.core.numbers import clamp
from exo_gravity.core.params import check_owned, owned

FIRST_SPECIAL = 0xFC  # last byte of ENTER, the lowest special frame of the manual
BOOT_LOADER, CLEAR_FAULTS, QUERY = 0xFB, 0xF0, 0xEE  # last bytes of special frames of the vendor's image
WARM, SHUT_OFF = 2, 4  # bits of its error byte, which reads 2 and then 6
WARM_ABOVE, SHUT_OFF_AT = 81.0, 120.0  # degC at which it sets them
ENCODER_ERROR = 5  # MOTOR_ERRORS
REPLY_DELAY = (200e-6, 400e-6)  # s, as measured on AK motors
_NO_CONSTANTS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Firmware:
    """One firmware. The defaults are what boards do of which only the frames are known. Raises ParameterError.

    Where the firmware of a family was not run or read, the record holds the worst case, and `assumed` names the field.

    - `ak`: V1 and V2 boards as the manual V1.0.15 describes them and users report them: silent after SET_ZERO, without
      a time-out. What they do with a command while off is not known.
    - `vendor`: the MIT image of a vendor's V1/V2 board (AK40-10), as it behaved in an emulator.
    - `open_drive`: Ben Katz's drive (bgkatz/motorcontrol, `fsm.c` and `can.c`), of which the AK firmware is a
      descendant.
    - `v3`: V3 boards by the manual V3.0.0, with the status rate that our documents ask for.
    - `v3_2`: V3 boards with the image V3.2, as its files ship it.
    - `v3_query`: the same in query-reply mode.
    """

    reply_to_master: bool = owned(False, "replies carry ID 0 instead of the motor's own")
    reply_length: int = 8  #: bytes: 6 without temperature and error, 7 without error
    zero_silence: float = (
        1.0  #: s for which the motor ignores frames after SET_ZERO (users report 0.5 to 1.5); 0: replies
    )
    #: Standard deviation of one reply.
    current_noise: float = owned(0.0, "noise of the torque in replies, as a share of it", (0.0, 0.5))
    status_rate: float = MAX_STATUS_RATE  #: status frames per s of a V3 board
    reply_delay: tuple[float, float] = REPLY_DELAY  #: s from the end of a command to its reply, at least and at most
    name: str = ""  #: the value of `firmware.variant`
    family: str = "ak"  #: of its motors
    wire_format: str = ""  #: the only one that it speaks; "" for any
    remembers_off: bool = True  #: a command while off is kept, and ENTER carries it out; otherwise it is ignored
    exit_clears: bool = False  #: EXIT clears the last command, which ENTER would resume
    zero_kept: bool = True  #: the zero of SET_ZERO survives a power cycle
    zero_while_on: bool = True  #: SET_ZERO is obeyed while the motor is on
    #: s without a command after which the torque and both gains go to 0 at once, until the next; 0: never. The motor
    #: stays on.
    timeout: float = 0.0
    error_is_mask: bool = False  #: bits WARM and SHUT_OFF, set by temperature; otherwise a code of MOTOR_ERRORS
    refuses_encoder_error: bool = True  #: with an encoder error the motor does not go on, and replies as ever
    position_range: float | None = None  #: rad on the wire; None for that of the motor's spec
    first_special: int = FIRST_SPECIAL  #: FF x 7 and this byte, or a higher one below FF, is no command
    id_bits: int = 11  #: of an 11-bit ID that are compared with the motor's
    shortest_command: int = (
        8  #: bytes; what is missing is left over from the frame before. 0: a remote frame is one too
    )
    retransmits: bool = True  #: its CAN controller sends a frame again after an error
    torque_per_ampere: Mapping[str, float] = _NO_CONSTANTS  #: Nm/A by motor; otherwise that of the motor's spec
    obeys_broadcast: bool = False  #: frames to ID 0xFF, V3 boards
    reports: bool = True  #: a V3 board sends its status unasked
    assumed: frozenset[str] = field(default=frozenset())  #: fields that are not known: the worst case

    def __post_init__(self) -> None:
        if self.reply_length not in (6, 7, 8):
            raise ParameterError("reply_length", self.reply_length, "6, 7 or 8 bytes")

    def check(self, wire_format: WireFormat) -> None:
        """Raise ParameterError if boards of `wire_format` never have this firmware."""
        if self.wire_format and not self._is_of(wire_format):
            own = [other.name for other in FIRMWARES.values() if other._is_of(wire_format)]
            expected = f"one of {', '.join(('usual', *own))} for a motor with wire_format = {wire_format.name}"
            raise ParameterError("firmware.variant", self.name, expected)

    def _is_of(self, wire_format: WireFormat) -> bool:
        return (self.family, self.wire_format) == (wire_format.family, wire_format.name)


AK = Firmware(
    name="ak",
    wire_format=MIT.name,
    assumed=frozenset(("remembers_off", "exit_clears", "refuses_encoder_error", "retransmits")),
)
VENDOR = Firmware(
    name="vendor",
    wire_format=MIT.name,
    zero_silence=0.0,
    remembers_off=False,
    zero_kept=False,
    error_is_mask=True,
    position_range=12.56,
    first_special=QUERY,
    shortest_command=0,
    assumed=frozenset(
        ("zero_silence", "zero_while_on", "refuses_encoder_error", "timeout", "shortest_command", "retransmits")
    ),
)
OPEN_DRIVE = Firmware(
    name="open_drive",
    reply_to_master=True,
    reply_length=7,
    reply_delay=(20e-6, 30e-6),
    wire_format=MIT.name,
    zero_silence=0.0,
    exit_clears=True,
    zero_kept=False,
    zero_while_on=False,
    timeout=0.025,
    refuses_encoder_error=False,
    id_bits=7,
    shortest_command=1,
    retransmits=False,
)
_V3_ASSUMED = frozenset(("refuses_encoder_error", "retransmits"))
V3 = Firmware(name="v3", wire_format=MIT_V3.name, assumed=_V3_ASSUMED | {"timeout"})
V3_2 = replace(
    V3,
    name="v3_2",
    timeout=0.1,
    status_rate=50.0,
    torque_per_ampere=MappingProxyType({"AK60-6": 0.2997}),
    obeys_broadcast=True,
    assumed=_V3_ASSUMED,
)
V3_QUERY = replace(V3_2, name="v3_query", reports=False, assumed=_V3_ASSUMED | {"reports"})
FIRMWARES = {firmware.name: firmware for firmware in (AK, VENDOR, OPEN_DRIVE, V3, V3_2, V3_QUERY)}


NO_COMMAND = MotorCommand(0.0, 0.0, 0.0, 0.0, 0.0)
_FULL_LENGTH = 8  # bytes of a command
_BUS_VOLTAGE = round(24.0 / 80.0 * 0xFF)  # the last byte of a reply of 7 bytes, 0 to 80 V


@dataclass(frozen=True)
class Heat:
    """How a motor warms: it nears `ambient` plus `rise` times the square of its torque by the rated one."""

    rise: float = owned(
        0.0, "temperature rise of a motor that gives its rated torque for long; 0: none", (0.0, 200.0), "K"
    )
    time: float = owned(600.0, "time constant with which a motor warms and cools", (1.0, 10000.0), "s")

    def __post_init__(self) -> None:
        check_owned(self)


class SimulatedMotor:
    """One motor on one joint, with a board that speaks the joint's wire format. The faults may be set at any time.

    joint: the true mounting and scale of the motor, from which the controller's parameters may differ.
    firmware: of its board; by default the usual one of the wire format.
    heat: how it warms; by default it does not. Raises ParameterError.
    """

    def __init__(self, joint: JointMotor, firmware: Firmware | None = None, heat: Heat | None = None) -> None:
        self.firmware = firmware = firmware or self.usual_firmware(joint)
        firmware.check(joint.wire_format)
        if firmware.position_range:
            joint = replace(joint, spec=replace(joint.spec, position_range=firmware.position_range))
        self.joint = joint
        to_master = firmware.reply_to_master and joint.wire_format.replies
        #: Arbitration IDs of replies or status frames, and of the frames that the motor obeys.
        self.reply_id = MASTER_ID if to_master else joint.reply_id
        self._own_ids = own_ids(joint, firmware)
        self.received_ids = tuple(self._own_ids)
        self.cable = False  #: a V3 board whose configuration cable is plugged in: it reports, and ignores commands
        self.strength = 1.0  #: share of its torque that the motor still gives; its replies show all of it
        self.ambient = 30.0  #: degC
        self.temperature = self.ambient  #: degC
        self.error = 0  #: the error byte, to which a firmware may add bits of its own
        self.is_reversed = False  #: a fault: its torque turns the joint the other way
        self.speed_factor = 1.0  #: a fault: of the velocity that it reports
        self.entered = False  #: the motor is on, after ENTER and before EXIT
        self.has_left = False  #: its boot loader runs, and it takes no part in the bus until its next power cycle
        self.dips = 0  #: how often its time-out has taken a torque or gains away
        self._heat = heat or Heat()
        self._is_unplugged = False
        self._zero = joint.zero  # rad, after a power cycle
        self._is_shut_off = False  # by temperature, until CLEAR_FAULTS
        self._command = NO_COMMAND
        self._frame = bytes(_FULL_LENGTH)  # the last one that was received
        self._age = 0.0  # s since the last command
        self._silent_until = -math.inf  # s, after SET_ZERO
        self._random = random.Random(joint.can_id)
        constant = firmware.torque_per_ampere.get(joint.spec.name, joint.spec.torque_per_ampere)
        self._reported = replace(joint.spec, torque_per_ampere=constant)

    @staticmethod
    def usual_firmware(joint: JointMotor) -> Firmware:
        """Return the firmware of a motor of which only the wire format is known."""
        return {AK.wire_format: AK, V3.wire_format: V3}.get(joint.wire_format.name, Firmware())

    @property
    def unplugged(self) -> bool:
        """A fault: no power, no torque, no replies. What the board does not store is lost at once."""
        return self._is_unplugged

    @unplugged.setter
    def unplugged(self, is_unplugged: bool) -> None:
        self._is_unplugged = is_unplugged
        if is_unplugged:
            self._forget()

    def _forget(self) -> None:
        """Lose what a board does not store."""
        self.entered, self.has_left, self._is_shut_off = False, False, False
        self._command, self._frame = NO_COMMAND, bytes(_FULL_LENGTH)
        self._silent_until = -math.inf
        if self.joint.zero != self._zero:
            self.joint = replace(self.joint, zero=self._zero)

    @property
    def damping(self) -> float:
        """Damping in Nm s/rad that the motor applies to the joint."""
        kd = self._command.kd if self.entered else 0.0
        return kd * self._scale * self.strength if kd else 0.0

    @property
    def _scale(self) -> float:
        """The torque that it gives at its temperature per commanded torque."""
        return self.joint.scale_at(self.temperature)

    def receive(
        self, data: bytes, position: float, velocity: float, now: float, frame_id: int | None = None
    ) -> bytes | None:
        """Execute the frame `data` and return the bytes of the reply, or None if the motor does not reply.

        position, velocity: of the joint, rad and rad/s. now: simulated time in s, for the silence after SET_ZERO.
        data: of a remote frame, none.
        frame_id: arbitration ID, one of `received_ids`; by default that of a command.
        """
        joint = self.joint
        is_deaf = self.has_left or (self.cable and not joint.wire_format.replies)
        if self.unplugged or is_deaf or now < self._silent_until:
            return None
        own_id = joint.command_id if frame_id is None else self._own_ids[frame_id]
        if own_id == joint.command_id and self.firmware.shortest_command <= len(data) < _FULL_LENGTH:
            data += self._frame[len(data) :]
        if len(data) == _FULL_LENGTH:
            self._frame = data
        frame = own_id, data
        if frame in joint.set_zero:
            if self._set_zero(position, now):
                return None
        elif frame in joint.enter:
            self.entered = self.entered or not self._is_refused
        elif frame in joint.exit:
            self.entered = False
            if self.firmware.exit_clears:
                self._command = NO_COMMAND
        elif joint.enter and data[:-1] == b"\xff" * 7 and self.firmware.first_special <= data[-1] < 0xFF:
            # One that the manual does not name; most of them do nothing that a bus shows.
            if data[-1] == BOOT_LOADER:
                self.has_left, self.entered = True, False
            self._is_shut_off &= data[-1] != CLEAR_FAULTS
        elif not (self._take_command(data) if own_id == joint.command_id else self._take_current(data)):
            return None
        return self._state(position, velocity) if joint.wire_format.replies and not self.has_left else None

    @property
    def _is_refused(self) -> bool:
        """Whether the motor does not go on."""
        is_lost = self.error == ENCODER_ERROR and self.firmware.refuses_encoder_error
        return self._is_shut_off or is_lost

    def _set_zero(self, position: float, now: float) -> bool:
        """Make the present angle zero; return whether the motor is silent about it."""
        joint, firmware = self.joint, self.firmware
        if firmware.zero_while_on or not self.entered:
            self.joint = replace(joint, zero=-joint.direction * position)
            self._zero = self.joint.zero if firmware.zero_kept else self._zero
        self._silent_until = now + firmware.zero_silence
        return firmware.zero_silence > 0.0

    def _take_command(self, data: bytes) -> bool:
        """Take a command, which switches the motor on if no other frame does; return whether it is one."""
        joint = self.joint
        if not self.entered and joint.enter and not self.firmware.remembers_off:
            return len(data) == _FULL_LENGTH
        try:
            self._command = joint.wire_format.unpack_command(joint.spec, data)
        except FrameError:
            if len(data) != _FULL_LENGTH:
                return False
            # We never send it, because it is special on some firmware. This one takes it for a command.
            fields = unpack_fields(joint.spec, int.from_bytes(data, "big"), *MotorCommand._fields)
            self._command = MotorCommand(*fields)
        self._age = 0.0
        self.entered = self.entered or not (joint.enter or self._is_refused)
        return True

    def _take_current(self, data: bytes) -> bool:
        """Take a current, which a V3 board applies like a command; return whether it is one."""
        joint = self.joint
        if not isinstance(joint.wire_format, V3Format) or len(data) != 4:
            return False
        current = int.from_bytes(data, "big", signed=True) / 1000.0
        torque = current * joint.spec.torque_per_ampere
        self._command, self._age = MotorCommand(0.0, 0.0, 0.0, 0.0, torque), 0.0
        self.entered = not self._is_refused
        return True

    def status(self, position: float, velocity: float) -> Frame | None:
        """Return the status frame of a V3 board at `position` rad and `velocity` rad/s; None without power.

        None of other boards, and of those in query-reply mode: they send nothing by themselves.
        """
        if self.unplugged or self.joint.wire_format.replies or not self.firmware.reports:
            return None
        return self.reply_id, self._state(position, velocity)

    def advance(self, position: float, velocity: float, dt: float) -> float:
        """Let `dt` s pass for the motor on a joint at `position` rad and `velocity` rad/s; return its torque in Nm."""
        self._age += dt
        self._watch(0.0 < self.firmware.timeout < self._age)
        torque = self.torque(position, velocity)
        if self._heat.rise:
            goal = self.ambient + self._heat.rise * (torque / self.joint.spec.rated_torque) ** 2
            self.temperature += (self.temperature - goal) * math.expm1(-dt / self._heat.time)
        return -torque if self.is_reversed else torque

    def _watch(self, is_lost: bool) -> None:
        """Do what the firmware does by itself; is_lost: whether it has had no command for its time-out."""
        if is_lost and self.entered and self._command != NO_COMMAND:
            self._command = NO_COMMAND
            self.dips += 1
        if self.firmware.error_is_mask and self.temperature >= SHUT_OFF_AT:
            self.entered, self._is_shut_off = False, True

    def torque(self, position: float, velocity: float) -> float:
        """Return the torque in Nm on the joint at `position` rad and `velocity` rad/s.

        The motor's kp (p_des - p) + kd (v_des - v) + t_ff, clamped to the peak torque, as its board limits the current,
        times `torque_scale` and `strength`.
        """
        if self._is_unplugged:
            self._forget()  # also what another thread was just changing when the power went
        if not self.entered:
            return 0.0
        joint, command = self.joint, self._command
        torque = command.torque + command.kd * (command.velocity - joint.direction * velocity)
        if command.kp:
            torque += command.kp * (command.position - joint.motor_position(position))
        return joint.direction * clamp(torque, joint.spec.peak_torque) * self._scale * self.strength

    def damps_at_once(self, torque: float) -> bool:
        """Return whether its `torque` in Nm follows the joint's velocity without delay: not at its peak."""
        return not self.is_reversed and abs(torque) < self.joint.spec.peak_torque * self._scale * self.strength

    def _state(self, position: float, velocity: float) -> bytes:
        """Return the bytes of a reply or status frame, with readings within the ranges of the wire format."""
        joint, readings = self.joint, self._readings(position, velocity)
        temperature = round(max(-40.0, min(215.0, self.temperature)))
        length = self.firmware.reply_length if joint.wire_format.replies else _FULL_LENGTH
        is_masked = self.firmware.error_is_mask  # else it is a code, and the motor has not shut off by itself
        error = self.error | WARM * (is_masked and self.temperature > WARM_ABOVE) | SHUT_OFF * self._is_shut_off
        extra = (temperature, error) if length == _FULL_LENGTH else (None, None)
        reply = joint.wire_format.pack_reply(self._reported, MotorReply(joint.can_id, *readings, *extra), self.entered)
        return reply + bytes((_BUS_VOLTAGE,)) if length == _FULL_LENGTH - 1 else reply

    def _readings(self, position: float, velocity: float) -> tuple[float, float, float]:
        """Return angle, velocity and torque of the motor in rad, rad/s and Nm, within the ranges of the wire format."""
        joint, spec, velocity = self.joint, self.joint.spec, self.speed_factor * velocity
        torque = joint.direction * self.torque(position, velocity) / (self._scale * self.strength)
        if self.firmware.current_noise:
            torque *= self._random.gauss(1.0, self.firmware.current_noise)
        return (
            clamp(joint.motor_position(position), spec.position_range),
            clamp(joint.direction * velocity, spec.velocity_range),
            clamp(torque, spec.torque_range),
        )


def own_ids(joint: JointMotor, firmware: Firmware) -> dict[int, int]:
    """Return the arbitration IDs that a motor obeys, each with the ID of its own that it stands for."""
    own = dict.fromkeys(
        frame_id for frame_id, _ in ((joint.command_id, b""), *joint.enter, *joint.exit, *joint.set_zero)
    )
    ids = {frame_id: frame_id for frame_id in own}
    for frame_id in own:
        if frame_id < EXTENDED:
            others = range(frame_id & (1 << firmware.id_bits) - 1, 1 << 11, 1 << firmware.id_bits)
            ids |= {other: frame_id for other in others if other not in own}
        elif firmware.obeys_broadcast:
            ids[frame_id & ~0xFF | BROADCAST_ID] = frame_id
    return ids
