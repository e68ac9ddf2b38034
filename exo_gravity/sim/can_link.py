"""The device's end of a CAN bus: commands in, replies out, the echoes of its own replies removed.

udp_multicast returns every frame to its sender, unmarked; most buses do not. A reply is therefore remembered until its
echo arrives. If many replies were sent and no echo ever arrived, the bus does not echo.
"""

from __future__ import annotations

import time
from collections import deque

import can

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.wire_formats import EXTENDED, ID_BITS, Frame

MAX_PENDING_ECHOES = 512  # twice the number of frames that a udp_multicast socket buffers


class CanLink:
    """Receives commands from `bus` and sends replies to it. Raises BusError when the bus fails."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._pending: deque[Frame] = deque()  # echoes that have not arrived
        self._echo_seen = False
        self._no_echo = False

    def receive(self, timeout: float) -> tuple[Frame | None, float]:
        """Return the next frame that is not an echo, or None, and its age in s.

        A remote frame is returned without data.
        """
        try:
            message = self._bus.recv(timeout)
        except can.CanOperationError as error:
            # On udp_multicast a datagram without a CAN frame raises while it is unpacked: that is not a bus failure.
            if error.__cause__ is None or isinstance(error.__cause__, OSError):
                raise BusError(f"receiving on {self._bus.channel_info} failed: {error}") from error
            return None, 0.0
        if message is None or message.is_error_frame or message.is_fd:
            return None, 0.0
        frame = message.arbitration_id | (EXTENDED if message.is_extended_id else 0), bytes(message.data)
        if self._is_echo(frame):
            return None, 0.0
        return frame, max(0.0, time.time() - message.timestamp)

    def send(self, frame: Frame) -> None:
        """Send a reply or a status frame."""
        if not self._no_echo:
            self._pending.append(frame)
            if len(self._pending) > MAX_PENDING_ECHOES:
                self._no_echo = not self._echo_seen
                self._pending.clear()
        frame_id, data = frame
        try:
            self._bus.send(
                can.Message(arbitration_id=frame_id & ID_BITS, data=data, is_extended_id=frame_id >= EXTENDED)
            )
        except can.CanError as error:
            raise BusError(f"sending on {self._bus.channel_info} failed: {error}") from error

    def _is_echo(self, frame: Frame) -> bool:
        if frame not in self._pending:
            return False
        self._pending.remove(frame)
        self._echo_seen = True
        return True
