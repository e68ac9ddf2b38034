"""The AK motors of one arm on one python-can bus, in MIT mode: command all, collect the replies until a deadline.

A motor answers only when commanded, 200-400 us later, with its own ID or the master's (0). What else arrives is told
apart and counted: error and remote frames, extended IDs, frames of other devices, and our own commands where the bus
echoes them (udp_multicast does). A command's first byte is 0x7f, 0x80 or 0xff, a reply's is the motor's ID, and
`JointMotor` keeps IDs below those: a command is never taken for a reply.

Order of the special frames: a command that asks for nothing before ENTER, since the motor remembers its last one
and would act on it; and the same before EXIT.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import can

from exo_gravity.core.arm import JOINT_COUNT
from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.joint_motor import JointMotor
from exo_gravity.core.limits import UNKNOWN, JointSample
from exo_gravity.core.motors import ENTER, EXIT, SET_ZERO
from exo_gravity.core.safety import OFF, Drive

MASTER_ID = 0  # the arbitration ID under which some firmwares answer
DRAIN = 256  # frames looked at before each cycle: what udp_multicast keeps at most, and more than any cycle makes
REPEAT_EXIT = 0.5  # s: a motor that missed its EXIT gets another


def open_bus(interface: str, channel: str, options: Mapping[str, Any]) -> can.BusABC:
    """Open a python-can bus of any kind, or raise BusError that says which and why not."""
    try:
        return can.Bus(interface=interface, channel=channel, **options)
    except (can.CanError, OSError, TypeError, ValueError) as error:
        raise BusError(f"CAN bus {interface} {channel} {dict(options)} can't be opened: {error}") from error


class MotorBus:
    """Four motors on one bus. One thread owns it.

    powered: whether the motors are on already. note: is called with each drive before its frames leave.
    samples: the newest JointSample of each joint, UNKNOWN before the first reply; times are `time.monotonic`.
    ignored: how many frames were no reply of ours, by kind.
    """

    def __init__(
        self,
        bus: can.BusABC,
        motors: Sequence[JointMotor],
        powered: bool = False,
        note: Callable[[Drive], None] = lambda drive: None,
    ):
        ids = [motor.can_id for motor in motors]
        if len(motors) != JOINT_COUNT or len(set(ids)) != JOINT_COUNT:
            raise ParameterError("can_id", ids, "4 different IDs")
        self._bus = bus
        self._motors = tuple(motors)
        self._joint_of = {motor.can_id: joint for joint, motor in enumerate(motors)}
        self._powered = powered
        self._note = note
        self._exit_sent = -float("inf")
        self._answered: set[int] = set()
        self.samples: list[JointSample] = [UNKNOWN] * JOINT_COUNT
        self.ignored: Counter[str] = Counter()

    def exchange(self, drive: Drive, deadline: float) -> bool:
        """Send every motor its share of `drive`, then collect replies until all came or `deadline` (monotonic s).

        Switches the motors on or off where `drive.powered` asks for a change. Returns whether all replied in time.
        Raises BusError if the bus fails.
        """
        self._note(drive)
        try:
            self._drain()
            if drive.powered and not self._powered:
                self._send_commands(OFF)
                self._send_all(ENTER)
            self._send_commands(drive)
            if not drive.powered and (self._powered or time.monotonic() - self._exit_sent > REPEAT_EXIT):
                self._send_all(EXIT)
                self._exit_sent = time.monotonic()
            self._powered = drive.powered
            self._answered.clear()
            while len(self._answered) < JOINT_COUNT:
                remaining = deadline - time.monotonic()
                message = self._bus.recv(max(0.0, remaining))
                if message is not None:
                    self._take(message)
                if remaining <= 0.0:
                    break
        except (can.CanError, OSError) as error:
            raise BusError(f"CAN bus {self._bus.channel_info}: {error}") from error
        return len(self._answered) == JOINT_COUNT

    def set_zero(self) -> None:
        """Make the present pose every motor's zero; only while they are off. They are silent up to 1.5 s afterwards."""
        if self._powered:
            raise BusError("set_zero while the motors are on: switch them off first")
        try:
            self._send_commands(OFF)
            self._send_all(SET_ZERO)
        except (can.CanError, OSError) as error:
            raise BusError(f"CAN bus {self._bus.channel_info}: {error}") from error

    def stop(self) -> None:
        """The last frames: ask for nothing, then EXIT, twice. Never raises; closes the bus."""
        for _ in range(2):
            for motor in self._motors:
                for data in (motor.command(0.0, 0.0), EXIT):
                    try:
                        self._send(motor.can_id, data)
                    except (can.CanError, OSError):
                        self.ignored["unsent"] += 1
        self._note(OFF)
        self._bus.shutdown()

    def _send_commands(self, drive: Drive) -> None:
        for motor, effort in zip(self._motors, drive.effort, strict=True):
            self._send(motor.can_id, motor.command(effort, drive.damping))

    def _send_all(self, data: bytes) -> None:
        for motor in self._motors:
            self._send(motor.can_id, data)

    def _send(self, can_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def _drain(self) -> None:
        """Read what came too late for its cycle, so that it is not taken for an answer to this one."""
        for _ in range(DRAIN):
            message = self._bus.recv(0.0)
            if message is None:
                return
            self._take(message)

    def _take(self, message: can.Message) -> None:
        kind = self._foreign(message)
        if kind:
            self.ignored[kind] += 1
            return
        joint = self._joint_of[message.data[0]]
        _, *reading = self._motors[joint].joint_reply(message.data)
        self._answered.add(joint)
        self.samples[joint] = JointSample(*reading, time.monotonic())

    def _foreign(self, message: can.Message) -> str:
        """Return what kind of frame this is if it is no reply of our motors, else ''."""
        if message.is_error_frame:
            return "error frame"
        if message.is_extended_id or message.is_remote_frame or message.is_fd:
            return "extended, remote or FD frame"
        data = message.data
        if message.arbitration_id in self._joint_of and len(data) == 8 and data[0] in (0x7F, 0x80, 0xFF):
            return "command"
        if len(data) not in (6, 8) or data[0] not in self._joint_of:
            return "foreign frame"
        return "" if message.arbitration_id in (MASTER_ID, data[0]) else "foreign frame"
