"""The first moments that determine the gravity torque, and the torque as a linear function of them.

With the frames of Table 1 (joint n turns about z_{n-1}, and z_3 = z_4 = z_2), gravity's unit vector d in the base frame
and gravity g, the arm's torque depends on eight numbers in kg m, all in the order of `MOMENTS`:

    S4 = M4 x4 + Y4 y4        S2 = S3 + M2 x2 + Z z2
    S3 = S4 + M3 x3 + Y3 y3   S1 = S2 + M1 x1 + W z1        torque n = g z_{n-1} . (d x S_n)

M_n: mass of link n times its centre of gravity along the link, plus all mass beyond link n times the link's length. W:
of link 1 along z_1 and of link 2 along y_2 = z_1. Z: of links 2, 3 and 4 along z_2. Y3, Y4: of links 3 and 4 along
their y. What lies along a joint's own axis (link 1 along y_1) needs no torque.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from exo_gravity.core.model.arm import MAX_LENGTH, MAX_MASS, STANDARD_GRAVITY, ArmModel
from exo_gravity.core.model.gravity import gravity_torque
from exo_gravity.core.numbers import JOINT_COUNT, Vector, four_floats, one_float

MOMENTS = ("M1", "M2", "M3", "M4", "W", "Z", "Y3", "Y4")
MAX_OFFSET = 0.1  # m of a centre of gravity from its link


def moments_of(arm: ArmModel) -> np.ndarray:
    """Return the eight moments (8,) of `arm` in kg m."""
    return np.array((*arm.first_moment, *arm.off_axis))


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
