"""What the chips on I2C share: they are set up by registers, and queue their samples in a FIFO.

A FIFO that overflows is emptied: its oldest bytes are gone, and with them where a sample begins.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any, ClassVar

from exo_gravity.core.errors import DeviceError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.hardware.imu_sources.i2c import Registers
from exo_gravity.hardware.imu_sources.sampled_source import Axes, Measurement, SampledSource
from exo_gravity.hardware.imu_sources.source import Clock

TEMPERATURE_PERIOD = 1.0  # s
RADIANS_PER_DEGREE = math.pi / 180.0
THREE_NUMBERS = {order: struct.Struct(f"{order}3h") for order in "<>"}

Wait = Callable[[float], Any]  # s, e.g. time.sleep


class FifoSource(SampledSource):
    """Base of the chips on I2C.

    A chip's class states WHO_AM_I and how to reset, test and start the chip, and how to read its FIFO.
    """

    IDENTITY: ClassVar[int]  # the register WHO_AM_I
    KNOWN: ClassVar[dict[int, str]]  # its values

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


def acceleration_scale(lsb_per_g: float) -> float:
    """Return m/s^2 per LSB."""
    return STANDARD_GRAVITY / lsb_per_g
