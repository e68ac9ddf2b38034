# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Three ways to find the weight of a wearer's arm, on the same devices and poses.

F. Just et al., J. NeuroEng. Rehabil. 17:13, 2020, compare them on ARMin. What they need is what this package has:

    Average       the body-mass table alone: `wearer.body_mass`
    Full          torques measured in several resting poses: `calibrate wearer`
    Equilibrium   the table, scaled so that it balances the torques measured in one resting pose; not in the package

A relaxed wearer at full support would carry the difference to their true arm.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from exo_gravity.core.arm.gravity import gravity_torque

from ..device_study import Row
from .devices import Worn
from .study import HIGH, LOW

WAYS = ("Average", "Full", "Equilibrium")
POSES = 200


def left_over(worn: Worn) -> np.ndarray:
    """Return the share (3,) of the arm's weight that each of WAYS leaves to the wearer, RMS over poses."""
    theta = np.random.default_rng(worn.seed).uniform(LOW, HIGH, (POSES, 4))
    true = gravity_torque(worn.wearer, theta)
    rest = [gravity_torque(way, theta) - true for way in worn.ways]
    return np.array([np.sqrt(np.sum(one**2) / np.sum(true**2)) for one in rest])


def verdict(left: Sequence[np.ndarray]) -> list[Row]:
    """Return the rows of the table. left: of each device, as `left_over` returns it."""
    shares = 100.0 * np.array(left)
    columns = zip(WAYS, np.sqrt(np.mean(shares**2, axis=0)), shares.max(axis=0), strict=True)
    return [
        Row(f"weight left to a relaxed wearer at support 1: {way}", f"{rms:.1f} % RMS, {most:.1f} % at most", "", True)
        for way, rms, most in columns
    ]
