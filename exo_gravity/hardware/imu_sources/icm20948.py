"""ICM-20948: its registers lie in four banks, of which REG_BANK_SEL shows one at a time.

Register map: DS-000189 1.3; numbers checked against PX4, InvenSense_ICM20948_registers.hpp.
"""

from __future__ import annotations

from typing import Any, ClassVar

from exo_gravity.hardware.imu_sources.i2c import Registers
from exo_gravity.hardware.imu_sources.invensense import (
    Fifo,
    InvenSense,
    Thermometer,
    accelerometer_6500_passes,
    factory_6500,
    gyroscope_6500_passes,
)

REG_BANK_SEL = 0x7F  # in every bank
# bank 0
WHO_AM_I, USER_CTRL, PWR_MGMT_1, PWR_MGMT_2 = 0x00, 0x03, 0x06, 0x07
ACCEL_XOUT_H, GYRO_XOUT_H, TEMP_OUT_H = 0x2D, 0x33, 0x39
FIFO_EN_2, FIFO_RST, FIFO_MODE, FIFO_COUNTH, FIFO_R_W = 0x67, 0x68, 0x69, 0x70, 0x72
# bank 1
SELF_TEST_GYRO, SELF_TEST_ACCEL = 0x02, 0x0E
# bank 2
GYRO_SMPLRT_DIV, GYRO_CONFIG_1, GYRO_CONFIG_2, ODR_ALIGN_EN = 0x00, 0x01, 0x02, 0x09
ACCEL_SMPLRT_DIV_1, ACCEL_SMPLRT_DIV_2, ACCEL_CONFIG, ACCEL_CONFIG_2 = 0x10, 0x11, 0x14, 0x15

RESET, BEST_CLOCK = 0x80, 0x01  # PWR_MGMT_1
ENABLE_FIFO = 0x40  # USER_CTRL
BOTH_TO_FIFO = 0x1E  # FIFO_EN_2: accelerometer, gyroscope z, y, x
RESET_FIFO = 0x1F  # FIFO_RST
USE_FILTER, SELECT_2000_DPS, SELECT_16_G = 0x01, 0x06, 0x06  # GYRO_CONFIG_1, ACCEL_CONFIG; the filter in bits 5:3
GYROSCOPE_ACTUATORS, ACCELEROMETER_ACTUATORS = 0x38, 0x1C  # GYRO_CONFIG_2, ACCEL_CONFIG_2
# Hz of the low-pass filters by their code: the gyroscope's; the accelerometer's are at most 8 Hz narrower
BANDWIDTHS = {2: 119.5, 3: 51.2, 4: 23.9, 5: 11.6, 6: 5.7}
FILTER_RATE = 1125.0  # Hz, divided by 1 + SMPLRT_DIV
START_UP = 0.1  # s after a reset, and after waking


class Icm20948(InvenSense):
    """An ICM-20948; its magnetometer is not used."""

    IDENTITY = WHO_AM_I
    KNOWN: ClassVar = {0xEA: "ICM-20948"}
    READING = (ACCEL_XOUT_H, GYRO_XOUT_H)
    fifo = Fifo(FIFO_COUNTH, FIFO_R_W, 512)
    thermometer = Thermometer(TEMP_OUT_H, 333.87, 21.0)

    def __init__(self, registers: Registers, *arguments: Any, **options: Any) -> None:
        """Set up the chip; see `FifoSource`."""
        registers.write(REG_BANK_SEL, 0x00)  # WHO_AM_I is in bank 0; a program that was killed may have left another
        super().__init__(registers, *arguments, **options)

    def _reset(self) -> None:
        self._registers.write(PWR_MGMT_1, RESET)
        self._wait(START_UP)
        self._registers.write(PWR_MGMT_1, BEST_CLOCK)
        self._wait(START_UP)
        self._registers.set(PWR_MGMT_2, 0)

    def _start(self, rate: float) -> float:
        divider = min(max(round(FILTER_RATE / rate) - 1, 0), 255)
        rate = FILTER_RATE / (1 + divider)
        low_pass = next((code for code, width in BANDWIDTHS.items() if width <= rate / 2), 6) << 3
        self._set_bank_2(
            {
                ODR_ALIGN_EN: 1,  # both sensors sample at the same time
                GYRO_SMPLRT_DIV: divider,
                ACCEL_SMPLRT_DIV_1: 0,
                ACCEL_SMPLRT_DIV_2: divider,
                GYRO_CONFIG_1: USE_FILTER | SELECT_2000_DPS | low_pass,
                GYRO_CONFIG_2: 0,
                ACCEL_CONFIG: USE_FILTER | SELECT_16_G | low_pass,
                ACCEL_CONFIG_2: 0,
            }
        )
        self._registers.set(FIFO_MODE, 0)  # the newest samples replace the oldest
        self._registers.set(FIFO_EN_2, BOTH_TO_FIFO)
        self._registers.write(USER_CTRL, ENABLE_FIFO)
        self._empty_fifo()
        return rate

    def _set_bank_2(self, values: dict[int, int]) -> None:
        self._registers.write(REG_BANK_SEL, 0x20)
        for register, value in values.items():
            self._registers.set(register, value)
        self._registers.write(REG_BANK_SEL, 0x00)

    def _empty_fifo(self) -> None:
        self._registers.write(FIFO_RST, RESET_FIFO)
        self._registers.write(FIFO_RST, 0)

    def _test(self) -> None:
        low_pass = 2 << 3
        self._set_bank_2(
            {
                GYRO_SMPLRT_DIV: 0,
                ACCEL_SMPLRT_DIV_2: 0,
                GYRO_CONFIG_1: USE_FILTER | low_pass,  # 250 deg/s
                ACCEL_CONFIG: USE_FILTER | low_pass,  # 2 g
            }
        )
        gyroscope, accelerometer = self._responses(self._switch_actuators)
        self._registers.write(REG_BANK_SEL, 0x10)
        gyroscope_codes = self._registers.read_block(SELF_TEST_GYRO, 3)
        accelerometer_codes = self._registers.read_block(SELF_TEST_ACCEL, 3)
        self._registers.write(REG_BANK_SEL, 0x00)
        self._judge("gyroscope", gyroscope, factory_6500(gyroscope_codes), gyroscope_6500_passes)
        self._judge("accelerometer", accelerometer, factory_6500(accelerometer_codes), accelerometer_6500_passes)

    def _switch_actuators(self, on: bool) -> None:
        self._set_bank_2({GYRO_CONFIG_2: on * GYROSCOPE_ACTUATORS, ACCEL_CONFIG_2: on * ACCELEROMETER_ACTUATORS})
