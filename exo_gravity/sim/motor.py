"""AK motors that answer real frames: MIT mode of V1 and V2 boards, and of V3 boards.

What the firmware of V1 and V2 does (CubeMars driver manual V1.0.15; Ben Katz's drive, from which it is derived):
- It replies to commands and never sends anything else.
- Torque flows only between ENTER and EXIT. The last command survives EXIT, and the next ENTER executes it at once.
- SET_ZERO makes the present angle zero. It gets no reply, and the motor ignores frames while it writes its memory.
- A command stays in force until the next one: the motor has no time-out.

What a V3 board does (CubeMars driver manual V3.0.0; frames in core/motors/wire_formats.py):
- A command in MIT mode switches the motor on and stays in force until the next one. A current is a command too; 0 A
  switches the motor off. Other control modes are ignored here.
- It replies to nothing. It sends its state `status_rate` times a second, on or off.

A further wire format needs nothing here: the frames that switch a motor on and off and set its zero, whether it
replies, its commands and its replies all come from its `WireFormat`.
"""

import math
import random
from dataclasses import dataclass, replace

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.motors.joint_motor import MAX_STATUS_RATE, JointMotor
from exo_gravity.core.motors.specs import MotorCommand, MotorReply
from exo_gravity.core.motors.wire_formats import MASTER_ID, Frame, V3Format
from exo_gravity.core.params import owned

