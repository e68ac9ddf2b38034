"""LSM6DSOX and LSM6DSO: the FIFO holds words of 7 bytes, a tag and one sensor's three axes, low byte first.

Registers, scales and self-test limits: STMicroelectronics' lsm6dsox_reg.h and its self-test example; data sheets
DS12814 (LSM6DSOX), DS12140 (LSM6DSO).
"""

from __future__ import annotations

import struct
from typing import ClassVar

from exo_gravity.core.errors import DeviceError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.hardware.imu_sources.i2c import FifoSource, axes
from exo_gravity.hardware.imu_sources.source import RADIANS_PER_DEGREE, Axes, Measurement

FIFO_CTRL3, FIFO_CTRL4, WHO_AM_I, CTRL1_XL, CTRL2_G, CTRL3_C, CTRL5_C, CTRL9_XL = (
    0x09, 0x0A, 0x0F, 0x10, 0x11, 0x12, 0x14, 0x18,
)  # fmt: skip
OUT_TEMP_L, OUTX_L_G, OUTX_L_A, FIFO_STATUS1, FIFO_DATA_OUT_TAG = 0x20, 0x22, 0x28, 0x3A, 0x78

SOFTWARE_RESET, WHOLE_SAMPLES = 0x01, 0x44  # CTRL3_C: BDU, IF_INC
NO_I3C = 0xE2  # CTRL9_XL: its reset value and I3C_disable
SELECT_4_G, SELECT_16_G, SELECT_2000_DPS = 0x08, 0x04, 0x0C  # CTRL1_XL, CTRL2_G
RATES = {12.5: 1, 26.0: 2, 52.0: 3, 104.0: 4, 208.0: 5, 416.0: 6, 833.0: 7, 1666.0: 8}  # Hz: code
CONTINUOUS, OFF = 0x06, 0x00  # FIFO_CTRL4
LOST_WORDS = 0x48  # FIFO_STATUS2: FIFO_OVR_IA, FIFO_OVR_LATCHED
WORD = 7  # bytes
GYROSCOPE, ACCELEROMETER = 1, 2  # tags

RADIANS_PER_LSB = 0.070 * RADIANS_PER_DEGREE  # at 2000 deg/s
ACCELERATION_PER_LSB = 0.488e-3 * STANDARD_GRAVITY  # at 16 g
MILLI_G_PER_LSB = 0.122  # at 4 g, in the self-test
DEGREES_PER_LSB = 0.070  # per second, in the self-test
Limits = tuple[float, float]
ACCELEROMETER_RESPONSE, GYROSCOPE_RESPONSE = (50.0, 1700.0), (150.0, 700.0)  # mg; deg/s


class Lsm6dsox(FifoSource):
    """An LSM6DSOX or LSM6DSO. Its low-pass filters follow its rate without further registers."""

    IDENTITY = WHO_AM_I
    KNOWN: ClassVar = {0x6C: "LSM6DSOX"}
    SETTLING = 0.1

    def _reset(self) -> None:
        self._half: tuple[int, int, Axes] | None = None  # tag, time slot and axes that wait for the other sensor's
        self._registers.write(CTRL3_C, SOFTWARE_RESET)
        for _ in range(10):
            self._wait(0.01)
            if not self._registers.read(CTRL3_C) & SOFTWARE_RESET:
                break
        else:
            raise DeviceError(self._registers.name, "does not finish its reset", CTRL3_C)
        self._registers.set(CTRL9_XL, NO_I3C)
        self._registers.set(CTRL3_C, WHOLE_SAMPLES)

    def _test(self) -> None:
        """Compare means of 5 samples with the actuators off and on, as the manufacturer's example does."""
        self._registers.set(CTRL1_XL, RATES[52.0] << 4 | SELECT_4_G)
        self._test_sensor("accelerometer", OUTX_L_A, 0x01, 52.0, MILLI_G_PER_LSB, ACCELEROMETER_RESPONSE, "mg")
        self._registers.set(CTRL1_XL, OFF)
        self._registers.set(CTRL2_G, RATES[208.0] << 4 | SELECT_2000_DPS)
        self._test_sensor("gyroscope", OUTX_L_G, 0x04, 208.0, DEGREES_PER_LSB, GYROSCOPE_RESPONSE, "deg/s")
        self._registers.set(CTRL2_G, OFF)

    def _test_sensor(
        self, sensor: str, register: int, actuators: int, rate: float, scale: float, limits: Limits, unit: str
    ) -> None:
        def switch(on: bool) -> None:
            self._registers.set(CTRL5_C, on * actuators)

        response = self._responses(switch, [register], 5, 1.1 / rate, "<")  # the chip's clock may be slow
        switch(False)
        self._judge(sensor, [abs(scale * value) for value in response], [limits] * 3, unit)

    def _start(self, rate: float) -> float:
        rate = min(RATES, key=lambda candidate: abs(candidate - rate))
        code = RATES[rate]
        self._registers.set(FIFO_CTRL3, code << 4 | code)
        self._registers.set(CTRL1_XL, code << 4 | SELECT_16_G)
        self._registers.set(CTRL2_G, code << 4 | SELECT_2000_DPS)
        self._empty_fifo()
        return rate

    def _empty_fifo(self) -> None:
        self._half = None
        self._registers.write(FIFO_CTRL4, OFF)
        self._registers.write(FIFO_CTRL4, CONTINUOUS)

    def _drain(self) -> list[Measurement]:
        low, high = self._registers.read_block(FIFO_STATUS1, 2)
        if high & LOST_WORDS:
            return self._lose("FIFO overflowed")
        data = self._registers.read_block(FIFO_DATA_OUT_TAG, WORD * ((high & 0x03) << 8 | low), WORD)
        words = (data[start : start + WORD] for start in range(0, len(data), WORD))
        return [measurement for word in words if (measurement := self._paired(word))]

    def _paired(self, word: bytes) -> Measurement | None:
        """Return the measurement that `word` completes: one word of each sensor with the same time slot (TAG_CNT)."""
        tag, slot = word[0] >> 3, word[0] >> 1 & 0x03
        if tag == GYROSCOPE:
            half = tag, slot, axes(word[1:], RADIANS_PER_LSB, "<")
        elif tag == ACCELEROMETER:
            half = tag, slot, axes(word[1:], ACCELERATION_PER_LSB, "<")
        else:
            return None
        other, self._half = self._half, half
        if other is None or other[0] == tag or other[1] != slot:
            return None
        self._half = None
        return Measurement(half[2], other[2]) if tag == GYROSCOPE else Measurement(other[2], half[2])

    def _read_temperature(self) -> float:
        (raw,) = struct.unpack("<h", self._registers.read_block(OUT_TEMP_L, 2))
        return float(raw / 256.0 + 25.0)
