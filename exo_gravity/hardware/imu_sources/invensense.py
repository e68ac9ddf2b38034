"""InvenSense chips: MPU-6050, its successors with the same registers (MPU-6500, MPU-9250, MPU-9255), and ICM-20948.

The FIFO holds the data registers in the order of their numbers, high byte first: here acceleration x y z, then angular
velocity x y z (RM-MPU-6000A 4.31). Self-test by AN-MPU-9250A-03: the mean of 200 readings with the actuators on, less
the mean with them off, against the response that the factory stored.

Register maps: RM-MPU-6000A-00 4.2, RM-MPU-9250A-00 1.4, checked against Linux, inv_mpu_iio.h; DS-000189 1.3, checked
against PX4, InvenSense_ICM20948_registers.hpp.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any, ClassVar

from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.hardware.imu_sources.i2c import FifoSource, Registers, axes
from exo_gravity.hardware.imu_sources.source import RADIANS_PER_DEGREE, Measurement

SAMPLE = 12  # bytes in the FIFO
RADIANS_PER_LSB = RADIANS_PER_DEGREE / 16.4  # at 2000 deg/s
ACCELERATION_PER_LSB = STANDARD_GRAVITY / 2048.0  # at 16 g
READINGS = 200  # of each mean of the self-test
START_UP = 0.1  # s after a reset, and after waking
RESET, BEST_CLOCK = 0x80, 0x01  # PWR_MGMT_1
ENABLE_FIFO = 0x40  # USER_CTRL

# MPU
SELF_TEST_GYRO_6500, SELF_TEST_6050, SELF_TEST_ACCEL_6500 = 0x00, 0x0D, 0x0D
SMPLRT_DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG, ACCEL_CONFIG_2 = 0x19, 0x1A, 0x1B, 0x1C, 0x1D
FIFO_EN, ACCEL_XOUT_H, TEMP_OUT_H, GYRO_XOUT_H = 0x23, 0x3B, 0x41, 0x43
USER_CTRL, PWR_MGMT_1, PWR_MGMT_2, FIFO_COUNTH, FIFO_R_W, WHO_AM_I = 0x6A, 0x6B, 0x6C, 0x72, 0x74, 0x75

GYROSCOPE_TO_FIFO, ACCELEROMETER_TO_FIFO = 0x70, 0x08  # FIFO_EN
RESET_FIFO = 0x04  # USER_CTRL
SELECT_2000_DPS = SELECT_16_G = 0x18
SELECT_8_G, ALL_AXES = 0x10, 0xE0  # ALL_AXES: self-test

# ICM-20948
REG_BANK_SEL = 0x7F  # in every bank
# bank 0
ICM_WHO_AM_I, ICM_USER_CTRL, ICM_PWR_MGMT_1, ICM_PWR_MGMT_2 = 0x00, 0x03, 0x06, 0x07
ICM_ACCEL_XOUT_H, ICM_GYRO_XOUT_H, ICM_TEMP_OUT_H = 0x2D, 0x33, 0x39
FIFO_EN_2, FIFO_RST, FIFO_MODE, ICM_FIFO_COUNTH, ICM_FIFO_R_W = 0x67, 0x68, 0x69, 0x70, 0x72
# bank 1
ICM_SELF_TEST_GYRO, ICM_SELF_TEST_ACCEL = 0x02, 0x0E
# bank 2
GYRO_SMPLRT_DIV, GYRO_CONFIG_1, GYRO_CONFIG_2, ODR_ALIGN_EN = 0x00, 0x01, 0x02, 0x09
ACCEL_SMPLRT_DIV_1, ACCEL_SMPLRT_DIV_2, ICM_ACCEL_CONFIG, ICM_ACCEL_CONFIG_2 = 0x10, 0x11, 0x14, 0x15

BOTH_TO_FIFO = 0x1E  # FIFO_EN_2: accelerometer, gyroscope z, y, x
ICM_RESET_FIFO = 0x1F  # FIFO_RST
USE_FILTER, ICM_SELECT_2000_DPS, ICM_SELECT_16_G = 0x01, 0x06, 0x06  # GYRO_CONFIG_1, ACCEL_CONFIG
GYROSCOPE_ACTUATORS, ACCELEROMETER_ACTUATORS = 0x38, 0x1C  # GYRO_CONFIG_2, ACCEL_CONFIG_2


class InvenSense(FifoSource):
    """Base of the InvenSense chips."""

    DATA: ClassVar[tuple[int, int, int]]  # registers of acceleration, angular velocity and temperature
    FIFO: ClassVar[tuple[int, int]]  # registers of its count of bytes and of its data
    POWER: ClassVar[tuple[int, int]]  # PWR_MGMT_1, PWR_MGMT_2
    BANDWIDTHS: ClassVar[dict[int, float]]  # Hz of the low-pass filters by their code
    FILTER_RATE: ClassVar[float]  # Hz, divided by 1 + SMPLRT_DIV
    SETTLING = 0.02
    capacity = 512  # bytes of the FIFO
    thermometer = 333.87, 21.0  # LSB/degC, degC

    def _reset(self) -> None:
        for value in (RESET, BEST_CLOCK):
            self._registers.write(self.POWER[0], value)
            self._wait(START_UP)
        self._registers.set(self.POWER[1], 0)

    def _rate(self, rate: float) -> tuple[float, int, int]:
        """Return the rate nearest to `rate`, its divider, and the code of the widest filter below half of it."""
        divider = min(max(round(self.FILTER_RATE / rate) - 1, 0), 255)
        rate = self.FILTER_RATE / (1 + divider)
        return rate, divider, next((code for code, width in self.BANDWIDTHS.items() if width <= rate / 2), 6)

    def _drain(self) -> list[Measurement]:
        count = int.from_bytes(self._registers.read_block(self.FIFO[0], 2), "big") & 0x1FFF
        # Not the overflow flag: on some of these chips it is always set (Linux: inv_mpu_ring.c).
        if count > self.capacity - SAMPLE:
            return self._lose("FIFO overflowed")
        data = self._registers.read_block(self.FIFO[1], count // SAMPLE * SAMPLE, SAMPLE)
        return [
            Measurement(
                axes(data[start + 6 : start + 12], RADIANS_PER_LSB), axes(data[start : start + 6], ACCELERATION_PER_LSB)
            )
            for start in range(0, len(data), SAMPLE)
        ]

    def _read_temperature(self) -> float:
        (raw,) = struct.unpack(">h", self._registers.read_block(self.DATA[2], 2))
        return float(raw / self.thermometer[0] + self.thermometer[1])

    def _judge_6500(self, response: Sequence[float], gyroscope_codes: bytes, accelerometer_codes: bytes) -> None:
        """Judge a chip since the MPU-6500, angular velocity first, by its SELF_TEST registers.

        A response, at 250 deg/s (131 LSB each) and 2 g, must be over half the factory's, an accelerometer's at most 1.5
        times. Without one it must be at least 60 deg/s, and 225 to 675 mg (16.384 LSB each), of either sign.
        """
        for sensor, values, codes, shares, without in (
            ("gyroscope", response[:3], gyroscope_codes, (0.5, math.inf), (60.0 * 131.0, math.inf)),
            ("accelerometer", response[3:], accelerometer_codes, (0.5, 1.5), (225.0 * 16.384, 675.0 * 16.384)),
        ):
            low, high = (2620.0 * share for share in shares)
            limits = [(low * 1.01 ** (code - 1), high * 1.01 ** (code - 1)) if code else without for code in codes]
            judged = [value if code else abs(value) for value, code in zip(values, codes, strict=True)]
            self._judge(sensor, judged, limits, "LSB")


class Mpu6050(InvenSense):
    """An MPU-6050 or one of its successors."""

    IDENTITY = WHO_AM_I
    KNOWN: ClassVar = {0x68: "MPU-6050", 0x70: "MPU-6500", 0x71: "MPU-9250", 0x73: "MPU-9255"}
    DATA = (ACCEL_XOUT_H, GYRO_XOUT_H, TEMP_OUT_H)
    FIFO = (FIFO_COUNTH, FIFO_R_W)
    POWER = (PWR_MGMT_1, PWR_MGMT_2)
    BANDWIDTHS: ClassVar = {1: 184.0, 2: 94.0, 3: 44.0, 4: 21.0, 5: 10.0, 6: 5.0}
    FILTER_RATE = 1000.0

    @property
    def _is_6050(self) -> bool:
        return self.chip == "MPU-6050"

    def _reset(self) -> None:
        super()._reset()
        if self._is_6050:
            self.capacity, self.thermometer = 1024, (340.0, 36.53)

    def _start(self, rate: float) -> float:
        rate, divider, bandwidth = self._rate(rate)
        self._set_filter(bandwidth)
        self._registers.set(SMPLRT_DIV, divider)
        self._registers.set(GYRO_CONFIG, SELECT_2000_DPS)
        self._registers.set(ACCEL_CONFIG, SELECT_16_G)
        self._registers.set(FIFO_EN, GYROSCOPE_TO_FIFO | ACCELEROMETER_TO_FIFO)
        self._empty_fifo()
        return rate

    def _set_filter(self, code: int) -> None:
        self._registers.set(CONFIG, code)
        if not self._is_6050:  # the 6050's CONFIG filters both sensors
            self._registers.set(ACCEL_CONFIG_2, code)

    def _empty_fifo(self) -> None:
        self._registers.write(USER_CTRL, 0)
        self._registers.write(USER_CTRL, RESET_FIFO)
        self._registers.write(USER_CTRL, ENABLE_FIFO)

    def _test(self) -> None:
        self._set_filter(2)
        self._registers.set(SMPLRT_DIV, 0)
        response = self._responses(self._switch_actuators, self.DATA[1::-1], READINGS, 1e-3)
        if self._is_6050:
            limits = _limits_6050(self._registers.read_block(SELF_TEST_6050, 4))
            self._judge("gyroscope", response[:3], limits[:3], "LSB")
            self._judge("accelerometer", response[3:], limits[3:], "LSB")
        else:
            codes = (self._registers.read_block(start, 3) for start in (SELF_TEST_GYRO_6500, SELF_TEST_ACCEL_6500))
            self._judge_6500(response, *codes)

    def _switch_actuators(self, on: bool) -> None:
        actuators = ALL_AXES if on else 0
        self._registers.set(GYRO_CONFIG, actuators)  # 250 deg/s
        self._registers.set(ACCEL_CONFIG, actuators | (SELECT_8_G if self._is_6050 else 0))


class Icm20948(InvenSense):
    """An ICM-20948, whose registers lie in four banks, one visible at a time. Its magnetometer is not used."""

    IDENTITY = ICM_WHO_AM_I
    KNOWN: ClassVar = {0xEA: "ICM-20948"}
    DATA = (ICM_ACCEL_XOUT_H, ICM_GYRO_XOUT_H, ICM_TEMP_OUT_H)
    FIFO = (ICM_FIFO_COUNTH, ICM_FIFO_R_W)
    POWER = (ICM_PWR_MGMT_1, ICM_PWR_MGMT_2)
    BANDWIDTHS: ClassVar = {2: 119.5, 3: 51.2, 4: 23.9, 5: 11.6, 6: 5.7}  # the accelerometer's: at most 8 Hz narrower
    FILTER_RATE = 1125.0

    def __init__(self, registers: Registers, *arguments: Any, **options: Any) -> None:
        """Set up the chip; see `FifoSource`."""
        registers.write(REG_BANK_SEL, 0x00)  # a program that was killed may have left another bank
        super().__init__(registers, *arguments, **options)

    def _start(self, rate: float) -> float:
        rate, divider, low_pass = self._rate(rate)
        low_pass <<= 3
        self._set_bank_2(
            {
                ODR_ALIGN_EN: 1,  # both sensors sample at the same time
                GYRO_SMPLRT_DIV: divider,
                ACCEL_SMPLRT_DIV_1: 0,
                ACCEL_SMPLRT_DIV_2: divider,
                GYRO_CONFIG_1: USE_FILTER | ICM_SELECT_2000_DPS | low_pass,
                GYRO_CONFIG_2: 0,
                ICM_ACCEL_CONFIG: USE_FILTER | ICM_SELECT_16_G | low_pass,
                ICM_ACCEL_CONFIG_2: 0,
            }
        )
        self._registers.set(FIFO_MODE, 0)  # the newest samples replace the oldest
        self._registers.set(FIFO_EN_2, BOTH_TO_FIFO)
        self._registers.write(ICM_USER_CTRL, ENABLE_FIFO)
        self._empty_fifo()
        return rate

    def _set_bank_2(self, values: dict[int, int]) -> None:
        self._registers.write(REG_BANK_SEL, 0x20)
        for register, value in values.items():
            self._registers.set(register, value)
        self._registers.write(REG_BANK_SEL, 0x00)

    def _empty_fifo(self) -> None:
        self._registers.write(FIFO_RST, ICM_RESET_FIFO)
        self._registers.write(FIFO_RST, 0)

    def _test(self) -> None:
        low_pass = 2 << 3
        self._set_bank_2(
            {
                GYRO_SMPLRT_DIV: 0,
                ACCEL_SMPLRT_DIV_2: 0,
                GYRO_CONFIG_1: USE_FILTER | low_pass,  # 250 deg/s
                ICM_ACCEL_CONFIG: USE_FILTER | low_pass,  # 2 g
            }
        )
        response = self._responses(self._switch_actuators, self.DATA[1::-1], READINGS, 1e-3)
        self._registers.write(REG_BANK_SEL, 0x10)
        gyroscope_codes = self._registers.read_block(ICM_SELF_TEST_GYRO, 3)
        accelerometer_codes = self._registers.read_block(ICM_SELF_TEST_ACCEL, 3)
        self._registers.write(REG_BANK_SEL, 0x00)
        self._judge_6500(response, gyroscope_codes, accelerometer_codes)

    def _switch_actuators(self, on: bool) -> None:
        self._set_bank_2({GYRO_CONFIG_2: on * GYROSCOPE_ACTUATORS, ICM_ACCEL_CONFIG_2: on * ACCELEROMETER_ACTUATORS})


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
