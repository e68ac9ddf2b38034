"""The seam between the `imu` node and an IMU that it reads itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from exo_gravity.core.trunk.imu_sample import ImuSample

Clock = Callable[[], float]  # s; the clock of the stamps


class ImuSource(Protocol):
    """An open device. Its samples are in its own axes, in SI units, with the time at which they were taken.

    name: the device and its address, for messages. rate: samples a second, as set up. lost: samples known to be lost
    since the device was opened; loss: why the last of them were. temperature: degrees Celsius; None if not reported.
    silence: what may be the reason while no samples come.
    """

    name: str
    rate: float
    lost: int
    loss: str
    temperature: float | None
    silence: str

    def read(self) -> list[ImuSample]:
        """Return every sample since the last call, the oldest first, without waiting for one. Raises DeviceError."""

    def close(self) -> None:
        """Release the device; never raises."""
