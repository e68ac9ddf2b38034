# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The orientation of a simulated trunk."""

from __future__ import annotations

import math

import numpy as np

from exo_gravity.sim.trunk_motion import TrunkState


def orientation(state: TrunkState) -> np.ndarray:
    """Return the rotation (3, 3), world from trunk: Ry(pitch) Rx(roll)."""
    p, r = state.pitch, state.roll
    about_y = np.array(((math.cos(p), 0, math.sin(p)), (0, 1, 0), (-math.sin(p), 0, math.cos(p))))
    return about_y @ np.array(((1, 0, 0), (0, math.cos(r), -math.sin(r)), (0, math.sin(r), math.cos(r))))
