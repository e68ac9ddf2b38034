"""WitMotion sensors (WT901, WT61, HWT905 ...) on a serial port: packets of 11 bytes, 0x55, type, data, checksum.

Data sheet WT901 v20-0702, 5.1 and 5.2; "WIT Standard Communication Protocol". The sensor fuses by itself; its angles
turn about z, y', x'', and its world is east, north, up. Rate and content are set at each opening, and not saved.
"""

from __future__ import annotations

import struct

from exo_gravity.core.errors import DeviceError, ParameterError
from exo_gravity.hardware.imu_sources.fifo_source import RADIANS_PER_DEGREE, acceleration_scale
from exo_gravity.hardware.imu_sources.quaternion import Quaternion, from_angles
from exo_gravity.hardware.imu_sources.sampled_source import Axes, Measurement
from exo_gravity.hardware.imu_sources.serial_port import Packets, SerialPort
from exo_gravity.hardware.imu_sources.serial_source import SerialSource
from exo_gravity.hardware.imu_sources.source import Clock

ACCELERATION, ANGULAR_VELOCITY, ANGLES, QUATERNION = 0x51, 0x52, 0x53, 0x59
LENGTH = 11
UNLOCK = b"\xff\xaa\x69\x88\xb5"
CONTENT = b"\xff\xaa\x02\x0e\x02"  # RSW: quaternion, angles, angular velocity, acceleration
PACKETS_A_SAMPLE = 4
RATES = {20.0: 0x07, 50.0: 0x08, 100.0: 0x09, 200.0: 0x0B}  # Hz: RRATE
BITS_A_BYTE = 10  # on the wire
RADIANS_PER_LSB = RADIANS_PER_DEGREE * 2000.0 / 32768
ACCELERATION_PER_LSB = acceleration_scale(32768 / 16.0)
ANGLE_PER_LSB = RADIANS_PER_DEGREE * 180.0 / 32768

Numbers = tuple[int, int, int, int]  # of a packet


class WitMotion(SerialSource):
    """A WitMotion sensor. A sample is complete with its orientation: a quaternion, or angles if it sends none."""

    def __init__(self, port: str, baud: int, rate: float, clock: Clock) -> None:
        """Open the port and set the sensor's rate. Raises DeviceError, ParameterError."""
        rate = min(RATES, key=lambda candidate: abs(candidate - rate))
        needed = int(rate * PACKETS_A_SAMPLE * LENGTH * BITS_A_BYTE)
        if baud < needed:
            raise ParameterError("serial.baud", baud, f"{needed} or more for {rate:g} samples a second")
        opened = SerialPort("WitMotion", port, baud)
        super().__init__(opened, Packets(b"\x55", LENGTH, _is_whole), rate, clock)
        self._parts: dict[int, Numbers] = {}  # of the present sample, by type
        self._last_type = 0  # that completes a sample
        self._begun = False
        self._skipped = 0  # samples since the last whole one
        try:
            opened.write(UNLOCK + CONTENT + bytes((0xFF, 0xAA, 0x03, RATES[rate], 0x00)))
        except DeviceError:
            opened.close()
            raise

    def _decode(self, packet: bytes) -> Measurement | None:
        kind, numbers = packet[1], struct.unpack_from("<4h", packet, 2)
        if kind not in (ACCELERATION, ANGULAR_VELOCITY, ANGLES, QUATERNION):
            return None
        if kind == ACCELERATION:  # a sample begins
            self.temperature = numbers[3] / 100.0
            if self._begun:  # from the second one on it is known which packets this sensor sends
                self._skipped += bool(self._parts) and bool(self._last_type)
                self._last_type = max(self._last_type, *self._parts, 0)
            self._begun, self._parts = True, {}
        self._parts[kind] = numbers
        if kind != self._last_type:
            return None
        parts, self._parts = self._parts, {}
        if not {ACCELERATION, ANGULAR_VELOCITY} <= parts.keys():
            self._skipped += 1
            return None
        skipped, self._skipped = self._skipped, 0
        return Measurement(
            _axes(parts[ANGULAR_VELOCITY], RADIANS_PER_LSB),
            _axes(parts[ACCELERATION], ACCELERATION_PER_LSB),
            _orientation(parts),
            skipped,
        )


def _orientation(parts: dict[int, Numbers]) -> Quaternion | None:
    if QUATERNION in parts:
        w, x, y, z = (number / 32768 for number in parts[QUATERNION])
        return x, y, z, w
    if ANGLES in parts:
        roll, pitch, yaw, _ = (number * ANGLE_PER_LSB for number in parts[ANGLES])
        return from_angles(("z", yaw), ("y", pitch), ("x", roll))
    return None


def _is_whole(packet: bytes) -> bool:
    return 0x50 <= packet[1] <= 0x5F and sum(packet[:10]) & 0xFF == packet[10]


def _axes(numbers: Numbers, scale: float) -> Axes:
    x, y, z, _ = numbers
    return x * scale, y * scale, z * scale
