# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""IMU chips on an I2C bus, read by Adafruit's CircuitPython drivers.

The drivers know the registers and the scales. They return the chip's newest values and queue none. So a chip measures
at least twice as often as it is read, and a sample's time is that of its reading. Ranges are the widest of the chip,
2000 deg/s and 16 g, so that no motion of a trunk clips.
"""

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from exo_gravity.core.errors import DeviceError, ParameterError
from exo_gravity.core.trunk.checks import ImuSample
from exo_gravity.hardware.imu_source import ImuSource, StampClock


@dataclass(frozen=True)
class Polling:
    """How a chip is set up and read."""

    highest_rate: float = 250.0  #: Hz; a sample takes 1 to 3 ms, and the thread that reads rests for at least 2 ms
    passed: float = 0.6  #: share of the rate: a low-pass filter of about half of it keeps faster vibrations out
    early: float = 0.25  #: of a period, by which a sample may be read before it is due: the thread polls twice a period
    temperature_period: float = 1.0  #: s


POLLING = Polling()

Driver = Any  # of Adafruit: `gyro` in rad/s and `acceleration` in m/s^2, three axes each; perhaps `temperature` in degC
Connect = Callable[[Any, int, float], Driver]


def widest(bandwidths: Mapping[int, float], rate: float) -> int:
    """Return the code of the widest filter, of those in Hz by their codes, that suits `rate` samples a second."""
    return max((width, code) for code, width in bandwidths.items() if width <= POLLING.passed * rate)[1]


def connect_mpu6050(bus: Any, address: int, rate: float) -> Driver:
    """Return the driver of an MPU-6050 that measures 1000 times a second."""
    from adafruit_mpu6050 import MPU6050, Bandwidth, GyroRange, Range

    chip = MPU6050(bus, address)
    chip.gyro_range, chip.accelerometer_range = GyroRange.RANGE_2000_DPS, Range.RANGE_16_G
    widths = {Bandwidth.BAND_94_HZ: 94, Bandwidth.BAND_44_HZ: 44, Bandwidth.BAND_21_HZ: 21, Bandwidth.BAND_10_HZ: 10}
    chip.filter_bandwidth = widest(widths, rate)
    return chip


def connect_icm20948(bus: Any, address: int, rate: float) -> Driver:
    """Return the driver of an ICM-20948 that measures 1125 times a second; its magnetometer is not used."""
    from adafruit_icm20x import ICM20948, AccelDLPFFreq, AccelRange, GyroDLPFFreq, GyroRange

    chip = ICM20948(bus, address)
    chip.gyro_range, chip.accelerometer_range = GyroRange.RANGE_2000_DPS, AccelRange.RANGE_16G
    chip.gyro_data_rate_divisor = chip.accelerometer_data_rate_divisor = 0
    gyro, accelerometer = (
        {code: width for code, width in filters.string.items() if code != filters.DISABLED}
        for filters in (GyroDLPFFreq, AccelDLPFFreq)
    )
    chip.gyro_dlpf_cutoff, chip.accel_dlpf_cutoff = widest(gyro, rate), widest(accelerometer, rate)
    return chip


def connect_lsm6dsox(bus: Any, address: int, rate: float) -> Driver:
    """Return the driver of an LSM6DSOX or LSM6DSO; its filters follow the rate at which it measures."""
    from adafruit_lsm6ds import AccelRange, GyroRange, Rate
    from adafruit_lsm6ds.lsm6dsox import LSM6DSOX

    chip = LSM6DSOX(bus, address)
    chip.gyro_range, chip.accelerometer_range = GyroRange.RANGE_2000_DPS, AccelRange.RANGE_16G
    fast_enough = ((measured, code) for code, measured in Rate.string.items() if measured >= 2.0 * rate)
    chip.gyro_data_rate = chip.accelerometer_data_rate = min(fast_enough)[1]
    return chip


#: By the value of the parameter `source`: the address that the usual boards have, and what connects the driver.
CHIPS: dict[str, tuple[int, Connect]] = {
    "mpu6050": (0x68, connect_mpu6050),
    "icm20948": (0x69, connect_icm20948),
    "lsm6dsox": (0x6A, connect_lsm6dsox),
}


class PolledChip(ImuSource):
    """A chip that is asked for its newest values `rate` times a second."""

    silence = "its values do not change: its supply may have broken down"

    def __init__(self, values: Mapping[str, Any], clock: StampClock) -> None:
        """Open the chip that the values of `imu`'s parameters name. Raises DeviceError, ParameterError."""
        kind, number, rate = values["source"], values["i2c.bus"], values["rate"]
        usual_address, connect = CHIPS[kind]
        address = values["i2c.address"] or usual_address
        super().__init__(f"{kind} at 0x{address:02X} on /dev/i2c-{number}")
        if rate > POLLING.highest_rate:
            raise ParameterError("rate", rate, f"{POLLING.highest_rate:g} or less for a chip on I2C")
        self._period, self._clock = 1.0 / rate, clock
        self._due = self._temperature_due = -math.inf  # s, of the next reading
        self._last: object = None  # what was read before
        self._has_failed = False  # whether the last reading did
        self._bus: Any = None
        try:
            from adafruit_extended_bus import ExtendedI2C

            self._bus = ExtendedI2C(number, frequency=None)  # the bus keeps the frequency that the system sets
            self._chip = connect(self._bus, address, rate)
        except ImportError as error:
            raise ParameterError("source", kind, f"topic, or install the extra imu ({error.name} is missing)") from None
        except (OSError, ValueError) as error:
            self.close()
            raise DeviceError(self.name, f"cannot be opened: {error}") from None
        except RuntimeError as error:  # the driver found another chip
            self.close()
            hint = "a chip of another kind is read by its ROS driver, with source: topic"
            raise DeviceError(self.name, f"{error} ({hint})") from None

    def read(self) -> list[ImuSample]:
        """Return a sample if one is due. One failed transfer costs a sample, a second in a row raises DeviceError."""
        now = self._clock()
        behind = (now - self._due) / self._period
        if -2.0 < behind < -POLLING.early:  # further ahead: the clock was set back
            return []
        if 1.0 <= behind < math.inf:
            self.lost, self.loss = self.lost + int(behind), "read too late"
        self._due = self._period + (self._due if abs(behind) < 1.0 else now)
        try:
            values = self._chip.gyro, self._chip.acceleration
            taken = 0.5 * (now + self._clock())
            if not now < self._temperature_due <= now + POLLING.temperature_period:
                self._temperature_due = now + POLLING.temperature_period
                self.temperature = getattr(self._chip, "temperature", None)
        except OSError as error:
            if self._has_failed:
                raise DeviceError(self.name, f"does not answer: {error.strerror or error}") from None
            self._has_failed = True
            self.lost, self.loss = self.lost + 1, "a transfer failed"
            return []
        self._has_failed = False
        if values == self._last:  # it has not measured since
            return []
        self._last = values
        return [ImuSample(taken, *values)]

    def close(self) -> None:
        """Close the bus; never raises."""
        if self._bus is not None:
            with contextlib.suppress(OSError):
                self._bus.deinit()
