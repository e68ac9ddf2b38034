"""Tells the echoes of our own frames from the same frames of another sender.

Most buses do not return a frame to its sender. udp_multicast returns each one, unmarked, in order. Others mark them
(`is_rx` is false). The first frames show which kind of bus it is.
"""

from __future__ import annotations

from collections import deque

TRIAL = 32  # frames sent until it is known whether the bus echoes
MOST_AWAITED = 512  # twice the frames that a udp_multicast socket keeps unread

Frame = tuple[int, bytes]


class Echoes:
    """Frames that were sent and whose echoes have not come back yet."""

    def __init__(self) -> None:
        self._awaited: deque[Frame] = deque(maxlen=MOST_AWAITED)
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

    def take(self, can_id: int, data: bytes) -> bool:
        """Return whether this frame is the echo of one that was sent, and stop awaiting it."""
        if self._is_echoing is False or (can_id, data) not in self._awaited:
            return False
        while self._awaited.popleft() != (can_id, data):
            pass  # echoes come in order, so those before it are lost
        self._returned += 1
        return True

    def forget(self) -> None:
        """Stop awaiting echoes, because the bus was closed."""
        self._awaited.clear()
