"""Sorts the frames on a bus: replies of our motors, echoes of our own frames, commands of another sender, the rest.

Most buses do not return a frame to its sender. Some return it and mark it (`is_rx` is false). udp_multicast returns it
unmarked, in order. The first frames show whether a bus echoes.

SocketCAN sets the same mark on every frame from this computer, also on those of another process
(Documentation/networking/can.rst of Linux, MSG_DONTROUTE). There it does not show an echo.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import can

from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.wire_formats import COMMAND, EXTENDED, REPLY, Frame, WireFormat

FOREIGN_COMMAND = "foreign command"
TRIAL = 32  # frames sent until it is known whether the bus echoes
MOST_AWAITED = 512  # twice the frames that a udp_multicast socket keeps unread

Group = tuple[WireFormat, frozenset[int]]  # the motors of one format


class FrameFilter:
    """Knows `motors` and which frames were sent. marks_echoes: whether `is_rx` is false for echoes only."""

    def __init__(self, motors: Sequence[JointMotor], marks_echoes: bool = True) -> None:
        self._standard = _groups(motors, is_extended=False)
        self._extended = _groups(motors, is_extended=True)
        self._marks_echoes = marks_echoes
        self._awaited: deque[Frame] = deque(maxlen=MOST_AWAITED)  # sent, their echoes not yet received
        self._sent = self._returned = 0
        self._is_echoing: bool | None = None  # None: not yet known

    def sent(self, frame: Frame) -> None:
        """Note a frame that is being sent."""
        if self._is_echoing is False:
            return
        if self._is_echoing is None and self._sent >= TRIAL:
            self._is_echoing = self._returned >= TRIAL // 2
        self._sent += 1
        self._awaited.append(frame)

    def sort(self, message: can.Message) -> tuple[str, int]:
        """Return REPLY or FOREIGN_COMMAND with the motor's ID, or the kind of a frame that does not matter with 0."""
        if message.is_error_frame:
            return "error frame", 0
        is_extended = message.is_extended_id
        groups = self._extended if is_extended else self._standard
        if message.is_remote_frame or message.is_fd or (is_extended and not groups):
            return "extended, remote or FD frame", 0
        frame_id = message.arbitration_id | EXTENDED if is_extended else message.arbitration_id
        for wire_format, motor_ids in groups:
            kind, motor_id = wire_format.classify(frame_id, message.data, motor_ids)
            if kind == REPLY:
                return kind, motor_id
            if kind == COMMAND:
                is_echo = (self._marks_echoes and not message.is_rx) or self._is_echo((frame_id, bytes(message.data)))
                return ("echo", 0) if is_echo else (FOREIGN_COMMAND, motor_id)
        return "foreign frame", 0

    def _is_echo(self, frame: Frame) -> bool:
        if self._is_echoing is False or frame not in self._awaited:
            return False
        while self._awaited.popleft() != frame:
            pass  # echoes come in order, so those before it are lost
        self._returned += 1
        return True


def _groups(motors: Sequence[JointMotor], is_extended: bool) -> tuple[Group, ...]:
    formats = {motor.wire_format for motor in motors if motor.wire_format.is_extended is is_extended}
    return tuple((each, frozenset(m.can_id for m in motors if m.wire_format == each)) for each in formats)
