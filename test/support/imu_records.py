# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Records of a simulated IMU for the calibration of its mounting: a person who stands and bows, and six rests."""

from __future__ import annotations

import numpy as np

from exo_gravity.core.arm.arm_data import STANDARD_GRAVITY
from exo_gravity.lab.calibration.imu import ImuRecord
from exo_gravity.sim.imu import ImuConfig, SimulatedImu
from exo_gravity.sim.trunk_motion import TrunkState

RATE = 100.0  # Hz


def record(
    quaternion: np.ndarray,
    bow: float = 0.7,
    lean: float = 0.0,
    seed: int = 0,
    upright: float = 2.0,
    posture: tuple[float, float] = (0.0, 0.0),
    late: float = 0.0,
    right: float = 0.25,
) -> ImuRecord:
    """Return 2 s upright, a bow in 1.5 s that leans sideways by `lean` rad, 2 s bowed, back, and 2 s upright.

    And then a lean to the right by `right` rad in the same way. late: s by which the bow follows its lean.
    """
    bowed = upright + 7.0 + late
    time = np.arange(0.0, bowed + 7.0, 1.0 / RATE)
    s = np.interp(time, np.cumsum((0.0, upright, 1.5, 2.0, 1.5, 2.0)), (0.0, 0.0, 1.0, 1.0, 0.0, 0.0))
    share = s * s * (3.0 - 2.0 * s)
    delayed = np.interp(time - late, time, share)
    leant = np.interp(time - bowed, np.cumsum((0.0, 1.5, 2.0, 1.5)), (0.0, 1.0, 1.0, 0.0))
    pitch = posture[0] + bow * delayed
    roll = posture[1] + lean * share + right * leant * leant * (3.0 - 2.0 * leant)
    imu = SimulatedImu(ImuConfig(tuple(quaternion), RATE, seed=seed))
    rates = np.gradient(pitch, time), np.gradient(roll, time)
    samples = [imu.sample(TrunkState(*row)) for row in zip(pitch, roll, *rates, strict=True)]
    gyroscope, accelerometer = (np.array(column) for column in zip(*samples, strict=True))
    return ImuRecord(time, gyroscope, accelerometer)


def rests(count: int, scale: np.ndarray, bias: np.ndarray) -> ImuRecord:
    """Return an IMU that lies on `count` of its sides for 2 s each, turned in 1 s."""
    sides = np.array([(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, -1, 0), (-1, 0, 0), (0, 0, -1)], float)[:count]
    rng = np.random.default_rng(3)
    force = np.repeat(sides * STANDARD_GRAVITY, 300, axis=0) / scale + bias
    rate = 1e-3 * rng.standard_normal(force.shape)
    for side in range(count):
        rate[300 * side : 300 * side + 100] += (1.5, 0.3, 0.0)
    return ImuRecord(np.arange(len(force)) / RATE, rate, force + 0.01 * rng.standard_normal(force.shape))
