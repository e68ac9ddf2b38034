# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Devices: the CAN bus of the motors, the IMU. Drivers raise, nodes decide."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator

__all__ = ["ImuSample", "TrunkEstimator"]


def __getattr__(name: str) -> Any:
    """Import the estimator on first use: the bridge and its watchdog do without it and its filter."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from exo_gravity.hardware import trunk_estimator

    return getattr(trunk_estimator, name)
