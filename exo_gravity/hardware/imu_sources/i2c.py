"""Chips on an I2C bus, through `smbus2`: they are set up by registers, and queue their samples in a FIFO.

Every failure names the device, its address and the register. A read is at most 32 bytes long, which is what SMBus
allows, so that adapters that support only SMBus work too.
"""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from exo_gravity.core.errors import DeviceError, ParameterError
from exo_gravity.hardware.imu_sources.source import Axes, Clock, ImuSource, Measurement

MAX_BLOCK = 32  # bytes
TEMPERATURE_PERIOD = 1.0  # s
THREE_NUMBERS = {order: struct.Struct(f"{order}3h") for order in "<>"}

Bus = Any  # a `smbus2.SMBus`
Wait = Callable[[float], Any]  # s, e.g. time.sleep


def open_bus(number: int) -> Bus:
    """Return the bus /dev/i2c-`number`. Raises DeviceError, and ParameterError without smbus2."""
    try:
        import smbus2
    except ImportError:
        raise ParameterError("source", "an IMU on I2C", "topic, or install the extra imu (smbus2)") from None
    try:
        return smbus2.SMBus(number)
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
        return int(self._transfer(self._bus.read_byte_data, register))

    def read_block(self, register: int, length: int, unit: int = 1) -> bytes:
        """Return `length` bytes that start at `register`, read in parts that are multiples of `unit` bytes."""
        data, part = bytearray(), MAX_BLOCK // unit * unit
        while len(data) < length:
            data += bytes(self._transfer(self._bus.read_i2c_block_data, register, min(part, length - len(data))))
        return bytes(data)

    def write(self, register: int, value: int) -> None:
        """Write one register."""
        self._transfer(self._bus.write_byte_data, register, value)

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

    def _transfer(self, function: Callable[..., Any], register: int, *arguments: int) -> Any:
        try:
            return function(self._address, register, *arguments)
        except OSError as error:  # 121, EREMOTEIO: the address was not acknowledged
            raise DeviceError(self.name, f"does not answer: {error.strerror or error}", register) from None


class FifoSource(ImuSource):
    """Base of the chips on I2C.

    A chip's class states WHO_AM_I and how to reset, test and start the chip, and how to read its FIFO. A FIFO that
    overflows is emptied: its oldest bytes are gone, and with them where a sample begins.
    """

    IDENTITY: ClassVar[int]  # the register WHO_AM_I
    KNOWN: ClassVar[dict[int, str]]  # its values
    SETTLING: ClassVar[float]  # s after the self-test's actuators were switched

    def __init__(self, registers: Registers, rate: float, clock: Clock, wait: Wait, self_test: bool = True) -> None:
        """Set up the chip for about `rate` samples a second; with `self_test` it must be still for a second.

        Raises DeviceError if the chip does not answer, is another one, or fails its self-test.
        """
        self._registers = registers
        self._wait = wait
        self.chip = registers.identify(self.IDENTITY, self.KNOWN)
        self._reset()
        if self_test:
            self._test()
        super().__init__(registers.name, self._start(rate), clock)
        self._temperature_due = -math.inf

    def close(self) -> None:
        """Close the bus; never raises."""
        self._registers.close()

    def _measure(self, now: float) -> list[Measurement]:
        try:
            if not now < self._temperature_due <= now + TEMPERATURE_PERIOD:
                self._temperature_due = now + TEMPERATURE_PERIOD
                self.temperature = self._read_temperature()
            return self._drain()
        except DeviceError as error:
            # A disturbed transfer: where a sample begins in the FIFO is no longer known.
            try:
                return self._lose("a read failed")
            except DeviceError:
                raise error from None

    def _lose(self, why: str) -> list[Measurement]:
        """Give up what is in the FIFO."""
        self._why_lost = why
        self._sample_clock.interrupt()
        self._empty_fifo()
        return []

    def _responses(
        self, switch: Callable[[bool], None], registers: Sequence[int], count: int, period: float, order: str = ">"
    ) -> list[float]:
        """Return how the self-test's actuators change the mean of `count` readings, `period` s apart, in LSB.

        switch: switches the actuators on and off. registers: of three axes each, whose means follow one another.
        """
        means = []
        for on in (False, True):
            switch(on)
            self._wait(self.SETTLING)
            readings = []
            for _ in range(count):
                self._wait(period)
                blocks = (self._registers.read_block(register, 6) for register in registers)
                readings.append([value for block in blocks for value in axes(block, 1.0, order)])
            means.append([sum(axis) / count for axis in zip(*readings, strict=True)])
        return [on - off for off, on in zip(*means, strict=True)]

    def _judge(self, sensor: str, response: Sequence[float], limits: Sequence[tuple[float, float]], unit: str) -> None:
        """Raise DeviceError unless the response of each axis lies within its limits."""
        for axis, value, (low, high) in zip("xyz", response, limits, strict=True):
            if not low <= value <= high:
                raise DeviceError(
                    self._registers.name,
                    f"self-test failed: {sensor} {axis} responds by {value:.0f} {unit}, must be {low:.0f} to "
                    f"{high:.0f}: keep it still and try again, or replace it",
                )

    def _reset(self) -> None:
        """Return the chip to its reset values, and wake it."""
        raise NotImplementedError

    def _test(self) -> None:
        """Run the self-test; raise DeviceError if it fails."""
        raise NotImplementedError

    def _start(self, rate: float) -> float:
        """Set ranges, filters, rate and FIFO; return the rate that the chip has."""
        raise NotImplementedError

    def _drain(self) -> list[Measurement]:
        """Return the FIFO's samples."""
        raise NotImplementedError

    def _empty_fifo(self) -> None:
        """Empty the FIFO and let it fill anew."""
        raise NotImplementedError

    def _read_temperature(self) -> float:
        """Return degrees Celsius."""
        raise NotImplementedError


def axes(data: bytes, scale: float, order: str = ">") -> Axes:
    """Return three 16-bit numbers times `scale`; order: '>' for high byte first, '<' for low byte first."""
    x, y, z = THREE_NUMBERS[order].unpack(data)
    return x * scale, y * scale, z * scale
