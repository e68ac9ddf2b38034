"""Registers of a device on an I2C bus, through `smbus2`. Every failure names the device, its address and the register.

A read is at most 32 bytes long, which is what SMBus allows, so that adapters that speak only SMBus work too.
"""

from __future__ import annotations

import contextlib
from typing import Protocol

from exo_gravity.core.errors import DeviceError, ParameterError

MAX_BLOCK = 32  # bytes


class Bus(Protocol):
    """The part of `smbus2.SMBus` that is used."""

    def read_byte_data(self, i2c_addr: int, register: int) -> int:
        """Return the value of one register."""

    def write_byte_data(self, i2c_addr: int, register: int, value: int) -> None:
        """Write one register."""

    def read_i2c_block_data(self, i2c_addr: int, register: int, length: int) -> list[int]:
        """Return `length` bytes from `register` on."""

    def close(self) -> None:
        """Close the bus."""


def open_bus(number: int) -> Bus:
    """Return the bus /dev/i2c-`number`. Raises DeviceError, and ParameterError without smbus2."""
    try:
        import smbus2
    except ImportError:
        raise ParameterError("source", "an IMU on I2C", "topic, or install the extra imu (smbus2)") from None
    try:
        bus: Bus = smbus2.SMBus(number)
        return bus
    except OSError as error:
        raise DeviceError(f"/dev/i2c-{number}", f"cannot be opened: {error.strerror}") from None


class Registers:
    """The registers of one device."""

    def __init__(self, bus: Bus, address: int, device: str, bus_name: str) -> None:
        self._bus = bus
        self._address = address
        self._where = f"at 0x{address:02X} on {bus_name}"
        self.name = f"{device} {self._where}"

    def read(self, register: int) -> int:
        """Return the value of one register."""
        try:
            return self._bus.read_byte_data(self._address, register)
        except OSError as error:
            raise self._failed(register, error) from None

    def read_block(self, register: int, length: int, unit: int = 1) -> bytes:
        """Return `length` bytes that start at `register`, read in parts that are multiples of `unit` bytes."""
        data, part = bytearray(), MAX_BLOCK // unit * unit
        try:
            while len(data) < length:
                count = min(part, length - len(data))
                data += bytes(self._bus.read_i2c_block_data(self._address, register, count))
        except OSError as error:
            raise self._failed(register, error) from None
        return bytes(data)

    def write(self, register: int, value: int) -> None:
        """Write one register."""
        try:
            self._bus.write_byte_data(self._address, register, value)
        except OSError as error:
            raise self._failed(register, error) from None

    def set(self, register: int, value: int) -> None:
        """Write one register and read it back."""
        self.write(register, value)
        if (found := self.read(register)) != value:
            raise DeviceError(self.name, f"holds 0x{found:02X} after 0x{value:02X} was written", register)

    def identify(self, register: int, known: dict[int, str]) -> str:
        """Return the name of the device by its WHO_AM_I `register`; raise DeviceError for one that is not known."""
        if (found := self.read(register)) not in known:
            expected = " or ".join(f"0x{value:02X} ({name})" for value, name in known.items())
            raise DeviceError(self.name, f"WHO_AM_I is 0x{found:02X}: must be {expected}", register)
        self.name = f"{known[found]} {self._where}"
        return known[found]

    def close(self) -> None:
        """Close the bus."""
        with contextlib.suppress(OSError):
            self._bus.close()

    def _failed(self, register: int, error: OSError) -> DeviceError:
        # 121, EREMOTEIO: the address was not acknowledged
        return DeviceError(self.name, f"does not answer: {error.strerror or error}", register)
