"""IMUs that the `imu` node reads itself; `open_source` opens the one that the parameters name."""

import time
from collections.abc import Callable, Mapping
from typing import Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.imu_sources.i2c import Bus, FifoSource, open_bus
from exo_gravity.hardware.imu_sources.invensense import Icm20948, Mpu6050
from exo_gravity.hardware.imu_sources.lsm6dsox import Lsm6dsox
from exo_gravity.hardware.imu_sources.serial_sensors import Bno085, WitMotion
from exo_gravity.hardware.imu_sources.source import Clock, ImuSource, Reopening

__all__ = ["ImuSource", "Reopening", "open_source"]

# The address that the usual boards have.
CHIPS: dict[str, tuple[type[FifoSource], int]] = {
    "mpu6050": (Mpu6050, 0x68),
    "icm20948": (Icm20948, 0x69),
    "lsm6dsox": (Lsm6dsox, 0x6A),
}


def open_source(
    values: Mapping[str, Any],
    clock: Clock,
    self_test: bool = True,
    *,
    wait: Callable[[float], Any] = time.sleep,
    open_i2c: Callable[[int], Bus] = open_bus,
) -> ImuSource:
    """Open the IMU that `imu`'s parameter values name by `source`, one of all but 'topic'.

    clock: of the stamps. self_test: test a chip on I2C, which must then be still for a second. Raises DeviceError, and
    ParameterError if a parameter does not suit the device or a library is missing.
    """
    kind = values["source"]
    if kind in CHIPS:
        chip, usual_address = CHIPS[kind]
        number = values["i2c.bus"]
        where = f"/dev/i2c-{number}", values["i2c.address"] or usual_address
        return chip(kind, open_i2c(number), where, values["rate"], clock, wait, self_test)
    port, baud = values["serial.port"], values["serial.baud"]
    if not port:
        raise ParameterError("serial.port", port, "the sensor's port, e.g. /dev/ttyUSB0")
    if kind == "witmotion":
        return WitMotion(port, baud, values["rate"], clock)
    return Bno085(port, baud, clock)
