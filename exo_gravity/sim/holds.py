"""Does the arm creep or swing after the wearer lets go? The true motion, not what 12-bit encoders read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.sim.baselines import LettingGo
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.effort import SETTLING, run

RELEASE = 1.0  # s after letting go that do not count: the hand's last push decays


class Held(NamedTuple):
    """drift: rad/s of each joint (4,), the slope of a line. swing: rad (4,), range of the motion about that line."""

    drift: np.ndarray
    swing: np.ndarray


def hold(
    device: SimulatedDevice,
    motors: Sequence[JointMotor],
    settings: Settings,
    pose: tuple[float, ...],
    seconds: float,
    rate: float,
) -> Held:
    """Let the wearer hold `pose` (4,) rad, let go, and return how the arm moves in the following `seconds`."""
    angles, _ = run(device, motors, settings, LettingGo(pose, RELEASE + seconds), rate)
    free = angles[round((SETTLING + RELEASE) * rate) :]
    time = np.arange(len(free)) / rate
    slope, offset = np.polyfit(time, free, 1)
    return Held(slope, np.ptp(free - np.outer(time, slope) - offset, axis=0))
