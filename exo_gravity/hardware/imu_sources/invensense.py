"""What the InvenSense chips share: FIFO, thermometer and self-test.

The FIFO holds the data registers in the order of their numbers, high byte first: here acceleration x y z, then angular
velocity x y z (RM-MPU-6000A 4.31). Self-test by AN-MPU-9250A-03: the mean of 200 readings with the actuators on, less
the mean with them off, against the response that the factory stored.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

from exo_gravity.core.errors import DeviceError
from exo_gravity.hardware.imu_sources.fifo_source import RADIANS_PER_DEGREE, FifoSource, acceleration_scale, axes
from exo_gravity.hardware.imu_sources.sampled_source import Measurement

SAMPLE = 12  # bytes in the FIFO
RADIANS_PER_LSB = RADIANS_PER_DEGREE / 16.4  # at 2000 deg/s
ACCELERATION_PER_LSB = acceleration_scale(2048.0)  # at 16 g
READINGS = 200  # of each mean of the self-test
SETTLING = 0.02  # s after the actuators were switched
AXES = "xyz"


class Fifo(NamedTuple):
    """Numbers of the registers, and the bytes that the FIFO holds."""

    count_register: int
    data_register: int
    capacity: int


class Thermometer(NamedTuple):
    """Degrees Celsius = raw / sensitivity + offset."""

    register: int
    sensitivity: float
    offset: float


class InvenSense(FifoSource):
    """Base of the InvenSense chips."""

    READING: ClassVar[tuple[int, int]]  # registers of acceleration and angular velocity
    fifo: Fifo
    thermometer: Thermometer

    def _drain(self) -> list[Measurement]:
        count = int.from_bytes(self._registers.read_block(self.fifo.count_register, 2), "big") & 0x1FFF
        # Not the overflow flag: on some of these chips it is always set (Linux: inv_mpu_ring.c).
        if count > self.fifo.capacity - SAMPLE:
            return self._lose("FIFO overflowed")
        data = self._registers.read_block(self.fifo.data_register, count // SAMPLE * SAMPLE, SAMPLE)
        return [
            Measurement(
                axes(data[start + 6 : start + 12], RADIANS_PER_LSB), axes(data[start : start + 6], ACCELERATION_PER_LSB)
            )
            for start in range(0, len(data), SAMPLE)
        ]

    def _read_temperature(self) -> float:
        (raw,) = struct.unpack(">h", self._registers.read_block(self.thermometer.register, 2))
        return float(raw / self.thermometer.sensitivity + self.thermometer.offset)

    def _responses(self, switch_actuators: Callable[[bool], None]) -> tuple[list[float], list[float]]:
        """Return how the actuators change angular velocity and acceleration, in LSB."""
        means = []
        for on in (False, True):
            switch_actuators(on)
            means.append(self._mean())
        (rate_off, acceleration_off), (rate_on, acceleration_on) = means
        return _difference(rate_on, rate_off), _difference(acceleration_on, acceleration_off)

    def _mean(self) -> tuple[list[float], list[float]]:
        """Return the means of angular velocity and acceleration, in LSB."""
        self._wait(SETTLING)
        totals = [[0.0] * 3, [0.0] * 3]
        for _ in range(READINGS):
            self._wait(1e-3)
            for total, register in zip(totals, self.READING, strict=True):
                for axis, value in enumerate(axes(self._registers.read_block(register, 6), 1.0 / READINGS)):
                    total[axis] += value
        return totals[1], totals[0]

    def _judge(
        self, sensor: str, response: Sequence[float], factory: Sequence[float], passes: Callable[[float, float], bool]
    ) -> None:
        """Raise DeviceError unless `passes(response, factory)` for each axis; both are in LSB."""
        for axis, measured, expected in zip(AXES, response, factory, strict=True):
            if not passes(measured, expected):
                raise DeviceError(
                    self._registers.name,
                    f"self-test failed: {sensor} {axis} responds by {measured:.0f} LSB, the factory measured "
                    f"{expected:.0f}: keep it still and try again, or replace it",
                )


def _difference(a: Sequence[float], b: Sequence[float]) -> list[float]:
    return [x - y for x, y in zip(a, b, strict=True)]


def factory_6500(codes: Sequence[int]) -> list[float]:
    """Return the factory's responses in LSB at 250 deg/s and 2 g from SELF_TEST registers; 0 if none was stored."""
    return [2620.0 * 1.01 ** (code - 1) if code else 0.0 for code in codes]


def gyroscope_6500_passes(response: float, factory: float) -> bool:
    """Return whether the response is over half the factory's, or at least 60 deg/s (131 LSB each) without one."""
    return response > 0.5 * factory if factory else abs(response) >= 60.0 * 131.0


def accelerometer_6500_passes(response: float, factory: float) -> bool:
    """Return whether the response is 0.5 to 1.5 times the factory's, or 225 to 675 mg (16.384 LSB each) without one."""
    return 0.5 < response / factory < 1.5 if factory else 225.0 <= abs(response) / 16.384 <= 675.0
