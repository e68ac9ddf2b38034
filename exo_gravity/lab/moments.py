# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The eight moments of the paper's arm as unknowns: the torque per moment, and what a known weight adds to them.

`core.arm.paper` defines the moments, and the torque that is linear in them.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from exo_gravity.core.arm.interface import MAX_MASS, STANDARD_GRAVITY
from exo_gravity.core.arm.paper import MAX_LENGTH, ArmModel, gravity_torque
from exo_gravity.core.numbers import JOINT_COUNT, Vector, four_floats, one_float

MOMENTS = ("M1", "M2", "M3", "M4", "W", "Z", "Y3", "Y4")


def load_moments(length: Vector, mass: float, lever: float) -> np.ndarray:
    """Return what a weight of `mass` kg on link 4, `lever` m from the elbow, adds to the moments: (8,) kg m.

    length: (4,) m. Raises ParameterError.
    """
    lengths = four_floats("length", length, 0.0, MAX_LENGTH, "m")
    mass = one_float("load_mass", mass, 0.0, MAX_MASS, "kg")
    lever = one_float("load_lever", lever, 0.0, MAX_LENGTH, "m")
    return np.array((*(mass * lengths[:3]).tolist(), mass * lever, 0.0, 0.0, 0.0, 0.0))


def regressor(
    theta: ArrayLike, direction: ArrayLike = (0.0, 0.0, 1.0), gravity: float = STANDARD_GRAVITY
) -> np.ndarray:
    """Return the torque of each joint per unit of each moment: (n, 4, 8) in Nm per kg m.

    theta: (n, 4) rad. direction: (3,) or (n, 3), gravity's unit vector in the base frame. The torque (n, 4) in Nm is
    `regressor(...) @ moments`. Raises ParameterError as `gravity_torque` does.
    """
    poses = np.atleast_2d(np.asarray(theta, dtype=float))
    return np.stack([gravity_torque(arm, poses, direction) for arm in _unit_arms(gravity)], axis=-1)


@lru_cache(4)
def _unit_arms(gravity: float) -> list[ArmModel]:
    """Return an arm for each moment, which has that moment of 1 kg m and no other."""
    rows = np.eye(len(MOMENTS))
    no_length = (0.0,) * JOINT_COUNT  # the torque depends on the lengths through the moments only
    return [ArmModel.from_moments(no_length, row[:JOINT_COUNT], row[JOINT_COUNT:], gravity=gravity) for row in rows]
