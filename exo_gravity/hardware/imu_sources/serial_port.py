"""A serial port through `pyserial`, and packets of a fixed length cut out of its bytes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from exo_gravity.core.errors import DeviceError, ParameterError


class SerialPort:
    """An open port that is read without waiting."""

    def __init__(self, device: str, port: str, baud: int) -> None:
        """Open `port`. Raises DeviceError, and ParameterError without pyserial."""
        self.name = f"{device} on {port}"
        try:
            import serial
        except ImportError:
            expected = "topic, or install the extra imu (pyserial)"
            raise ParameterError("source", "an IMU on a serial port", expected) from None
        try:
            self._port = serial.Serial(port, baud, timeout=0, write_timeout=0.2)
        except (OSError, ValueError) as error:  # pyserial's own errors are OSErrors
            raise DeviceError(self.name, f"cannot be opened: {error}") from None

    def read(self) -> bytes:
        """Return the bytes that have arrived."""
        try:
            return bytes(self._port.read(self._port.in_waiting))
        except OSError as error:
            raise DeviceError(self.name, f"cannot be read: {error}") from None

    def write(self, data: bytes) -> None:
        """Send `data`."""
        try:
            self._port.write(data)
        except OSError as error:
            raise DeviceError(self.name, f"cannot be written: {error}") from None

    def close(self) -> None:
        """Close the port."""
        with contextlib.suppress(OSError):
            self._port.close()


class Packets:
    """Cuts packets of one length out of a stream of bytes, and finds their start again after lost or extra bytes.

    damaged: times that packets that had arrived well were followed by one that had not.
    """

    def __init__(self, header: bytes, length: int, is_whole: Callable[[bytes], bool]) -> None:
        self.damaged = 0
        self._header = header
        self._length = length
        self._is_whole = is_whole
        self._pending = bytearray()
        self._in_step = False

    def feed(self, data: bytes) -> list[bytes]:
        """Return the whole packets that `data` completes."""
        self._pending += data
        packets, at = [], 0
        while len(self._pending) - at >= self._length:
            packet = bytes(self._pending[at : at + self._length])
            if packet.startswith(self._header) and self._is_whole(packet):
                packets.append(packet)
                at += self._length
                self._in_step = True
                continue
            self.damaged += self._in_step
            self._in_step = False
            at += 1
        del self._pending[:at]
        return packets