_NO_COMMAND = MotorCommand(0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Firmware:
    """Differences between firmwares, except the wire ranges (of `MotorSpec`)."""

    reply_to_master: bool = owned(False, "replies carry ID 0 instead of the motor's own")
    #: 6 without temperature and error.
    reply_length: int = owned(8, "bytes of a reply, 6 or 8", (6, 8))
    zero_silence: float = 1.0  #: s for which the motor ignores frames after SET_ZERO; users report 0.5 to 1.5
    #: Standard deviation of one reply.
    current_noise: float = owned(0.0, "noise of the torque in replies, as a share of it", (0.0, 0.5))
    status_rate: float = MAX_STATUS_RATE  #: status frames per s of a V3 board

    def __post_init__(self) -> None:
        if self.reply_length not in (6, 8):
            raise ParameterError("reply_length", self.reply_length, "6 or 8 bytes")


class SimulatedMotor:
    """One motor on one joint, with a board that speaks the joint's wire format. The faults may be set at any time.

    joint: the true mounting and scale of the motor, from which the controller's parameters may differ.
    """

    def __init__(self, joint: JointMotor, firmware: Firmware | None = None) -> None:
        self.joint = joint
        self.firmware = firmware or Firmware()
        to_master = self.firmware.reply_to_master and joint.wire_format.replies
        #: Arbitration IDs of replies or status frames, and of the frames that the motor obeys.
        self.reply_id = MASTER_ID if to_master else joint.wire_format.reply_id(joint.can_id)
        frames = (*joint.enter, *joint.exit, *joint.set_zero)
        self.received_ids = tuple(dict.fromkeys((joint.command_id, *(frame_id for frame_id, _ in frames))))
        self.unplugged = False  #: a fault: no power, no torque, no replies, and only the zero is remembered
        self.temperature = 30.0  #: degC
        self.error = 0  #: a code of MOTOR_ERRORS, reported only
        self.entered = False  #: the motor is on, after ENTER and before EXIT
        self._command = _NO_COMMAND
        self._data: bytes | None = None  # of the last command
        self._silent_until = -math.inf  # s, after SET_ZERO
        self._random = random.Random(joint.can_id)

    @property
    def damping(self) -> float:
        """Damping in Nm s/rad that the motor applies to the joint."""
        return self._command.kd * self.joint.torque_scale if self.entered else 0.0

    @property
    def steady(self) -> bool:
        """Whether the torque stays constant until the next frame, however the joint moves."""
        return not (self.unplugged or (self.entered and (self._command.kp or self._command.kd)))

    def receive(
        self, data: bytes, position: float, velocity: float, now: float, frame_id: int | None = None
    ) -> bytes | None:
        """Execute the frame `data` and return the bytes of the reply, or None if the motor does not reply.

        position, velocity: of the joint, rad and rad/s. now: simulated time in s, for the silence after SET_ZERO.
        frame_id: arbitration ID, one of `received_ids`; by default that of a command.
        """
        if self.unplugged or now < self._silent_until:
            return None
        joint = self.joint
        frame = joint.command_id if frame_id is None else frame_id, data
        if frame in joint.set_zero:
            self.joint = replace(joint, zero=-joint.direction * position)
            self._silent_until = now + self.firmware.zero_silence
            return None
        if frame in joint.enter:
            self.entered = True
        elif frame in joint.exit:
            self.entered = False
        elif not (self._take_command(data) if frame[0] == joint.command_id else self._take_current(data)):
            return None
        return self._state(position, velocity) if joint.wire_format.replies else None

    def _take_command(self, data: bytes) -> bool:
        """Take a command, which switches the motor on if no other frame does; return whether it is one."""
        joint = self.joint
        if data != self._data:  # an arm at rest gets the same command in every cycle
            try:
                self._command, self._data = joint.wire_format.unpack_command(joint.spec, data), data
            except FrameError:
                return False
        self.entered = self.entered or not joint.enter
        return True

    def _take_current(self, data: bytes) -> bool:
        """Take a current, which a V3 board applies like a command; return whether it is one."""
        joint = self.joint
        if not isinstance(joint.wire_format, V3Format) or len(data) != 4:
            return False
        current = int.from_bytes(data, "big", signed=True) / 1000.0
        torque = current * joint.spec.torque_per_ampere
        self._command, self._data, self.entered = MotorCommand(0.0, 0.0, 0.0, 0.0, torque), None, True
        return True

    def status(self, position: float, velocity: float) -> Frame | None:
        """Return the status frame of a V3 board at `position` rad and `velocity` rad/s; None without power.

        None of other boards, which send nothing by themselves.
        """
        if self.unplugged or self.joint.wire_format.replies:
            return None
        return self.reply_id, self._state(position, velocity)

    def advance(self, position: float, velocity: float, dt: float) -> float:
        """Let `dt` s pass for the motor on a joint at `position` rad and `velocity` rad/s; return its torque in Nm."""
        return self.torque(position, velocity)

    def torque(self, position: float, velocity: float) -> float:
        """Return the torque in Nm on the joint at `position` rad and `velocity` rad/s.

        The motor's kp (p_des - p) + kd (v_des - v) + t_ff, times `torque_scale`, clamped to the peak torque.
        """
        if self.unplugged:
            self.entered, self._command, self._data, self._silent_until = False, _NO_COMMAND, None, -math.inf
        if not self.entered:
            return 0.0
        joint, command = self.joint, self._command
        torque = command.torque + command.kd * (command.velocity - joint.direction * velocity)
        if command.kp:
            torque += command.kp * (command.position - joint.motor_position(position))
        peak = joint.spec.peak_torque
        return joint.direction * clamp(torque * joint.torque_scale, peak)

    def _state(self, position: float, velocity: float) -> bytes:
        """Return the bytes of a reply or status frame, with readings within the ranges of the wire format."""
        joint, spec = self.joint, self.joint.spec
        torque = joint.direction * self.torque(position, velocity) / joint.torque_scale
        if self.firmware.current_noise:
            torque *= self._random.gauss(1.0, self.firmware.current_noise)
        readings = (
            clamp(joint.motor_position(position), spec.position_range),
            clamp(joint.direction * velocity, spec.velocity_range),
            clamp(torque, spec.torque_range),
        )
        temperature, error = round(max(-40.0, min(215.0, self.temperature))), self.error
        is_short = self.firmware.reply_length == 6 and joint.wire_format.replies
        extra = (None, None) if is_short else (temperature, error)
        return joint.wire_format.pack_reply(spec, MotorReply(joint.can_id, *readings, *extra))


def clamp(value: float, limit: float) -> float:
    """Return `value` within -`limit`..`limit`."""
    return value if -limit <= value <= limit else math.copysign(limit, value)
