# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Sensors on a pseudo-terminal, and the packets that they send."""

from __future__ import annotations

import fcntl
import os
import select
import struct
import termios
import time
import tty
from pathlib import Path


class FakeSerialSensor:
    """The device's end of a serial line. `port` stays the same path when the sensor is plugged in again."""

    def __init__(self, port: Path) -> None:
        self.port = port
        self._ours: int | None = None
        self._theirs: int | None = None
        self.plug()

    def plug(self) -> None:
        """Appear as `port`."""
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        self.port.unlink(missing_ok=True)
        self.port.symlink_to(os.ttyname(self._theirs))

    def unplug(self) -> None:
        """Vanish."""
        if self._ours is not None and self._theirs is not None:
            os.close(self._ours)
            os.close(self._theirs)
            self._ours = self._theirs = None
        self.port.unlink(missing_ok=True)

    def send(self, data: bytes) -> None:
        """Send bytes to the host."""
        assert self._ours is not None
        os.write(self._ours, data)

    def deliver(self, data: bytes) -> None:
        """Send bytes and return when they have arrived, which the kernel delays. No other thread may read meanwhile."""
        assert self._theirs is not None
        expected = self._waiting() + len(data)
        self.send(data)
        end = time.monotonic() + 20.0
        while self._waiting() < expected:
            assert time.monotonic() < end, f"{self._waiting()} of {expected} bytes"
            time.sleep(1e-4)

    def _waiting(self) -> int:
        assert self._theirs is not None
        (count,) = struct.unpack("i", fcntl.ioctl(self._theirs, termios.FIONREAD, bytes(4)))
        return int(count)

    def received(self) -> bytes:
        """Return what the host has sent."""
        assert self._ours is not None
        ready, _, _ = select.select([self._ours], [], [], 1.0)
        return os.read(self._ours, 1000) if ready else b""


def witmotion_packet(kind: int, *numbers: int) -> bytes:
    """Return 0x55, the type, four 16-bit numbers (low byte first), and the sum of all bytes before."""
    data = bytes((0x55, kind)) + struct.pack("<4h", *numbers)
    return data + bytes((sum(data) & 0xFF,))


def rvc_packet(counter: int, angles: tuple[float, float, float], acceleration: tuple[int, int, int]) -> bytes:
    """Return a BNO085's packet: yaw, pitch, roll in degrees; acceleration in mg."""
    numbers = [round(100 * angle) for angle in angles]
    data = bytes((counter & 0xFF,)) + struct.pack("<6h", *numbers, *acceleration) + bytes(3)
    return b"\xaa\xaa" + data + bytes((sum(data) & 0xFF,))
