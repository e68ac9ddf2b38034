# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Sensors on serial ports, through `pyserial`: packets of a fixed length, cut out of a stream of bytes.

WitMotion (WT901, WT61, HWT905 ...): packets of 11 bytes, 0x55, type, data, checksum. Data sheet WT901 v20-0702, 5.1 and
5.2; "WIT Standard Communication Protocol". The sensor fuses by itself; its angles turn about z, y', x'', and its world
is east, north, up. Rate and content are set at each opening, and not saved.

BNO085 (BNO080, BNO086) in its UART-RVC mode: 100 packets of 19 bytes a second, already fused. 0xAA 0xAA, a counter,
yaw, pitch, roll in 0.01 degrees, acceleration x y z in mg with gravity, three reserved bytes, the sum of all but the
header (data sheet 1000-3927, 1.3.5.2). There is no gyroscope in it. It yaws about z, pitches about x' and rolls about
y'', by the data sheet's example, which its text contradicts (docs/imu.md).
"""

import contextlib
import math
import struct
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

from exo_gravity.core.arm.arm_data import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import ZERO, Quaternion, plus, product
from exo_gravity.core.errors import DeviceError, ParameterError
from exo_gravity.core.trunk.imu_checks import ImuSample
from exo_gravity.hardware.imu_sources.sample_clock import SampleClock
from exo_gravity.hardware.imu_sources.source import RADIANS_PER_DEGREE, Axes, ImuSource, StampClock

ACCELERATION, ANGULAR_VELOCITY, ANGLES, QUATERNION = 0x51, 0x52, 0x53, 0x59
UNLOCK = b"\xff\xaa\x69\x88\xb5"
CONTENT = b"\xff\xaa\x02\x0e\x02"  # RSW: quaternion, angles, angular velocity, acceleration
PACKETS_A_SAMPLE = 4
RATES = {20.0: 0x07, 50.0: 0x08, 100.0: 0x09, 200.0: 0x0B}  # Hz: RRATE
BITS_A_BYTE = 10  # on the wire
RATE_PER_LSB = RADIANS_PER_DEGREE * 2000.0 / 32768
WITMOTION_ACCELERATION = STANDARD_GRAVITY * 16.0 / 32768
WITMOTION_ANGLE = RADIANS_PER_DEGREE * 180.0 / 32768

Numbers = tuple[int, int, int, int]  # of a packet

RVC_RATE = 100.0  # Hz, fixed
RVC_ANGLE, RVC_ACCELERATION = 0.01 * RADIANS_PER_DEGREE, 1e-3 * STANDARD_GRAVITY


class Measurement(NamedTuple):
    """A sample without its time; None marks what the sensor does not report."""

    angular_velocity: Axes | None  #: rad/s
    acceleration: Axes  #: m/s^2
    orientation: Quaternion | None
    skipped: int  #: samples before it that the sensor took but that never arrived


class SerialSource(ImuSource):
    """Base of the sensors on serial ports. After lost or extra bytes the start of a packet is found again."""

    DEVICE: ClassVar[str]
    HEADER: ClassVar[bytes]
    LENGTH: ClassVar[int]  # bytes of a packet
    SUMMED: ClassVar[int]  # the first byte that counts into the sum in its last one

    def __init__(self, values: Mapping[str, Any], rate: float, clock: StampClock) -> None:
        """Open the port of the parameter values for `rate` samples a second. Raises DeviceError, ParameterError."""
        port = values["serial.port"]
        if not port:
            raise ParameterError("serial.port", port, "the sensor's port, e.g. /dev/ttyUSB0")
        super().__init__(f"{self.DEVICE} on {port}")
        try:
            import serial
        except ImportError:
            expected = "topic, or install the extra imu (serial is missing)"
            raise ParameterError("source", values["source"], expected) from None
        try:
            self._port = serial.Serial(port, values["serial.baud"], timeout=0, write_timeout=0.2)
        except (OSError, ValueError) as error:  # pyserial's own errors are OSErrors
            raise DeviceError(self.name, f"cannot be opened: {error}") from None
        self._clock, self._sample_clock = clock, SampleClock(rate)
        self._pending = bytearray()
        self._in_step = False  # whether the last packet has arrived well
        self._why_lost = ""  # of samples that are not counted yet
        self.silence = "not one byte"

    def close(self) -> None:
        """Close the port; never raises."""
        with contextlib.suppress(OSError):
            self._port.close()

    def read(self) -> list[ImuSample]:
        """Return every sample that has arrived since the last call. Raises DeviceError."""
        arrival = self._clock()
        measured = [measurement for packet in self._packets() if (measurement := self._decode(packet))]
        stamps = self._sample_clock.stamps(arrival, [measurement.skipped for measurement in measured])
        if self._sample_clock.lost > self.lost:
            self.lost, self.loss = self._sample_clock.lost, self._why_lost or "not read in time"
            self._why_lost = ""
        return [
            ImuSample(stamp, one.angular_velocity, one.acceleration, one.orientation)
            for stamp, one in zip(stamps, measured, strict=True)
        ]

    def _packets(self) -> list[bytes]:
        """Return the whole packets that have arrived since the last call."""
        try:
            data = self._port.read(self._port.in_waiting)
        except OSError as error:
            raise DeviceError(self.name, f"cannot be read: {error}") from None
        self._pending += data
        packets, at = [], 0
        while len(self._pending) - at >= self.LENGTH:
            packet = bytes(self._pending[at : at + self.LENGTH])
            is_whole = packet.startswith(self.HEADER) and self._is_whole(packet)
            if is_whole:
                packets.append(packet)
            elif self._in_step:
                self._why_lost = "damaged packets"
            self._in_step = is_whole
            at += self.LENGTH if is_whole else 1
        del self._pending[:at]
        if data:
            self.silence = "not one byte" if packets else "bytes, but no whole packet: is serial.baud the sensor's?"
        return packets

    def _is_whole(self, packet: bytes) -> bool:
        """Return whether the sum of the packet's content is right."""
        return sum(packet[self.SUMMED : -1]) & 0xFF == packet[-1]

    @abstractmethod
    def _decode(self, packet: bytes) -> Measurement | None:
        """Return the measurement that a packet completes."""


