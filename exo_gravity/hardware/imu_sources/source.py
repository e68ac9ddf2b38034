"""The seam between the `imu` node and an IMU that it reads itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from exo_gravity.hardware.trunk_estimator import ImuSample

Clock = Callable[[], float]  # s, of ROS or monotonic


class ImuSource(Protocol):
    """An open device. Its samples are in its own axes, in SI units, and stamped when they were taken.

    name: the device and its address, for messages. rate: samples a second that it was set to. lost: samples known to
    be lost since it was opened. temperature: degrees Celsius, None where it reports none.
    """

    @property
    def name(self) -> str:
        """The device and its address."""

    @property
    def rate(self) -> float:
        """Samples a second, as configured."""

    @property
    def lost(self) -> int:
        """Samples lost since the device was opened: overflows, bad checksums, gaps in a counter."""

    @property
    def temperature(self) -> float | None:
        """Degrees Celsius."""

    def read(self) -> list[ImuSample]:
        """Return every sample since the last call, the oldest first, without waiting for one. Raises DeviceError."""

    def close(self) -> None:
        """Release the device; never raises."""
