"""A simulated I2C bus with the interface of `smbus2.SMBus`, and the time in which its devices live."""

from __future__ import annotations

import errno
from typing import Protocol


class FakeTime:
    """A clock that only `wait` moves."""

    def __init__(self) -> None:
        self.now = 1000.0  # s

    def __call__(self) -> float:
        return self.now

    def wait(self, duration: float) -> None:
        """Let `duration` s pass."""
        self.now += duration


class Device(Protocol):
    """A device on the bus."""

    def read(self, register: int, length: int) -> list[int]:
        """Return what the device sends when `length` bytes are read from `register` on."""

    def write(self, register: int, value: int) -> None:
        """Take one byte for `register`."""


class FakeBus:
    """The bus of one host. An address without a device, or with one that is unplugged, is not acknowledged."""

    def __init__(self, device: Device | None, address: int) -> None:
        self.plugged = True
        self.disturbed = 0  # transfers to come that are not acknowledged
        self.closed = False
        self.longest = 0  # bytes of a read
        self._device = device
        self.address = address

    def read_byte_data(self, i2c_addr: int, register: int) -> int:
        """Return one register."""
        return self._addressed(i2c_addr).read(register, 1)[0]

    def write_byte_data(self, i2c_addr: int, register: int, value: int) -> None:
        """Write one register."""
        self._addressed(i2c_addr).write(register, value)

    def read_i2c_block_data(self, i2c_addr: int, register: int, length: int) -> list[int]:
        """Return `length` bytes, at most 32 as in SMBus."""
        if not 0 < length <= 32:
            raise ValueError("Desired block length over 32 bytes")
        self.longest = max(self.longest, length)
        return self._addressed(i2c_addr).read(register, length)

    def close(self) -> None:
        """Close the bus."""
        self.closed = True

    def _addressed(self, address: int) -> Device:
        if self.closed:
            raise OSError(errno.EBADF, "Bad file descriptor")
        self.disturbed = max(self.disturbed - 1, -1)
        if self.disturbed >= 0 or not self.plugged or self._device is None or address != self.address:
            raise OSError(errno.EREMOTEIO, "Remote I/O error")  # errno 121
        return self._device
