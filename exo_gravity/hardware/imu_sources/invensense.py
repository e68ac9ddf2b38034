"""InvenSense chips: MPU-6050, its successors with the same registers (MPU-6500, MPU-9250, MPU-9255), and ICM-20948.

The FIFO holds the data registers in the order of their numbers, high byte first: here acceleration x y z, then angular
velocity x y z (RM-MPU-6000A 4.31). Self-test by AN-MPU-9250A-03: the mean of 200 readings with the actuators on, less
the mean with them off, against the response that the factory stored.

Register maps: RM-MPU-6000A-00 4.2, RM-MPU-9250A-00 1.4, checked against Linux, inv_mpu_iio.h; DS-000189 1.3, checked
against PX4, InvenSense_ICM20948_registers.hpp.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.hardware.imu_sources.i2c import FifoSource, Registers
from exo_gravity.hardware.imu_sources.source import RADIANS_PER_DEGREE, Measurement

SAMPLE = 12  # bytes in the FIFO
RADIANS_PER_LSB = RADIANS_PER_DEGREE / 16.4  # at 2000 deg/s
ACCELERATION_PER_LSB = STANDARD_GRAVITY / 2048.0  # at 16 g
READINGS = 200  # of each mean of the self-test
START_UP = 0.1  # s after a reset, and after waking
RESET, BEST_CLOCK = 0x80, 0x01  # PWR_MGMT_1

# MPU
SMPLRT_DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG, ACCEL_CONFIG_2, FIFO_EN, USER_CTRL = (
    0x19, 0x1A, 0x1B, 0x1C, 0x1D, 0x23, 0x6A,
)  # fmt: skip
EMPTIED = (USER_CTRL, 0x00), (USER_CTRL, 0x04), (USER_CTRL, 0x40)  # off, FIFO_RESET, FIFO_EN
BOTH_TO_FIFO = 0x78
SELECT_2000_DPS = SELECT_16_G = 0x18
SELECT_8_G, ALL_AXES = 0x10, 0xE0  # ALL_AXES: self-test

# ICM-20948
ICM_USER_CTRL, FIFO_EN_2, FIFO_RST, FIFO_MODE = 0x003, 0x067, 0x068, 0x069
GYRO_SMPLRT_DIV, GYRO_CONFIG_1, GYRO_CONFIG_2, ODR_ALIGN_EN = 0x200, 0x201, 0x202, 0x209
ACCEL_SMPLRT_DIV_1, ACCEL_SMPLRT_DIV_2, ICM_ACCEL_CONFIG, ICM_ACCEL_CONFIG_2 = 0x210, 0x211, 0x214, 0x215
USE_FILTER, ICM_SELECT_2000_DPS, ICM_SELECT_16_G = 0x01, 0x06, 0x06  # GYRO_CONFIG_1, ACCEL_CONFIG
GYROSCOPE_ACTUATORS, ACCELEROMETER_ACTUATORS = 0x38, 0x1C  # GYRO_CONFIG_2, ACCEL_CONFIG_2

Values = dict[int, int]  # of registers, in the order in which they are written


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
    factory: tuple[int, int]  #: first registers of the response, of angular velocity and of acceleration


MPU_6500 = Map(
    power=(0x6B, 0x6C),
    data=(0x43, 0x3B),
    fifo=(0x72, 0x74),
    bandwidths={1: 184.0, 2: 94.0, 3: 44.0, 4: 21.0, 5: 10.0, 6: 5.0},
    base_rate=1000.0,
    set_up=lambda divider, low_pass: {
        CONFIG: low_pass,
        ACCEL_CONFIG_2: low_pass,
        SMPLRT_DIV: divider,
        GYRO_CONFIG: SELECT_2000_DPS,
        ACCEL_CONFIG: SELECT_16_G,
        FIFO_EN: BOTH_TO_FIFO,
    },
    emptied=EMPTIED,
    tested={CONFIG: 2, ACCEL_CONFIG_2: 2, SMPLRT_DIV: 0},
    off={GYRO_CONFIG: 0, ACCEL_CONFIG: 0},
    on={GYRO_CONFIG: ALL_AXES, ACCEL_CONFIG: ALL_AXES},
    factory=(0x00, 0x0D),
)
# Its CONFIG filters both sensors, and its test is at 8 g.
MPU_6050 = MPU_6500._replace(
    set_up=lambda *values: {key: v for key, v in MPU_6500.set_up(*values).items() if key != ACCEL_CONFIG_2},
    tested={CONFIG: 2, SMPLRT_DIV: 0},
    off={GYRO_CONFIG: 0, ACCEL_CONFIG: SELECT_8_G},
    on={GYRO_CONFIG: ALL_AXES, ACCEL_CONFIG: ALL_AXES | SELECT_8_G},
    factory=(0x0D, 0x0D),
)
ICM_20948 = Map(
    power=(0x006, 0x007),
    data=(0x033, 0x02D),
    fifo=(0x070, 0x072),
    bandwidths={2: 119.5, 3: 51.2, 4: 23.9, 5: 11.6, 6: 5.7},  # the accelerometer's: at most 8 Hz narrower
    base_rate=1125.0,
    set_up=lambda divider, low_pass: {
        ODR_ALIGN_EN: 1,  # both sensors sample at the same time
        GYRO_SMPLRT_DIV: divider,
        ACCEL_SMPLRT_DIV_1: 0,
        ACCEL_SMPLRT_DIV_2: divider,
        GYRO_CONFIG_1: USE_FILTER | ICM_SELECT_2000_DPS | low_pass << 3,
        GYRO_CONFIG_2: 0,
        ICM_ACCEL_CONFIG: USE_FILTER | ICM_SELECT_16_G | low_pass << 3,
        ICM_ACCEL_CONFIG_2: 0,
        FIFO_MODE: 0,  # the newest samples replace the oldest
        FIFO_EN_2: 0x1E,  # accelerometer, gyroscope z, y, x
        ICM_USER_CTRL: 0x40,  # FIFO_EN
    },
    emptied=((FIFO_RST, 0x1F), (FIFO_RST, 0x00)),
    tested={GYRO_SMPLRT_DIV: 0, ACCEL_SMPLRT_DIV_2: 0, GYRO_CONFIG_1: 0x11, ICM_ACCEL_CONFIG: 0x11},  # filter 2, 2 g
    off={GYRO_CONFIG_2: 0, ICM_ACCEL_CONFIG_2: 0},
    on={GYRO_CONFIG_2: GYROSCOPE_ACTUATORS, ICM_ACCEL_CONFIG_2: ACCELEROMETER_ACTUATORS},
    factory=(0x102, 0x10E),
)


class InvenSense(FifoSource):
    """Base of the InvenSense chips."""

    ORDER, SETTLING = ">", 0.02
    map: Map
    capacity = 512  # bytes of the FIFO
    thermometer = 333.87, 21.0

    def _set_up(self, rate: float, self_test: bool) -> float:
        for value in (RESET, BEST_CLOCK):
            self._registers.write(self.map.power[0], value)
            self._wait(START_UP)
        self._registers.set({self.map.power[1]: 0})
        if self_test:
            self._registers.set(self.map.tested)
            self._test(self._responses(self.map.off, self.map.on, self.map.data, READINGS, 1e-3))
        divider = min(max(round(self.map.base_rate / rate) - 1, 0), 255)
        rate = self.map.base_rate / (1 + divider)
        widest = next((code for code, width in self.map.bandwidths.items() if width <= rate / 2), 6)
        self._registers.set(self.map.set_up(divider, widest))
        self._empty_fifo()
        return rate

    def _empty_fifo(self) -> None:
        for register, value in self.map.emptied:
            self._registers.write(register, value)

    def _drain(self) -> list[Measurement]:
        count = int.from_bytes(self._registers.read_block(self.map.fifo[0], 2), "big") & 0x1FFF
        # Not the overflow flag: on some of these chips it is always set (Linux: inv_mpu_ring.c).
        if count > self.capacity - SAMPLE:
            return self._lose("FIFO overflowed")
        data = self._registers.read_block(self.map.fifo[1], count // SAMPLE * SAMPLE, SAMPLE)
        samples = (data[start : start + SAMPLE] for start in range(0, len(data), SAMPLE))
        return [
            Measurement(self._axes(sample[6:], RADIANS_PER_LSB), self._axes(sample[:6], ACCELERATION_PER_LSB))
            for sample in samples
        ]

    def _test(self, response: Sequence[float]) -> None:
        """Judge a chip since the MPU-6500, angular velocity first.

        A response, at 250 deg/s (131 LSB each) and 2 g, must be over half the factory's, an accelerometer's at most 1.5
        times. Without one it must be at least 60 deg/s, and 225 to 675 mg (16.384 LSB each), of either sign.
        """
        for sensor, values, register, shares, without in (
            ("gyroscope", response[:3], self.map.factory[0], (0.5, math.inf), (60.0 * 131.0, math.inf)),
            ("accelerometer", response[3:], self.map.factory[1], (0.5, 1.5), (225.0 * 16.384, 675.0 * 16.384)),
        ):
            codes = self._registers.read_block(register, 3)
            low, high = (2620.0 * share for share in shares)
            limits = [(low * 1.01 ** (code - 1), high * 1.01 ** (code - 1)) if code else without for code in codes]
            judged = [value if code else abs(value) for value, code in zip(values, codes, strict=True)]
            self._judge(sensor, judged, limits, "LSB")


class Mpu6050(InvenSense):
    """An MPU-6050 or one of its successors."""

    IDENTITY, TEMPERATURE, map = 0x75, 0x41, MPU_6500
    KNOWN: ClassVar = {0x68: "MPU-6050", 0x70: "MPU-6500", 0x71: "MPU-9250", 0x73: "MPU-9255"}

    def _set_up(self, rate: float, self_test: bool) -> float:
        if self.chip == "MPU-6050":
            self.map, self.capacity, self.thermometer = MPU_6050, 1024, (340.0, 36.53)
        return super()._set_up(rate, self_test)

    def _test(self, response: Sequence[float]) -> None:
        if self.chip != "MPU-6050":
            super()._test(response)
            return
        limits = _limits_6050(self._registers.read_block(MPU_6050.factory[0], 4))
        self._judge("gyroscope", response[:3], limits[:3], "LSB")
        self._judge("accelerometer", response[3:], limits[3:], "LSB")


class Icm20948(InvenSense):
    """An ICM-20948, whose registers lie in four banks. Its magnetometer is not used."""

    IDENTITY, TEMPERATURE, map = 0x000, 0x039, ICM_20948
    KNOWN: ClassVar = {0xEA: "ICM-20948"}

    def __init__(self, registers: Registers, *arguments: Any, **options: Any) -> None:
        """Set up the chip; see `FifoSource`."""
        registers.is_banked = True
        super().__init__(registers, *arguments, **options)


def _limits_6050(codes: bytes) -> list[tuple[float, float]]:
    """Return the limits of the responses, gyroscope first, in LSB at 250 deg/s and 8 g.

    They lie 14 % (PS-MPU-6000A 6.1) about the factory's response (RM-MPU-6000A 4.1); a chip without one has no limits.
    """
    gyroscope, accelerometer = [], []
    for axis, sign in enumerate((1.0, -1.0, 1.0)):
        code = codes[axis] & 0x1F
        gyroscope.append(sign * 25.0 * 131.0 * 1.046 ** (code - 1) if code else math.inf)
        code = codes[axis] >> 5 << 2 | codes[3] >> (4 - 2 * axis) & 3
        accelerometer.append(4096.0 * 0.34 * (0.92 / 0.34) ** ((code - 1) / 30.0) if code else math.inf)
    return [
        (factory - 0.14 * abs(factory), factory + 0.14 * abs(factory)) if factory < math.inf else (-math.inf, math.inf)
        for factory in gyroscope + accelerometer
    ]
