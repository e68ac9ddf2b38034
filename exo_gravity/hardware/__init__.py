# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Devices: the CAN bus of the motors, the IMU. Drivers raise, nodes decide.

The estimator is imported when it is used: the bridge and its watchdog do without it and its filter.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator

__all__ = ["ImuSample", "TrunkEstimator"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(import_module(f"{__name__}.trunk_estimator"), name)
