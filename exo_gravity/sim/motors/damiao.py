# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Damiao motors that answer real frames in MIT mode, as their firmware does.

Frames and registers: core/motors/damiao.py. What the firmware does was read in a disassembled DM-J4310 firmware whose
source is public (umeow0716/damiao_firmware); no motor was met:

- Every 11-bit ID with the motor's lowest 8 bits reaches it, is answered at once, and restarts its time-out. Bits 8 to
  10 name a control mode; a command for another mode than the set one changes nothing. Special frames work in each.
- ENTER is obeyed unless an error is latched. A command while off is kept, and ENTER carries it out.
- EXIT, CLEAR_ERROR and every error switch the motor off and clear its command. CLEAR_ERROR clears the error as well,
  which comes back if its cause stays.
- Without a frame for TIMEOUT while on, the motor lets go, and reports LOST until CLEAR_ERROR.
- SET_ZERO is obeyed at once, on or off, and kept.
- Registers are answered on or off; a written one counts at once, until a power cycle unless it is stored.
"""

import struct
from contextlib import suppress
from dataclasses import replace
from typing import Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.damiao import (
    CLEAR_ERROR,
    CTRL_MODE,
    DAMIAO_MIT,
    FLOATS,
    GEAR,
    LOST,
    MIT_MODE,
    MST_ID,
    PMAX,
    READ,
    REFRESH,
    REGISTERS,
    STORE,
    TICK,
    TIMEOUT,
    TMAX,
    VMAX,
    WRITE,
)
from exo_gravity.core.motors.frames import ENTER, EXIT, SET_ZERO, MotorCommand, MotorReply, unpack_fields
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.sim.motors.ak import NO_COMMAND, Firmware, Heat, SimulatedMotor

COIL_OVER_TEMPERATURE = 0xC
DAMIAO = Firmware(
    name="damiao",
    family=DAMIAO_MIT.family,
    wire_format=DAMIAO_MIT.name,
    zero_silence=0.0,
    exit_clears=True,
    id_bits=8,
    reply_delay=(30e-6, 100e-6),
    assumed=frozenset(("reply_delay", "retransmits")),
)


class DamiaoMotor(SimulatedMotor):
    """One Damiao motor on one joint; arguments and faults as those of `SimulatedMotor`.

    `error` is the cause of an error: a state of core/motors/damiao.py above 1, 0 for none.

    latched: the error that has switched the motor off, 0 for none.
    mode: the control mode that its board is set to.
    """

    def __init__(self, joint: JointMotor, firmware: Firmware | None = None, heat: Heat | None = None) -> None:
        super().__init__(joint, firmware or self.usual_firmware(joint), heat)
        self.latched = 0
        self.mode = MIT_MODE
        self.received_ids = (*self.received_ids, REGISTERS)
        self._stored = joint.spec, self.firmware, self.mode

    @staticmethod
    def usual_firmware(joint: JointMotor) -> Firmware:
        """Return the firmware of a motor whose time-out is set as the file says."""
        return replace(DAMIAO, timeout=joint.timeout)

    def receive(
        self, data: bytes, position: float, velocity: float, now: float, frame_id: int | None = None
    ) -> bytes | None:
        """Execute the frame `data`, and return the bytes of the reply, or None; see `SimulatedMotor`."""
        frame_id = self.joint.command_id if frame_id is None else frame_id
        if self.unplugged or len(data) != 8:
            return None
        if frame_id == REGISTERS:
            is_mine = int.from_bytes(data[:2], "little") == self.joint.can_id
            return self._take_register(data, position, velocity) if is_mine else None
        self._age = 0.0
        if data == ENTER:
            self.entered = self.entered or not (self.latched or self.error)
        elif data in (EXIT, CLEAR_ERROR):
            self.latched = 0 if data == CLEAR_ERROR else self.latched
            self._let_go()
        elif data == SET_ZERO:
            self._set_zero(position, now)
        elif frame_id == self.joint.command_id and self.mode == MIT_MODE:
            fields = unpack_fields(self.joint.spec, int.from_bytes(data, "big"), *MotorCommand._fields)
            self._command = MotorCommand(*fields)
        return self._state(position, velocity)

    def _watch(self, is_lost: bool) -> None:
        self.dips += self.entered and is_lost
        error = self.error or COIL_OVER_TEMPERATURE * (self.temperature > self.joint.spec.shuts_off_at)
        error = error or LOST * (self.entered and is_lost)
        if error:
            self.latched = error
            self._let_go()

    def _let_go(self) -> None:
        self.entered = False
        self._command = NO_COMMAND

    def _forget(self) -> None:
        super()._forget()
        self.latched = 0
        spec, self.firmware, self.mode = self._stored
        self.joint = replace(self.joint, spec=spec)

    def _take_register(self, data: bytes, position: float, velocity: float) -> bytes | None:
        """Answer a question, write a register, or store them all."""
        operation, number = data[2], data[3]
        if operation == REFRESH:
            return self._state(position, velocity) if number == 0 else None
        if operation == STORE:
            self._stored = self.joint.spec, self.firmware, self.mode
            return data
        if operation == WRITE:
            (value,) = struct.unpack("<f" if number in FLOATS else "<I", data[4:])
            with suppress(ParameterError):  # a range that no motor can have changes nothing
                self.write(number, value)
        elif operation != READ:
            return None
        value = self._registers.get(number)
        if value is None:
            return None
        return data[:4] + (struct.pack("<f", value) if number in FLOATS else struct.pack("<I", round(value)))

    def write(self, number: int, value: float) -> None:
        """Set a register until the next power cycle; only those whose value changes what the motor does."""
        fields = {PMAX: "position_range", VMAX: "velocity_range", TMAX: "torque_range"}
        if number in fields:
            changed: dict[str, Any] = {fields[number]: value}
            self.joint = replace(self.joint, spec=replace(self.joint.spec, **changed))
        elif number == TIMEOUT:
            self.firmware = replace(self.firmware, timeout=value * TICK)
        elif number == CTRL_MODE:
            self.mode = round(value)

    @property
    def _registers(self) -> dict[int, float]:
        spec = self.joint.spec
        return {
            MST_ID: self.reply_id,
            TIMEOUT: self.firmware.timeout / TICK,
            CTRL_MODE: self.mode,
            GEAR: spec.gear_ratio,
            PMAX: spec.position_range,
            VMAX: spec.velocity_range,
            TMAX: spec.torque_range,
        }

    def _state(self, position: float, velocity: float) -> bytes:
        """Return the bytes of a reply, with readings within the ranges of the wire format."""
        joint = self.joint
        temperature = round(max(0.0, min(255.0, self.temperature)))
        readings = self._readings(position, velocity)
        reply = MotorReply(joint.can_id, *readings, temperature, self.error or self.latched)
        return joint.wire_format.pack_reply(joint.spec, reply, self.entered)
