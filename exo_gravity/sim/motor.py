"""An AK motor that answers real frames: MIT mode of V1 and V2 boards, as `core.motors` lays it out.

What the firmware does (CubeMars driver manual V1.0.15; Ben Katz's drive, from which it stems): it answers only when
commanded. Torque flows between ENTER and EXIT alone, but the last command is kept all the while: the next ENTER
carries it out at once. SET_ZERO makes the present angle zero, is not answered, and leaves the motor deaf while it
writes its memory. A command stays in force until the next: the motor has no time-out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from exo_gravity.core.arm import one_float
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.joint_motor import JointMotor
from exo_gravity.core.motors import ENTER, EXIT, SET_ZERO, MotorCommand, pack_reply, unpack_command

MASTER_ID = 0


@dataclass(frozen=True)
class Firmware:
    """What differs between firmwares, besides the wire ranges (`MotorSpec.with_ranges`).

    reply_to_master: replies carry the master's ID, 0, instead of the motor's own. reply_length: 8 bytes, or 6 without
    temperature and error. zero_silence: s during which the motor is deaf after SET_ZERO; 0.5 to 1.5 is reported.
    """

    reply_to_master: bool = False
    reply_length: int = 8
    zero_silence: float = 1.0

    def __post_init__(self):
        if self.reply_length not in (6, 8):
            raise ParameterError("reply_length", self.reply_length, "6 or 8 bytes")
        one_float("zero_silence", self.zero_silence, 0.0, 10.0, "s")


class SimulatedMotor:
    """One motor on one joint.

    joint: how it truly sits there and what it truly gives; whoever commands it may believe otherwise.

    To be set live: `unplugged` (no power: no torque, no answer, and all forgotten but its zero), `temperature` (degC)
    and `error` (a code of MOTOR_ERRORS; reported, with no effect on the torque).
    """

    def __init__(self, joint: JointMotor, firmware: Firmware | None = None):
        self.joint = joint
        self.firmware = firmware or Firmware()
        self.unplugged = False
        self.temperature = 30.0
        self.error = 0
        self._switch_on()

    @property
    def reply_id(self) -> int:
        """Arbitration ID of the replies."""
        return MASTER_ID if self.firmware.reply_to_master else self.joint.can_id

    @property
    def entered(self) -> bool:
        """Whether the motor is on: after ENTER, before EXIT."""
        return self._entered

    @property
    def steady(self) -> bool:
        """Whether the torque stays what it is until the next frame, however the joint moves."""
        return not (self.unplugged or (self._entered and (self._command.kp or self._command.kd)))

    def receive(self, data: bytes, position: float, velocity: float, now: float) -> bytes | None:
        """Carry out the frame `data` and return the reply's bytes, or None if the motor keeps silent.

        position, velocity: the joint's, rad and rad/s. now: s of simulated time, for the silence after SET_ZERO.
        """
        if self.unplugged or now < self._deaf_until or len(data) != 8:
            return None
        if data == SET_ZERO:
            self.joint = replace(self.joint, zero=-self.joint.direction * position)
            self._deaf_until = now + self.firmware.zero_silence
            return None
        if data == ENTER:
            self._entered = True
        elif data == EXIT:
            self._entered = False
        elif data != self._data:  # an arm at rest is told the same again and again
            self._command, self._data = unpack_command(self.joint.spec, data), data
        return self._reply(position, velocity)

    def torque(self, position: float, velocity: float) -> float:
        """Return the torque in Nm on the joint at `position` rad and `velocity` rad/s.

        kp (p_des - p) + kd (v_des - v) + t_ff in the motor's own Nm, of which the joint gets `torque_scale` times as
        much, at most the peak torque.
        """
        if self.unplugged:
            self._switch_on()
        if not self._entered:
            return 0.0
        joint, command = self.joint, self._command
        asked = command.torque + command.kd * (command.velocity - joint.direction * velocity)
        if command.kp:
            asked += command.kp * (command.position - joint.motor_position(position))
        peak = joint.spec.peak_torque
        return joint.direction * _within(asked * joint.torque_scale, peak)

    def _reply(self, position: float, velocity: float) -> bytes:
        joint, spec = self.joint, self.joint.spec
        values = (
            _within(joint.motor_position(position), spec.position_range),
            _within(joint.direction * velocity, spec.velocity_range),
            _within(joint.direction * self.torque(position, velocity) / joint.torque_scale, spec.torque_range),
        )
        if self.firmware.reply_length == 6:
            return pack_reply(spec, joint.can_id, *values)
        temperature = round(max(-40.0, min(215.0, self.temperature)))
        return pack_reply(spec, joint.can_id, *values, temperature, self.error)

    def _switch_on(self) -> None:
        self._entered = False
        self._command, self._data = MotorCommand(0.0, 0.0, 0.0, 0.0, 0.0), b""
        self._deaf_until = -math.inf


def _within(value: float, limit: float) -> float:
    return value if -limit <= value <= limit else math.copysign(limit, value)
