# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""IMUs that the node `imu` reads itself; `open_source` opens the one that the parameters name."""

from collections.abc import Callable, Mapping
from typing import Any

from exo_gravity.hardware.imu_sources.chips import CHIPS, PolledChip
from exo_gravity.hardware.imu_sources.source import ImuSource, Reopening, StampClock

__all__ = ["SOURCES", "ImuSource", "Reopening", "open_source"]

#: By the value of the parameter `source`: what opens the IMU, given the parameter values and the clock of the stamps.
SOURCES: dict[str, Callable[[Mapping[str, Any], StampClock], ImuSource]] = {
    **dict.fromkeys(CHIPS, PolledChip),
}


def open_source(values: Mapping[str, Any], clock: StampClock) -> ImuSource:
    """Open the IMU that the values of `imu`'s parameters name by `source`, which must not be 'topic'.

    clock: of the stamps. Raises DeviceError, and ParameterError if a value does not suit the device or its library is
    missing.
    """
    return SOURCES[values["source"]](values, clock)
