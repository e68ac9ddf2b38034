"""BNO085 (BNO080, BNO086) in its UART-RVC mode: 100 packets of 19 bytes a second, already fused.

0xAA 0xAA, a counter, yaw, pitch, roll in 0.01 degrees, acceleration x y z in mg with gravity, three reserved bytes, the
sum of all but the header (data sheet 1000-3927, 1.3.5.2). There is no gyroscope in it.

The data sheet turns by yaw, then pitch, then roll, and calls y the pitch's axis and x the roll's. Its own example
contradicts it: pitch -1.10 and roll 20.85 degrees with an acceleration of (-371, -20, 977) mg, which is what gravity
gives for a pitch about x and a roll about y. So it is done here: yaw about z, pitch about x', roll about y''.
"""

from __future__ import annotations

import struct

from exo_gravity.hardware.imu_sources.fifo_source import RADIANS_PER_DEGREE, acceleration_scale
from exo_gravity.hardware.imu_sources.quaternion import from_angles
from exo_gravity.hardware.imu_sources.sampled_source import Measurement
from exo_gravity.hardware.imu_sources.serial_port import Packets, SerialPort
from exo_gravity.hardware.imu_sources.serial_source import SerialSource
from exo_gravity.hardware.imu_sources.source import Clock

RATE = 100.0  # Hz, fixed
LENGTH = 19
ANGLE_PER_LSB = 0.01 * RADIANS_PER_DEGREE
ACCELERATION_PER_LSB = acceleration_scale(1000.0)


class Bno085(SerialSource):
    """A BNO085 with PS0 high and PS1 low, which selects UART-RVC."""

    def __init__(self, port: str, baud: int, clock: Clock) -> None:
        """Open the port. Raises DeviceError, ParameterError."""
        packets = Packets(b"\xaa\xaa", LENGTH, lambda packet: sum(packet[2:18]) & 0xFF == packet[18])
        super().__init__(SerialPort("BNO085", port, baud), packets, RATE, clock)
        self._counter: int | None = None

    def _decode(self, packet: bytes) -> Measurement:
        counter, yaw, pitch, roll, x, y, z = struct.unpack_from("<B6h", packet, 2)
        skipped = 0 if self._counter is None else (counter - self._counter - 1) & 0xFF
        self._counter = counter
        orientation = from_angles(("z", yaw * ANGLE_PER_LSB), ("x", pitch * ANGLE_PER_LSB), ("y", roll * ANGLE_PER_LSB))
        acceleration = (x * ACCELERATION_PER_LSB, y * ACCELERATION_PER_LSB, z * ACCELERATION_PER_LSB)
        return Measurement(None, acceleration, orientation, skipped)
