"""The workspace that a weak arm reaches, against support: Freebal's measure.

A wearer who has only a share of the torque that the outstretched arm requires moves the arm from a low pose
straight to each pose of a grid. He reaches it if on the whole way, on every joint, his strength exceeds what
compensation leaves of the weight, plus friction. The motion is slow: inertia is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.gravity import gravity_torque
from exo_gravity.sim.arm import ArmConfig

STRENGTHS = (0.25, 0.35, 0.5)  # of the torque that the wearer's own arm requires, outstretched
LEAST = 1.0  # Nm of any joint: in most poses shoulder rotation carries little
LOW = (0.0, 0.2, 0.0, 0.2)  # rad, where the wearer begins
COUNTS = (13, 9, 9)  # positions of joints 2, 3, 4: 1,053, as many as in the paper
POINTS = 10  # of each way


def grid_of(low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """Return the poses (1053, 4) in rad between the joint limits `low` and `high` (4,), without shoulder rotation."""
    axes = [np.linspace(a, b, count) for a, b, count in zip(low[1:], high[1:], COUNTS, strict=True)]
    return np.array(list(product((0.0,), *axes)))


def weak_strength(settings: Settings, grid: np.ndarray, share: float) -> np.ndarray:
    """Return the strength (4,) in Nm of a weak wearer: `share` of the largest torque of the arm over `grid`."""
    own = ArmModel(settings.robot.length, settings.wearer_cog, settings.wearer_mass)
    return np.maximum(LEAST, share * np.abs(gravity_torque(own, grid)).max(axis=0))


def reached_share(arm: ArmConfig, settings: Settings | None, strength: np.ndarray, grid: np.ndarray) -> float:
    """Return the share of `grid` that a wearer of `strength` (4,) Nm reaches on the true `arm`, trunk upright.

    settings: of the compensator; None: motors without torque.
    """
    links = arm.links.with_wearer(arm.wearer_mass, arm.wearer_cog)
    low = np.array(LOW)
    reached = np.ones(len(grid), dtype=bool)
    for share in np.linspace(0.0, 1.0, POINTS):
        poses = low + share * (grid - low)
        left = gravity_torque(links, poses)
        if settings:
            left -= np.clip(gravity_torque(settings.arm, poses), -np.array(settings.max_effort), settings.max_effort)
        reached &= np.all(np.abs(left) + arm.coulomb_friction <= strength, axis=1)
    return float(reached.mean())
