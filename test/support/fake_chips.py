# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""IMU chips on an I2C bus, as a driver of Adafruit's sees them: transfers of bytes to and from registers.

Scales and registers are those of the data sheets: RM-MPU-6000A, DS-000189 (ICM-20948) and DS12814 (LSM6DSOX).
"""

from __future__ import annotations

import errno
import math
import struct
from collections.abc import Callable
from typing import ClassVar

G = 9.80665
Axes = tuple[float, float, float]


class FakeTime:
    """A clock that only `wait` moves."""

    def __init__(self) -> None:
        self.now = 1000.0  # s

    def __call__(self) -> float:
        return self.now

    def wait(self, duration: float) -> None:
        """Let `duration` s pass."""
        self.now += duration


class FakeChip:
    """Registers, of which the data follow the motion at the instants at which the chip measures; asleep they stay."""

    address: int
    order: str  # of the bytes of a number, as in struct
    data: tuple[int, int]  # first registers of the gyroscope and the accelerometer
    reset_values: ClassVar[dict[int, int]]

    def __init__(self, clock: FakeTime) -> None:
        self.clock = clock
        self.angular_velocity: Callable[[float], Axes] = lambda time: (0.0, 0.0, 0.0)  # deg/s
        self.acceleration: Callable[[float], Axes] = lambda time: (0.0, 0.0, 1.0)  # g, +1 upward at rest
        self.registers = dict(self.reset_values)

    def reset(self) -> None:
        """Lose the registers, as by a broken supply."""
        self.registers = dict(self.reset_values)

    def rate(self) -> float:
        """Return how often it measures, in Hz; 0 asleep."""
        raise NotImplementedError

    def scales(self) -> tuple[float, float]:
        """Return the LSB per deg/s and per g."""
        raise NotImplementedError

    def write(self, register: int, value: int) -> None:
        """Take a byte."""
        self.registers[register] = value

    def read(self, register: int) -> int:
        """Return a byte."""
        return self.registers.get(register, 0)

    def measure(self) -> None:
        """Bring the data registers up to the present."""
        if not self.rate():
            return
        count = math.floor(self.clock() * self.rate())
        values = (*self.angular_velocity(count / self.rate()), *self.acceleration(count / self.rate()))
        rate, force = self.scales()
        noise = [count >> bit & 1 for bit in range(6)]  # LSB: the values differ from one measurement to the next
        raw = [
            round(value * scale) + n for value, scale, n in zip(values, 3 * [rate] + 3 * [force], noise, strict=True)
        ]
        raw = [min(max(number, -32768), 32767) for number in raw]
        for first, numbers in zip(self.data, (raw[:3], raw[3:]), strict=True):
            data = struct.pack(f"{self.order}3h", *numbers)
            self.registers.update({first + offset: byte for offset, byte in enumerate(data)})


class FakeMpu6050(FakeChip):
    """An MPU-6050."""

    address, order, data = 0x68, ">", (0x43, 0x3B)
    reset_values: ClassVar = {0x6B: 0x40, 0x75: 0x68, 0x41: 0xF2, 0x42: 0x0E}  # it sleeps; -3570 at 26.03 degC

    def write(self, register: int, value: int) -> None:
        if register == 0x6B and value & 0x80:
            self.reset()
        else:
            super().write(register, value)

    def rate(self) -> float:
        filtered = 1 <= self.registers.get(0x1A, 0) & 7 <= 6
        return 0.0 if self.registers[0x6B] & 0x40 else (1e3 if filtered else 8e3) / (1 + self.registers.get(0x19, 0))

    def scales(self) -> tuple[float, float]:
        gyro, accelerometer = (self.registers.get(register, 0) >> 3 & 3 for register in (0x1B, 0x1C))
        return (131.0, 65.5, 32.8, 16.4)[gyro], (16384.0, 8192.0, 4096.0, 2048.0)[accelerometer]


class FakeIcm20948(FakeChip):
    """An ICM-20948: register nn of bank b is 0xbnn here. Its auxiliary bus is idle at once."""

    address, order, data = 0x69, ">", (0x033, 0x02D)
    reset_values: ClassVar = {0x000: 0xEA, 0x006: 0x41, 0x017: 0x40, 0x201: 0x01, 0x214: 0x01}
    bank = 0

    def write(self, register: int, value: int) -> None:
        if register == 0x7F:
            self.bank = value >> 4
        elif self.bank == 0 and register == 0x06 and value & 0x80:
            self.reset()
        else:
            super().write(self.bank << 8 | register, value)

    def read(self, register: int) -> int:
        return super().read(self.bank << 8 | register)

    def rate(self) -> float:
        if self.registers[0x006] & 0x40:
            return 0.0
        slower = max(self.registers.get(0x200, 0), self.registers.get(0x210, 0) << 8 | self.registers.get(0x211, 0))
        return 1125.0 / (1 + slower)

    def scales(self) -> tuple[float, float]:
        gyro, accelerometer = (self.registers[register] >> 1 & 3 for register in (0x201, 0x214))
        return (131.0, 65.5, 32.8, 16.4)[gyro], (16384.0, 8192.0, 4096.0, 2048.0)[accelerometer]


class FakeLsm6dsox(FakeChip):
    """An LSM6DSOX, which sleeps until both sensors have a rate."""

    address, order, data = 0x6A, "<", (0x22, 0x28)
    reset_values: ClassVar = {0x0F: 0x6C, 0x12: 0x04, 0x18: 0xE0, 0x20: 0x00, 0x21: 0x01}  # 256 above 25 degC: 26 degC

    def write(self, register: int, value: int) -> None:
        if register == 0x12 and value & 0x01:
            self.reset()
        else:
            super().write(register, value)

    def rate(self) -> float:
        rates = (0.0, 12.5, 26.0, 52.0, 104.0, 208.0, 416.0, 833.0, 1666.0, 3332.0, 6664.0)
        return min(rates[self.registers.get(register, 0) >> 4] for register in (0x10, 0x11))

    def scales(self) -> tuple[float, float]:
        gyro, accelerometer = (self.registers.get(register, 0) >> 2 & 3 for register in (0x11, 0x10))
        return 1e3 / (8.75, 17.5, 35.0, 70.0)[gyro], 1e3 / (0.061, 0.488, 0.122, 0.244)[accelerometer]


class FakeI2c:
    """The bus of one host, with the interface of CircuitPython's `busio.I2C`."""

    def __init__(self, chip: FakeChip) -> None:
        self.chip = chip
        self.plugged = True
        self.failing = 0  # transfers to come that fail
        self.is_open = True
        self._register = 0

    def try_lock(self) -> bool:
        return True

    def unlock(self) -> None:
        pass

    def deinit(self) -> None:
        self.is_open = False

    def writeto(self, address: int, buffer: bytes, *, start: int = 0, end: int | None = None) -> None:
        self._address(address)
        register, *values = bytes(buffer)[start:end] or (0,)
        self._register = register
        for offset, value in enumerate(values):
            self.chip.write(register + offset, value)

    def readfrom_into(self, address: int, buffer: bytearray, *, start: int = 0, end: int | None = None) -> None:
        self._address(address)
        self.chip.measure()
        for offset, place in enumerate(range(start, len(buffer) if end is None else end)):
            buffer[place] = self.chip.read(self._register + offset)

    def writeto_then_readfrom(
        self,
        address: int,
        buffer_out: bytes,
        buffer_in: bytearray,
        *,
        out_start: int = 0,
        out_end: int | None = None,
        in_start: int = 0,
        in_end: int | None = None,
    ) -> None:
        self.writeto(address, buffer_out, start=out_start, end=out_end)
        self.readfrom_into(address, buffer_in, start=in_start, end=in_end)

    def _address(self, address: int) -> None:
        if not self.is_open:
            raise OSError(errno.EBADF, "Bad file descriptor")
        self.failing = max(self.failing - 1, -1)
        if self.failing >= 0 or not self.plugged or address != self.chip.address:
            raise OSError(errno.EREMOTEIO, "Remote I/O error")


FAKES = {"mpu6050": FakeMpu6050, "icm20948": FakeIcm20948, "lsm6dsox": FakeLsm6dsox}
