"""InvenSense chips: MPU-6050, its successors with the same registers (MPU-6500, MPU-9250, MPU-9255), and ICM-20948.

The FIFO holds the data registers in the order of their numbers, high byte first: here acceleration x y z, then angular
velocity x y z (RM-MPU-6000A 4.31). Self-test by AN-MPU-9250A-03: the mean of 200 readings with the actuators on, less
the mean with them off, against the response that the factory stored.

Register maps: RM-MPU-6000A-00 4.2, RM-MPU-9250A-00 1.4, checked against Linux, inv_mpu_iio.h; DS-000189 1.3, checked
against PX4, InvenSense_ICM20948_registers.hpp.
"""

import math
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

from exo_gravity.core.arm.arm import STANDARD_GRAVITY
from exo_gravity.hardware.imu_sources.i2c import FifoSource, Limits, Values
from exo_gravity.hardware.imu_sources.source import RADIANS_PER_DEGREE, Measurement

RADIANS_PER_LSB = RADIANS_PER_DEGREE / 16.4  # at 2000 deg/s
ACCELERATION_PER_LSB = STANDARD_GRAVITY / 2048.0  # at 16 g
READINGS = 200  # of each mean of the self-test
START_UP = 0.1  # s after a reset, and after waking
RESET, BEST_CLOCK = 0x80, 0x01  # PWR_MGMT_1


def _factory_6500(stored: bytes) -> list[float]:
    """Return the factory's responses, angular velocity first, in LSB at 250 deg/s and 2 g; 0: it stored none."""
    return [2620.0 * 1.01 ** (code - 1) if code else 0.0 for code in stored]


def _factory_6050(stored: bytes) -> list[float]:
    """Return the same of an MPU-6050, at 250 deg/s and 8 g (RM-MPU-6000A 4.1)."""
    *codes, low_bits = stored
    rates = [25.0 * 131.0 * 1.046 ** ((code & 0x1F) - 1) if code & 0x1F else 0.0 for code in codes]
    codes = [code >> 5 << 2 | low_bits >> (4 - 2 * axis) & 3 for axis, code in enumerate(codes)]
    forces = [4096.0 * 0.34 * (0.92 / 0.34) ** ((code - 1) / 30.0) if code else 0.0 for code in codes]
    return [rates[0], -rates[1], rates[2], *forces]


class Map(NamedTuple):
    """What a chip has where."""

    power: tuple[int, int]  #: PWR_MGMT_1, PWR_MGMT_2
    data: tuple[int, int]  #: first registers of angular velocity and of acceleration
    fifo: tuple[int, int]  #: registers of its count of bytes and of its data
    bandwidths: dict[int, float]  #: Hz of the low-pass filters by their code
    base_rate: float  #: Hz, divided by 1 + the divider
    set_up: Callable[[int, int], Values]  #: by divider and code of the low-pass filter
    emptied: tuple[tuple[int, int], ...]  #: register and value, which empty the FIFO and let it fill
    tested: Values  #: of the self-test, for 250 deg/s, 1 kHz
    off: Values  #: without the self-test's actuators
    on: Values  #: with them
    stored: Values  #: registers from which on the factory stored its response, and how many they are
    #: The response that these say, and its limits: shares of it, or in LSB of either sign without one.
    factory: Callable[[bytes], list[float]] = _factory_6500
    shares: tuple[Limits, Limits] = (0.5, math.inf), (0.5, 1.5)
    without: tuple[Limits, Limits] = (60.0 * 131.0, math.inf), (225.0 * 16.384, 675.0 * 16.384)  # 60 deg/s, 225 mg


