"""The AK motors of one arm on one python-can bus, in MIT mode: command all, collect the replies until a deadline.

A motor replies only when commanded, 200-400 us later, with its own ID or the master's (0). Other frames are ignored and
counted by kind: error and remote frames, extended IDs, frames of other devices, and our own commands where the bus
echoes them (udp_multicast does). The first byte of a command is 0x7f, 0x80 or 0xff; that of a reply is the motor's ID,
which `JointMotor` keeps below those. So a command is never taken for a reply.

A zero command precedes ENTER and EXIT: the motor remembers its last command, and ENTER would carry it out.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import can

from exo_gravity.core.arm import JOINT_COUNT
from exo_gravity.core.drive import OFF, Drive
from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.joint_motor import JointMotor
from exo_gravity.core.limits import UNKNOWN, JointSample
from exo_gravity.core.motors import ENTER, EXIT, SET_ZERO

MASTER_ID = 0  # the arbitration ID of some firmwares' replies
MAX_STALE_FRAMES = 256  # frames read before each cycle: the capacity of udp_multicast, more than any cycle produces
EXIT_PERIOD = 0.5  # s between two EXIT frames to motors that are off, in case one was lost


def open_bus(interface: str, channel: str, options: Mapping[str, Any]) -> can.BusABC:
    """Open a python-can bus of any kind. Raises BusError that names the bus and the reason."""
    try:
        return can.Bus(interface=interface, channel=channel, **options)
    except (can.CanError, OSError, TypeError, ValueError) as error:
        raise BusError(f"CAN bus {interface} {channel} {dict(options)} cannot be opened: {error}") from error


class MotorBus:
    """Four motors on one bus. Not thread-safe: one thread owns it.

    powered: whether the motors are already on. note: called with each drive before its frames are sent.
    samples: the newest JointSample of each joint, UNKNOWN before the first reply; times are `time.monotonic`.
    ignored: count of frames that were not replies of these motors, by kind.
    """

    def __init__(
        self,
        bus: can.BusABC,
        motors: Sequence[JointMotor],
        powered: bool = False,
        note: Callable[[Drive], None] = lambda drive: None,
    ) -> None:
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
        """Send every motor its part of `drive`, then collect replies until all arrived or `deadline` (monotonic s).

        Switches the motors on or off when `drive.powered` changes. Returns whether all motors replied in time. Raises
        BusError if the bus fails.
        """
        self._note(drive)
        try:
            self._drain()
            if drive.powered and not self._powered:
                self._send_commands(OFF)
                self._send_all(ENTER)
            self._send_commands(drive)
            if not drive.powered and (self._powered or time.monotonic() - self._exit_sent > EXIT_PERIOD):
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
        """Make the present pose every motor's zero; only while they are off. They are silent for up to 1.5 s."""
        if self._powered:
            raise BusError("set_zero: refused while the motors are on")
        try:
            self._send_commands(OFF)
            self._send_all(SET_ZERO)
        except (can.CanError, OSError) as error:
            raise BusError(f"CAN bus {self._bus.channel_info}: {error}") from error

    def stop(self) -> None:
        """Send the last frames, a zero command and EXIT, twice; then close the bus. Never raises."""
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
        """Read replies that arrived after their cycle, so that they do not count for this one."""
        for _ in range(MAX_STALE_FRAMES):
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
        reply = self._motors[joint].joint_reply(message.data)
        self._answered.add(joint)
        self.samples[joint] = JointSample(*reply[1:], time.monotonic())

    def _foreign(self, message: can.Message) -> str:
        """Return the kind of a frame that is not a reply of our motors, else ''."""
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
