"""LSM6DSOX and LSM6DSO: the FIFO holds words of 7 bytes, a tag and one sensor's three axes, low byte first.

Registers, scales and self-test limits: STMicroelectronics' lsm6dsox_reg.h and its self-test example; data sheets
DS12814 (LSM6DSOX), DS12140 (LSM6DSO).
"""

from typing import ClassVar

from exo_gravity.core.arm.arm import STANDARD_GRAVITY
from exo_gravity.core.errors import DeviceError
from exo_gravity.hardware.imu_sources.i2c import FifoSource
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
# Tag: what an LSB is. The gyroscope at 2000 deg/s, the accelerometer at 16 g.
SCALES = {1: 0.070 * RADIANS_PER_DEGREE, 2: 0.488e-3 * STANDARD_GRAVITY}
# In the self-test, at 4 g and 2000 deg/s: what an LSB is, and the limits.
RESPONSES = (0.070, (150.0, 700.0), "deg/s"), (0.122, (50.0, 1700.0), "mg")  # gyroscope, accelerometer


class Lsm6dsox(FifoSource):
    """An LSM6DSOX or LSM6DSO. Its low-pass filters follow its rate without further registers."""

    WHO_AM_I, TEMPERATURE, ORDER, SETTLING, PACKET = WHO_AM_I, OUT_TEMP_L, "<", 0.1, 7
    KNOWN: ClassVar = {0x6C: "LSM6DSOX"}
    thermometer = 256.0, 25.0
    _half: tuple[int, int, Axes] | None = None  # tag, time slot and axes that wait for the other sensor's

    def _set_up(self, rate: float, self_test: bool) -> float:
        self._write(CTRL3_C, SOFTWARE_RESET)
        for _ in range(10):
            self._wait(0.01)
            if not self._read(CTRL3_C) & SOFTWARE_RESET:
                break
        else:
            raise DeviceError(self.name, "does not finish its reset", CTRL3_C)
        self._set({CTRL9_XL: NO_I3C, CTRL3_C: WHOLE_SAMPLES})
        if self_test:
            self._test(1, CTRL1_XL, SELECT_4_G, 52.0, OUTX_L_A, 0x01)
            self._test(0, CTRL2_G, SELECT_2000_DPS, 208.0, OUTX_L_G, 0x04)
        rate = min(RATES, key=lambda candidate: abs(candidate - rate))
        code = RATES[rate]
        rates = {FIFO_CTRL3: code << 4 | code, CTRL1_XL: code << 4 | SELECT_16_G, CTRL2_G: code << 4 | SELECT_2000_DPS}
        self._set(rates)
        self._empty_fifo()
        return rate

    def _test(self, sensor: int, control: int, scale: int, rate: float, data: int, actuators: int) -> None:
        """Compare means of 5 samples with the actuators off and on, as the manufacturer's example does."""
        self._set({control: RATES[rate] << 4 | scale})
        # The chip's clock may be slow.
        response = self._responses({CTRL5_C: 0}, {CTRL5_C: actuators}, [data], 5, 1.1 / rate)
        self._set({CTRL5_C: 0, control: OFF})
        lsb, limits, unit = RESPONSES[sensor]
        for axis, value in enumerate(response):
            self._judge(3 * sensor + axis, abs(lsb * value), limits, unit)

    def _empty_fifo(self) -> None:
        self._half = None
        self._write(FIFO_CTRL4, OFF)
        self._write(FIFO_CTRL4, CONTINUOUS)

    def _queue(self) -> tuple[int, int | None]:
        low, high = self._read_block(FIFO_STATUS1, 2)
        return FIFO_DATA_OUT_TAG, None if high & LOST_WORDS else (high & 0x03) << 8 | low

    def _decode(self, packet: bytes) -> Measurement | None:
        """Return the measurement that a word completes: one word of each sensor with the same time slot (TAG_CNT)."""
        tag, slot = packet[0] >> 3, packet[0] >> 1 & 0x03
        if tag not in SCALES:
            return None
        half, other = (tag, slot, self._axes(packet[1:], SCALES[tag])), self._half
        self._half = half
        if other is None or other[0] == tag or other[1] != slot:
            return None
        self._half = None
        gyroscope, accelerometer = sorted((half, other))
        return Measurement(gyroscope[2], accelerometer[2])