class WitMotion(SerialSource):
    """A WitMotion sensor. A sample is complete with its orientation: a quaternion, or angles if it sends none."""

    DEVICE, HEADER, LENGTH, SUMMED = "WitMotion", b"\x55", 11, 0

    def __init__(self, values: Mapping[str, Any], clock: StampClock) -> None:
        """Open the port and set the sensor's rate. Raises DeviceError, ParameterError."""
        rate, baud = min(RATES, key=lambda candidate: abs(candidate - values["rate"])), values["serial.baud"]
        needed = int(rate * PACKETS_A_SAMPLE * self.LENGTH * BITS_A_BYTE)
        if baud < needed:
            raise ParameterError("serial.baud", baud, f"{needed} or more for {rate:g} samples a second")
        super().__init__(values, rate, clock)
        self._parts: dict[int, Numbers] = {}  # of the present sample, by type
        self._last_type = 0  # that completes a sample
        self._begun = False
        self._skipped = 0  # samples since the last whole one
        try:
            self._port.write(UNLOCK + CONTENT + bytes((0xFF, 0xAA, 0x03, RATES[rate], 0x00)))
        except OSError as error:
            self.close()
            raise DeviceError(self.name, f"cannot be written: {error}") from None

    def _is_whole(self, packet: bytes) -> bool:
        return 0x50 <= packet[1] <= 0x5F and super()._is_whole(packet)

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
        orientation: Quaternion | None = None
        if QUATERNION in parts:
            w, x, y, z = (number / 32768 for number in parts[QUATERNION])
            orientation = x, y, z, w
        elif ANGLES in parts:
            roll, pitch, yaw, _ = (number * WITMOTION_ANGLE for number in parts[ANGLES])
            orientation = from_angles(("z", yaw), ("y", pitch), ("x", roll))
        rate = plus(ZERO, parts[ANGULAR_VELOCITY][:3], RATE_PER_LSB)
        return Measurement(rate, plus(ZERO, parts[ACCELERATION][:3], WITMOTION_ACCELERATION), orientation, skipped)


class Bno085(SerialSource):
    """A BNO085 with PS0 high and PS1 low, which selects UART-RVC."""

    DEVICE, HEADER, LENGTH, SUMMED = "BNO085", b"\xaa\xaa", 19, 2

    def __init__(self, values: Mapping[str, Any], clock: StampClock) -> None:
        """Open the port. Raises DeviceError, ParameterError."""
        super().__init__(values, RVC_RATE, clock)
        self._counter: int | None = None

    def _decode(self, packet: bytes) -> Measurement:
        counter, yaw, pitch, roll, x, y, z = struct.unpack_from("<B6h", packet, 2)
        skipped = 0 if self._counter is None else (counter - self._counter - 1) & 0xFF
        self._counter = counter
        orientation = from_angles(("z", yaw * RVC_ANGLE), ("x", pitch * RVC_ANGLE), ("y", roll * RVC_ANGLE))
        return Measurement(None, plus(ZERO, (x, y, z), RVC_ACCELERATION), orientation, skipped)


def from_angles(*turns: tuple[str, float]) -> Quaternion:
    """Return the orientation after turns by (axis, rad) in order, each about an axis of the body as turned so far."""
    q: Quaternion = (0.0, 0.0, 0.0, 1.0)
    for axis, angle in turns:
        x, y, z = (math.sin(angle / 2) * (axis == other) for other in "xyz")
        q = product(q, (x, y, z, math.cos(angle / 2)))
    return q
