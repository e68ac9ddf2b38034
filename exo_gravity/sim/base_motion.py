"""What an arm feels on a base that moves: its acceleration as gravity, its rotation as forces on each link.

In the axes of an accelerated base, gravity is g - a: turned and scaled. If the base also turns, the Euler, centrifugal
and Coriolis forces act on each link. They are not small: a sway of 2 degrees at 1 Hz accelerates a forearm 0.4 m from
the shoulder by 0.6 m/s^2, as walking shakes the shoulder by 1 to 2. Together they are exact. The arm's reaction on the
trunk is neglected.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from exo_gravity.core.model.tilt import Tilt
from exo_gravity.sim.trunk_motion import TrunkState, Vector


def in_base(side: str, vector: Sequence[float]) -> Vector:
    """Return a vector (3,) of the trunk's axes in the base frame of the `side` arm, of which the right is a mirror."""
    x, y, z = vector
    return (y if side == "left" else -y), x, -z


def rotation_in_base(side: str, vector: Sequence[float]) -> Vector:
    """Return an angular velocity or acceleration (3,) of the trunk in the base frame; a mirror reverses rotations."""
    x, y, z = vector
    return (y, x, -z) if side == "left" else (y, -x, z)


def felt_in_base(side: str, state: TrunkState, gravity: float) -> tuple[Vector, Vector, Vector]:
    """Return what the `side` arm's base feels, each (3,) in its frame, as for `SimulatedArm.move_base`.

    Gravity less acceleration in m/s^2, angular velocity in rad/s, angular acceleration in rad/s^2. gravity: m/s^2.
    """
    down, acceleration = Tilt.of(side, state.pitch, state.roll).direction, in_base(side, state.acceleration)
    x, y, z = (gravity * component - a for component, a in zip(down, acceleration, strict=True))
    return (
        (x, y, z),
        rotation_in_base(side, state.angular_velocity),
        rotation_in_base(side, state.angular_acceleration),
    )


def apply_rotation(
    model: mujoco.MjModel, data: mujoco.MjData, angular_velocity: np.ndarray, angular_acceleration: np.ndarray
) -> None:
    """Set the forces on each link of a base that turns by (3,) rad/s and rad/s^2 about its origin, in its own axes.

    For link i with mass m, inertia I, centre of gravity at r, velocity v and angular velocity w relative to the base:
    force  -m (alpha x r + omega x (omega x r) + 2 omega x v),
    torque -(I (alpha + omega x w) + (omega + w) x I (omega + w) - w x I w), of which MuJoCo adds w x I w itself.
    """
    links = slice(1, None)
    place, mass = data.xipos[links], model.body_mass[links, np.newaxis]
    rotation = data.ximat[links].reshape(-1, 3, 3)
    inertia = (rotation * model.body_inertia[links, np.newaxis]) @ rotation.transpose(0, 2, 1)
    turning, speed = data.cvel[links, :3], data.cvel[links, 3:]
    velocity = speed + _cross(turning, place - data.subtree_com[1])
    spin, spin_up = _matrix(angular_velocity), _matrix(angular_acceleration)
    force = place @ (spin_up + spin @ spin).T + velocity @ (2.0 * spin.T)
    total = turning + angular_velocity
    change = inertia @ (angular_acceleration + turning @ spin.T)[..., np.newaxis]
    momentum, relative = inertia @ total[..., np.newaxis], inertia @ turning[..., np.newaxis]
    data.xfrc_applied[links, :3] = -mass * force
    data.xfrc_applied[links, 3:] = _cross(turning, relative[..., 0]) - _cross(total, momentum[..., 0]) - change[..., 0]


def _matrix(vector: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) that multiplies a vector by the cross product with `vector`."""
    x, y, z = vector
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products (n, 3) of rows; `numpy.cross` takes five times as long."""
    return a[:, (1, 2, 0)] * b[:, (2, 0, 1)] - a[:, (2, 0, 1)] * b[:, (1, 2, 0)]
