# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A trunk that sways, as ordinary drivers of an IMU deliver it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from bench.ordinary.drivers import Timing

from .imu_faults import Motion, Trunk, sampled

SWAY, SWAY_SPEED = math.radians(14.0), 2.0 * math.pi * 0.2  # rad, rad/s
GYROSCOPE_SPAN = 0.002  # s over which its low-pass filter averages


def swaying_trunk(times: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (n, 3) rad of a trunk that sways by 14 degrees at 0.2 Hz."""
    return np.stack((0.5 * SWAY * np.cos(SWAY_SPEED * times), SWAY * np.sin(SWAY_SPEED * times), 0.0 * times), axis=1)


def driven(trunk: Trunk, timing: Timing) -> Motion:
    """Return the samples of an IMU on a `trunk`, as the driver delivers them."""
    motion = sampled(trunk, timing.taken, GYROSCOPE_SPAN, 100.0)
    return replace(motion, times=timing.stamps, arrivals=timing.arrivals)
