"""Samples for an ANFIS: `gravload` torques of joints 2 to 4 over an upright arm's workspace.

It trains on the paper's 1,053 positions, 13 x 9 x 9 over joints 2, 3, 4, and is checked half-way between them. Torques
are in Nm at gain 1, not scaled.
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
    """Training and held-out samples of joints 2 to 4: angles (n, 3) rad in the box low..high, torques (n, 3) Nm."""

    angle: np.ndarray
    torque: np.ndarray
    held_out_angle: np.ndarray
    held_out_torque: np.ndarray
    low: np.ndarray
    high: np.ndarray
    source: str


def from_gravload(configured: ConfiguredArm) -> Samples:
    """Return the upright arm's torques by the Robotics Toolbox, on the grid and half-way between its positions."""
    low, high = configured.low[1:], configured.high[1:]
    axes = [np.linspace(a, b, count) for a, b, count in zip(low, high, GRID, strict=True)]
    reference = gravload(replace(configured.robot, gain=np.ones(4)))

    def torques(angle: np.ndarray) -> np.ndarray:
        theta = np.column_stack((np.zeros(len(angle)), angle))
        return reference(theta, np.tile((0.0, 0.0, 1.0), (len(theta), 1)))[:, 1:]

    angle = np.array(list(product(*axes)))
    between = np.array(list(product(*((axis[1:] + axis[:-1]) / 2 for axis in axes))))
    source = f"gravload of the Robotics Toolbox, {len(angle)} positions"
    return Samples(angle, torques(angle), between, torques(between), low, high, source)
