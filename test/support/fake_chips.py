# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""IMU chips on an I2C bus, as a driver of Adafruit's sees them: transfers of bytes to and from registers.

Scales and registers are those of the data sheets: RM-MPU-6000A, DS-000189 (ICM-20948) and DS12814 (LSM6DSOX).
"""

import errno
import math
import struct
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

G = 9.80665
Axes = tuple[float, float, float]


class FakeTime:
    def __init__(self) -> None:
        self.now = 1000.0  # s

    def __call__(self) -> float:
        return self.now

    def wait(self, duration: float) -> None:
        self.now += duration


Registers = dict[int, int]


class Layout(NamedTuple):
    """What differs from one kind of chip to another. Register nn of bank b is 0xbnn here."""

    address: int
    order: str  #: of the bytes of a number, as in struct
    data: tuple[int, int]  #: first registers of the gyroscope and the accelerometer
    reset: tuple[int, int]  #: register, and the bit of it that resets the chip
    values: Registers  #: after a reset
    ranges: tuple[tuple[int, int, tuple[float, ...]], ...]  #: of both: register, shift; LSB per deg/s, or per g
    rate: Callable[[Registers], float]  #: how often it measures, in Hz; 0 asleep


class FakeChip:
    """Registers, of which the data follow the motion at the instants at which the chip measures; asleep they stay."""

    def __init__(self, layout: Layout, clock: Callable[[], float]) -> None:
        self.address, self.bank = layout.address, 0
        self.angular_velocity: Callable[[float], Axes] = lambda time: (0.0, 0.0, 0.0)  # deg/s
        self.acceleration: Callable[[float], Axes] = lambda time: (0.0, 0.0, 1.0)  # g, +1 upward at rest
        self._layout, self._clock = layout, clock
        self.reset()

    def reset(self) -> None:
        """Lose the registers, as by a broken supply."""
        self.registers = defaultdict(int, self._layout.values)

    def write(self, register: int, value: int) -> None:
        place, (reset, bit) = self.bank << 8 | register, self._layout.reset
        if register == 0x7F:  # of a chip with banks
            self.bank = value >> 4
        elif place == reset and value & bit:
            self.reset()
        else:
            self.registers[place] = value

    def read(self, register: int) -> int:
        return self.registers[self.bank << 8 | register]

    def measure(self) -> None:
        layout, registers = self._layout, self.registers
        if not (rate := layout.rate(registers)):
            return
        count = math.floor(self._clock() * rate)
        values = (*self.angular_velocity(count / rate), *self.acceleration(count / rate))
        scales = [lsb[registers[register] >> shift & 3] for register, shift, lsb in layout.ranges for _ in range(3)]
        noise = [count >> bit & 1 for bit in range(6)]  # LSB: the values differ from one measurement to the next
        raw = [round(value * scale) + n for value, scale, n in zip(values, scales, noise, strict=True)]
        raw = [min(max(number, -32768), 32767) for number in raw]
        for first, numbers in zip(layout.data, (raw[:3], raw[3:]), strict=True):
            data = struct.pack(f"{layout.order}3h", *numbers)
            registers.update({first + offset: byte for offset, byte in enumerate(data)})


def rate_of_mpu(registers: Registers) -> float:
    """Return the rate of an MPU-6050, which sleeps at first."""
    is_filtered = 1 <= registers[0x1A] & 7 <= 6
    return 0.0 if registers[0x6B] & 0x40 else (1e3 if is_filtered else 8e3) / (1 + registers[0x19])


def rate_of_icm(registers: Registers) -> float:
    """Return the rate of an ICM-20948, whose auxiliary bus is idle at once."""
    slower = max(registers[0x200], registers[0x210] << 8 | registers[0x211])
    return 0.0 if registers[0x006] & 0x40 else 1125.0 / (1 + slower)


def rate_of_lsm(registers: Registers) -> float:
    """Return the rate of an LSM6DSOX, which sleeps until both sensors have a rate."""
    rates = (0.0, 12.5, 26.0, 52.0, 104.0, 208.0, 416.0, 833.0, 1666.0, 3332.0, 6664.0)
    return min(rates[registers[register] >> 4] for register in (0x10, 0x11))


INVENSENSE = (131.0, 65.5, 32.8, 16.4), (16384.0, 8192.0, 4096.0, 2048.0)
ST = tuple(1e3 / lsb for lsb in (8.75, 17.5, 35.0, 70.0)), tuple(1e3 / lsb for lsb in (0.061, 0.488, 0.122, 0.244))
MPU6050 = Layout(
    0x68, ">", (0x43, 0x3B), (0x6B, 0x80),
    {0x6B: 0x40, 0x75: 0x68, 0x41: 0xF2, 0x42: 0x0E},  # -3570 at 26.03 degC
    ((0x1B, 3, INVENSENSE[0]), (0x1C, 3, INVENSENSE[1])), rate_of_mpu,
)  # fmt: skip
ICM20948 = Layout(
    0x69, ">", (0x033, 0x02D), (0x006, 0x80), {0x000: 0xEA, 0x006: 0x41, 0x017: 0x40, 0x201: 0x01, 0x214: 0x01},
    ((0x201, 1, INVENSENSE[0]), (0x214, 1, INVENSENSE[1])), rate_of_icm,
)  # fmt: skip
LSM6DSOX = Layout(
    0x6A, "<", (0x22, 0x28), (0x12, 0x01),
    {0x0F: 0x6C, 0x12: 0x04, 0x18: 0xE0, 0x20: 0x00, 0x21: 0x01},  # 256 above 25 degC: 26 degC
    ((0x11, 2, ST[0]), (0x10, 2, ST[1])), rate_of_lsm,
)  # fmt: skip
FAKES = {"mpu6050": partial(FakeChip, MPU6050), "icm20948": partial(FakeChip, ICM20948),
         "lsm6dsox": partial(FakeChip, LSM6DSOX)}  # fmt: skip


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
