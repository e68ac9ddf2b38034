"""MPU-6050, and its successors with the same registers: MPU-6500, MPU-9250, MPU-9255.

Register map: RM-MPU-6000A-00 4.2, RM-MPU-9250A-00 1.4; numbers checked against Linux, inv_mpu_iio.h.
"""

from __future__ import annotations

from typing import ClassVar

from exo_gravity.hardware.imu_sources.invensense import (
    Fifo,
    InvenSense,
    Thermometer,
    accelerometer_6500_passes,
    factory_6500,
    gyroscope_6500_passes,
)

SELF_TEST_GYRO_6500, SELF_TEST_6050, SELF_TEST_ACCEL_6500 = 0x00, 0x0D, 0x0D
SMPLRT_DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG, ACCEL_CONFIG_2 = 0x19, 0x1A, 0x1B, 0x1C, 0x1D
FIFO_EN, ACCEL_XOUT_H, TEMP_OUT_H, GYRO_XOUT_H = 0x23, 0x3B, 0x41, 0x43
USER_CTRL, PWR_MGMT_1, PWR_MGMT_2, FIFO_COUNTH, FIFO_R_W, WHO_AM_I = 0x6A, 0x6B, 0x6C, 0x72, 0x74, 0x75

RESET, CLOCK_OF_GYROSCOPE = 0x80, 0x01  # PWR_MGMT_1
GYROSCOPE_TO_FIFO, ACCELEROMETER_TO_FIFO = 0x70, 0x08  # FIFO_EN
ENABLE_FIFO, RESET_FIFO = 0x40, 0x04  # USER_CTRL
SELECT_2000_DPS = SELECT_16_G = 0x18
SELECT_8_G, ALL_AXES = 0x10, 0xE0  # ALL_AXES: self-test
BANDWIDTHS = {1: 184.0, 2: 94.0, 3: 44.0, 4: 21.0, 5: 10.0, 6: 5.0}  # Hz of the low-pass filter by DLPF_CFG
FILTER_RATE = 1000.0  # Hz, divided by 1 + SMPLRT_DIV
START_UP = 0.1  # s after a reset, and after waking


class Mpu6050(InvenSense):
    """An MPU-6050 or one of its successors."""

    IDENTITY = WHO_AM_I
    KNOWN: ClassVar = {0x68: "MPU-6050", 0x70: "MPU-6500", 0x71: "MPU-9250", 0x73: "MPU-9255"}
    READING = (ACCEL_XOUT_H, GYRO_XOUT_H)

    @property
    def _is_6050(self) -> bool:
        return self.chip == "MPU-6050"

    def _reset(self) -> None:
        self._registers.write(PWR_MGMT_1, RESET)
        self._wait(START_UP)
        self._registers.write(PWR_MGMT_1, CLOCK_OF_GYROSCOPE)
        self._wait(START_UP)
        self._registers.set(PWR_MGMT_2, 0)
        self.fifo = Fifo(FIFO_COUNTH, FIFO_R_W, 1024 if self._is_6050 else 512)
        self.thermometer = Thermometer(TEMP_OUT_H, *((340.0, 36.53) if self._is_6050 else (333.87, 21.0)))

    def _start(self, rate: float) -> float:
        divider = min(max(round(FILTER_RATE / rate) - 1, 0), 255)
        rate = FILTER_RATE / (1 + divider)
        bandwidth = next((code for code, width in BANDWIDTHS.items() if width <= rate / 2), 6)
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
        gyroscope, accelerometer = self._responses(self._switch_actuators)
        if self._is_6050:
            factory = _factory_6050(self._registers.read_block(SELF_TEST_6050, 4))
            self._judge("gyroscope", gyroscope, factory[0], _passes_6050)
            self._judge("accelerometer", accelerometer, factory[1], _passes_6050)
        else:
            codes = self._registers.read_block(SELF_TEST_GYRO_6500, 3)
            self._judge("gyroscope", gyroscope, factory_6500(codes), gyroscope_6500_passes)
            codes = self._registers.read_block(SELF_TEST_ACCEL_6500, 3)
            self._judge("accelerometer", accelerometer, factory_6500(codes), accelerometer_6500_passes)

    def _switch_actuators(self, on: bool) -> None:
        actuators = ALL_AXES if on else 0
        self._registers.set(GYRO_CONFIG, actuators)  # 250 deg/s
        self._registers.set(ACCEL_CONFIG, actuators | (SELECT_8_G if self._is_6050 else 0))


def _factory_6050(codes: bytes) -> tuple[list[float], list[float]]:
    """Return the factory's responses, gyroscope and accelerometer, in LSB at 250 deg/s and 8 g (RM-MPU-6000A 4.1)."""
    gyroscope, accelerometer = [], []
    for axis, sign in enumerate((1.0, -1.0, 1.0)):
        code = codes[axis] & 0x1F
        gyroscope.append(sign * 25.0 * 131.0 * 1.046 ** (code - 1) if code else 0.0)
        code = codes[axis] >> 5 << 2 | codes[3] >> (4 - 2 * axis) & 3
        accelerometer.append(4096.0 * 0.34 * (0.92 / 0.34) ** ((code - 1) / 30.0) if code else 0.0)
    return gyroscope, accelerometer


def _passes_6050(response: float, factory: float) -> bool:
    """Return whether the response is within 14 % of the factory's (PS-MPU-6000A 6.1); without one it is not judged."""
    return not factory or abs(response / factory - 1.0) <= 0.14
