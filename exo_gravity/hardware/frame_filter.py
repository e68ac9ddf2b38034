"""Sorts the frames on a bus: replies of our motors, echoes of our own frames, commands of another sender, the rest.

Most buses do not return a frame to its sender. Some return it and mark it (`is_rx` is false). udp_multicast returns it
unmarked, in order. The first frames show whether a bus echoes.

SocketCAN sets the same mark on every frame from this computer, also on those of another process
(Documentation/networking/can.rst of Linux, MSG_DONTROUTE). There it does not show an echo.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

import can

REPLY, FOREIGN_COMMAND = "reply", "foreign command"
MASTER_ID = 0  # the arbitration ID of some firmwares' replies
TRIAL = 32  # frames sent until it is known whether the bus echoes
MOST_AWAITED = 512  # twice the frames that a udp_multicast socket keeps unread

Frame = tuple[int, bytes]


class FrameFilter:
    """Knows the CAN IDs `motor_ids` and which frames were sent. marks_echoes: whether `is_rx` is false for echoes only."""

    def __init__(self, motor_ids: Collection[int], marks_echoes: bool = True) -> None:
        self._motor_ids = frozenset(motor_ids)
        self._marks_echoes = marks_echoes
        self._awaited: deque[Frame] = deque(maxlen=MOST_AWAITED)  # sent, their echoes not yet received
        self._sent = self._returned = 0
        self._is_echoing: bool | None = None  # None: not yet known

    def sent(self, can_id: int, data: bytes) -> None:
        """Note a frame that is being sent."""
        if self._is_echoing is False:
            return
        if self._is_echoing is None and self._sent >= TRIAL:
            self._is_echoing = self._returned >= TRIAL // 2
        self._sent += 1
        self._awaited.append((can_id, data))

    def kind(self, message: can.Message) -> str:
        """Return REPLY, FOREIGN_COMMAND, or the kind of a frame that does not matter."""
        if message.is_error_frame:
            return "error frame"
        if message.is_extended_id or message.is_remote_frame or message.is_fd:
            return "extended, remote or FD frame"
        can_id, data = message.arbitration_id, bytes(message.data)
        if len(data) == 8 and can_id in self._motor_ids and data[0] != can_id:
            is_marked = self._marks_echoes and not message.is_rx
            return "echo" if is_marked or self._is_echo(can_id, data) else FOREIGN_COMMAND
        is_reply = len(data) in (6, 8) and data[0] in self._motor_ids and can_id in (MASTER_ID, data[0])
        return REPLY if is_reply else "foreign frame"

    def _is_echo(self, can_id: int, data: bytes) -> bool:
        if self._is_echoing is False or (can_id, data) not in self._awaited:
            return False
        while self._awaited.popleft() != (can_id, data):
            pass  # echoes come in order, so those before it are lost
        self._returned += 1
        return True
