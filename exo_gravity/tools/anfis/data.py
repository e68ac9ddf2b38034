"""What an ANFIS learns from: `gravload` torques of joints 2 to 4 over an upright arm's workspace.

It trains on the paper's 1,053 positions, 13 x 9 x 9 over joints 2, 3, 4, and is checked on the positions in the middle
between them. Torques are in Nm at gain 1, not scaled.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from exo_gravity.tools.inputs.arms import ConfiguredArm
from exo_gravity.tools.inputs.references import gravload

GRID = (13, 9, 9)  # positions of joints 2, 3, 4: 1,053 as in the paper


@dataclass(frozen=True, eq=False)
class Samples:
    """Angles (n, 3) rad and torques (n, 3) Nm of joints 2 to 4, to train on and held out, within the box low..high."""

    angle: np.ndarray
    torque: np.ndarray
    held_out_angle: np.ndarray
    held_out_torque: np.ndarray
    low: np.ndarray
    high: np.ndarray
    source: str


def from_gravload(configured: ConfiguredArm) -> Samples:
    """Return the torques of the upright arm by the Robotics Toolbox, on the grid and between its positions."""
    low, high = configured.low[1:], configured.high[1:]
    axes = [np.linspace(a, b, count) for a, b, count in zip(low, high, GRID, strict=True)]
    reference = gravload(replace(configured.robot, gain=np.ones(4)))
    sets = []
    for positions in (axes, [(axis[1:] + axis[:-1]) / 2 for axis in axes]):
        angle = np.array(list(product(*positions)))
        theta = np.column_stack((np.zeros(len(angle)), angle))
        torque = reference(theta, np.tile((0.0, 0.0, 1.0), (len(theta), 1)))
        sets += [angle, torque[:, 1:]]
    return Samples(*sets, low, high, f"gravload of the Robotics Toolbox, {len(sets[0])} positions")
