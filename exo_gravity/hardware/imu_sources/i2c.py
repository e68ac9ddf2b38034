"""Chips on an I2C bus, through `smbus2`: they are set up by registers, and queue their samples in a FIFO.

Every failure names the device, its address and the register. A read is at most 32 bytes long, which is what SMBus
allows, so that adapters that support only SMBus work too.
"""

import contextlib
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from exo_gravity.core.errors import DeviceError, ParameterError
from exo_gravity.hardware.imu_sources.source import Axes, Clock, ImuSource

MAX_BLOCK = 32  # bytes
TEMPERATURE_PERIOD = 1.0  # s
BANK_SELECT = 0x7F  # of a chip whose registers lie in banks

Bus = Any  # a `smbus2.SMBus`
Values = Mapping[int, int]  # of registers, in the order in which they are written
Limits = tuple[float, float]
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


class FifoSource(ImuSource):
    """Base of the chips on I2C.

    Where the registers lie in banks, one of which is visible, 0x2nn is register nn of bank 2. A FIFO that overflows is
    emptied: its oldest bytes are gone, and with them where a sample begins. So it is after a disturbed transfer.
    """

    WHO_AM_I: ClassVar[int]  # the register, and
    KNOWN: ClassVar[dict[int, str]]  # its values
    IS_BANKED = False
    TEMPERATURE: ClassVar[int]  # the first of its registers
    ORDER: ClassVar[str]  # of the two bytes of a number: '>' for high byte first, '<' for low byte first
    SETTLING: ClassVar[float]  # s after the self-test's actuators were switched
    PACKET: ClassVar[int]  # bytes of a packet in the FIFO
    thermometer: tuple[float, float]  # LSB/degC; degC at 0
    _bank: int | None = None  # None: not known, as after a program that was killed

    def __init__(
        self, name: str, bus: Bus, where: tuple[str, int], rate: float, clock: Clock, wait: Wait, self_test: bool
    ) -> None:
        """Set up the chip for about `rate` samples a second; with `self_test` it must be still for a second.

        where: name of the bus, and address. Raises DeviceError if the chip does not answer, is another one, or fails
        its self-test; the bus is then closed.
        """
        self._bus, self._address, self._wait = bus, where[1], wait
        place = f"at 0x{where[1]:02X} on {where[0]}"
        self.name = f"{name} {place}"
        try:
            if (found := self._read(self.WHO_AM_I)) not in self.KNOWN:
                expected = " or ".join(f"0x{value:02X} ({chip})" for value, chip in self.KNOWN.items())
                raise DeviceError(self.name, f"WHO_AM_I is 0x{found:02X}: must be {expected}", self.WHO_AM_I)
            self.chip = self.KNOWN[found]
            self.name = f"{self.chip} {place}"
            super().__init__(self.name, self._set_up(rate, self_test), clock)
        except DeviceError:
            self.close()
            raise
        self._temperature_due = -math.inf

    def close(self) -> None:
        """Close the bus; never raises."""
        with contextlib.suppress(OSError):
            self._bus.close()

    def _read(self, register: int) -> int:
        """Return the value of one register."""
        return int(self._transfer(self._bus.read_byte_data, register))

    def _read_block(self, register: int, length: int, unit: int = 1) -> bytes:
        """Return `length` bytes that start at `register`, read in parts that are multiples of `unit` bytes."""
        data, part = bytearray(), MAX_BLOCK // unit * unit
        while len(data) < length:
            data += bytes(self._transfer(self._bus.read_i2c_block_data, register, min(part, length - len(data))))
        return bytes(data)

    def _write(self, register: int, value: int) -> None:
        """Write one register."""
        self._transfer(self._bus.write_byte_data, register, value)

    def _set(self, values: Values) -> None:
        """Write registers, each of which is read back."""
        for register, value in values.items():
            self._write(register, value)
            if (found := self._read(register)) != value:
                raise DeviceError(self.name, f"holds 0x{found:02X} after 0x{value:02X} was written", register)

    def _transfer(self, function: Callable[..., Any], register: int, *arguments: int) -> Any:
        bank, number = divmod(register, 0x100)
        try:
            if self.IS_BANKED and bank != self._bank:
                self._bus.write_byte_data(self._address, BANK_SELECT, bank << 4)
                self._bank = bank
            return function(self._address, number, *arguments)
        except OSError as error:  # 121, EREMOTEIO: the address was not acknowledged
            self._bank = None
            raise DeviceError(self.name, f"does not answer: {error.strerror or error}", number) from None

    def _packets(self, now: float) -> list[bytes]:
        try:
            if not now < self._temperature_due <= now + TEMPERATURE_PERIOD:
                self._temperature_due = now + TEMPERATURE_PERIOD
                (raw,) = struct.unpack(f"{self.ORDER}h", self._read_block(self.TEMPERATURE, 2))
                self.temperature = raw / self.thermometer[0] + self.thermometer[1]
            register, count = self._queue()
            if count is not None:
                data = self._read_block(register, self.PACKET * count, self.PACKET)
                return [data[start : start + self.PACKET] for start in range(0, len(data), self.PACKET)]
            self._why_lost = "FIFO overflowed"
        except DeviceError:
            self._why_lost = "a read failed"
        self._sample_clock.interrupt()
        self._empty_fifo()
        return []

    def _axes(self, data: bytes, scale: float) -> Axes:
        """Return three 16-bit numbers times `scale`."""
        x, y, z = struct.unpack(f"{self.ORDER}3h", data)
        return x * scale, y * scale, z * scale

    def _responses(self, off: Values, on: Values, data: Sequence[int], count: int, period: float) -> list[float]:
        """Return how the self-test's actuators change the mean of `count` readings, `period` s apart, in LSB.

        off, on: registers that switch the actuators. data: registers of three axes each, whose means follow.
        """
        means = []
        for actuators in (off, on):
            self._set(actuators)
            self._wait(self.SETTLING)
            readings = []
            for _ in range(count):
                self._wait(period)
                readings.append([v for first in data for v in self._axes(self._read_block(first, 6), 1.0)])
            means.append([sum(axis) / count for axis in zip(*readings, strict=True)])
        return [on - off for off, on in zip(*means, strict=True)]

    def _judge(self, axis: int, response: float, limits: Sequence[float], unit: str) -> None:
        """Raise DeviceError unless the response lies within its limits; axis: 0 to 2 of the gyroscope, 3 to 5."""
        low, high = limits
        if not low <= response <= high:
            sensor = f"{('gyroscope', 'accelerometer')[axis // 3]} {'xyz'[axis % 3]}"
            raise DeviceError(
                self.name,
                f"self-test failed: {sensor} responds by {response:.0f} {unit}, must be {low:.0f} to {high:.0f}: "
                "keep it still and try again, or replace it",
            )

    def _set_up(self, rate: float, self_test: bool) -> float:
        """Reset the chip, test it, set ranges, filters, rate and FIFO; return the rate that it has."""
        raise NotImplementedError

    def _queue(self) -> tuple[int, int | None]:
        """Return the FIFO's data register, and how many packets it holds; None if it has overflowed."""
        raise NotImplementedError

    def _empty_fifo(self) -> None:
        """Empty the FIFO and let it fill anew."""
        raise NotImplementedError