MPU_6500 = Map(
    power=(0x6B, 0x6C),
    data=(0x43, 0x3B),
    fifo=(0x72, 0x74),
    bandwidths={1: 184.0, 2: 94.0, 3: 44.0, 4: 21.0, 5: 10.0, 6: 5.0},
    base_rate=1000.0,
    set_up=lambda divider, low_pass: {
        0x1A: low_pass,  # CONFIG
        0x1D: low_pass,  # ACCEL_CONFIG_2
        0x19: divider,  # SMPLRT_DIV
        0x1B: 0x18,  # GYRO_CONFIG: 2000 deg/s
        0x1C: 0x18,  # ACCEL_CONFIG: 16 g
        0x23: 0x78,  # FIFO_EN: both
    },
    emptied=((0x6A, 0x00), (0x6A, 0x04), (0x6A, 0x40)),  # USER_CTRL: off, FIFO_RESET, FIFO_EN
    tested={0x1A: 2, 0x1D: 2, 0x19: 0},
    off={0x1B: 0, 0x1C: 0},
    on={0x1B: 0xE0, 0x1C: 0xE0},
    stored={0x00: 3, 0x0D: 3},
)
# Its CONFIG filters both sensors, and its test is at 8 g. Limits: 14 % (PS-MPU-6000A 6.1), or none.
MPU_6050 = MPU_6500._replace(
    set_up=lambda *values: {key: value for key, value in MPU_6500.set_up(*values).items() if key != 0x1D},
    tested={0x1A: 2, 0x19: 0},
    off={0x1B: 0, 0x1C: 0x10},
    on={0x1B: 0xE0, 0x1C: 0xF0},
    stored={0x0D: 4},
    factory=_factory_6050,
    shares=((0.86, 1.14), (0.86, 1.14)),
    without=((0.0, math.inf), (0.0, math.inf)),
)
ICM_20948 = Map(
    power=(0x006, 0x007),
    data=(0x033, 0x02D),
    fifo=(0x070, 0x072),
    bandwidths={2: 119.5, 3: 51.2, 4: 23.9, 5: 11.6, 6: 5.7},  # the accelerometer's: at most 8 Hz narrower
    base_rate=1125.0,
    set_up=lambda divider, low_pass: {
        0x209: 1,  # ODR_ALIGN_EN: both sensors sample at the same time
        0x200: divider,  # GYRO_SMPLRT_DIV
        0x210: 0,  # ACCEL_SMPLRT_DIV_1
        0x211: divider,  # ACCEL_SMPLRT_DIV_2
        0x201: 0x07 | low_pass << 3,  # GYRO_CONFIG_1: filter, 2000 deg/s
        0x202: 0,  # GYRO_CONFIG_2
        0x214: 0x07 | low_pass << 3,  # ACCEL_CONFIG: filter, 16 g
        0x215: 0,  # ACCEL_CONFIG_2
        0x069: 0,  # FIFO_MODE: the newest samples replace the oldest
        0x067: 0x1E,  # FIFO_EN_2: accelerometer, gyroscope z, y, x
        0x003: 0x40,  # USER_CTRL: FIFO_EN
    },
    emptied=((0x068, 0x1F), (0x068, 0x00)),  # FIFO_RST
    tested={0x200: 0, 0x211: 0, 0x201: 0x11, 0x214: 0x11},  # filter 2, 250 deg/s, 2 g
    off={0x202: 0, 0x215: 0},
    on={0x202: 0x38, 0x215: 0x1C},
    stored={0x102: 3, 0x10E: 3},
)


class InvenSense(FifoSource):
    """Base of the InvenSense chips."""

    ORDER, SETTLING, PACKET = ">", 0.02, 12
    map: Map
    capacity = 512  # bytes of the FIFO
    thermometer = 333.87, 21.0

    def _set_up(self, rate: float, self_test: bool) -> float:
        for value in (RESET, BEST_CLOCK):
            self._write(self.map.power[0], value)
            self._wait(START_UP)
        self._set({self.map.power[1]: 0})
        if self_test:
            self._set(self.map.tested)
            self._test(self._responses(self.map.off, self.map.on, self.map.data, READINGS, 1e-3))
        divider = min(max(round(self.map.base_rate / rate) - 1, 0), 255)
        rate = self.map.base_rate / (1 + divider)
        widest = next((code for code, width in self.map.bandwidths.items() if width <= rate / 2), 6)
        self._set(self.map.set_up(divider, widest))
        self._empty_fifo()
        return rate

    def _test(self, response: Sequence[float]) -> None:
        factory = self.map.factory(b"".join(self._read_block(*block) for block in self.map.stored.items()))
        for axis, (value, expected) in enumerate(zip(response, factory, strict=True)):
            low, high = self.map.shares[axis // 3]
            limits = sorted((low * expected, high * expected)) if expected else self.map.without[axis // 3]
            self._judge(axis, value if expected else abs(value), limits, "LSB")

    def _empty_fifo(self) -> None:
        for register, value in self.map.emptied:
            self._write(register, value)

    def _queue(self) -> tuple[int, int | None]:
        count, data = self.map.fifo
        used = int.from_bytes(self._read_block(count, 2), "big") & 0x1FFF
        # Not the overflow flag: on some of these chips it is always set (Linux: inv_mpu_ring.c).
        return data, None if used > self.capacity - self.PACKET else used // self.PACKET

    def _decode(self, packet: bytes) -> Measurement:
        return Measurement(self._axes(packet[6:], RADIANS_PER_LSB), self._axes(packet[:6], ACCELERATION_PER_LSB))


class Mpu6050(InvenSense):
    """An MPU-6050 or one of its successors."""

    WHO_AM_I, TEMPERATURE, map = 0x75, 0x41, MPU_6500
    KNOWN: ClassVar = {0x68: "MPU-6050", 0x70: "MPU-6500", 0x71: "MPU-9250", 0x73: "MPU-9255"}

    def _set_up(self, rate: float, self_test: bool) -> float:
        if self.chip == "MPU-6050":
            self.map, self.capacity, self.thermometer = MPU_6050, 1024, (340.0, 36.53)
        return super()._set_up(rate, self_test)


class Icm20948(InvenSense):
    """An ICM-20948, whose registers lie in four banks. Its magnetometer is not used."""

    WHO_AM_I, TEMPERATURE, IS_BANKED, map = 0x000, 0x039, True, ICM_20948
    KNOWN: ClassVar = {0xEA: "ICM-20948"}
