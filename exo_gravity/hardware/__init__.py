# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Devices: the CAN bus of the motors, the IMU. Drivers raise, nodes decide.

The estimator is imported when it is used: the bridge and its watchdog do without it and its filter.
"""

from typing import TYPE_CHECKING

from exo_gravity.core.names import imported_when_used

if TYPE_CHECKING:
    from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator

__all__ = ["ImuSample", "TrunkEstimator"]
__getattr__ = imported_when_used(__name__, {"trunk_estimator": __all__})
