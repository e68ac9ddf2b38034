# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Springs across the joints, of the device and of its wearer, and joints that are springs.

A spring of stiffness k_n [Nm/rad] across joint n that is slack at r_n [rad] pulls with -k_n (theta_n - r_n), so the
motor must give k_n (theta_n - r_n) more than gravity needs: cables, hoses and bellows of the device, and skin, muscles
and capsule of a wearer's relaxed joint, whose torque is taken not to grow beyond a reach from r_n. Linear in k_n and in
k_n r_n: two columns of a joint's regressor, of which the second is the constant offset that the identification has in
any case. The term `spring` (core/compensation/terms) is another thing: a virtual spring that the motors add.

An elastic joint of stiffness k that carries tau has its link at q = theta - tau(q) / k behind its motor, where the
encoder sits (M. Spong, J Dyn Sys Meas Control 109:310, 1987). The torque changes with the angle by at most about g
times the first moments, 15 Nm/rad on a worn arm. `held` finds it by fixed-point steps, each of which leaves this slope
divided by k of the error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from exo_gravity.core.numbers import JOINT_COUNT, Torque, clamp

# Nm/rad. An arm whose spring is not there is pushed away from `rest` with the stiffness that is entered: more than this
# is about what gravity's own slope is on a light arm, g times 0.2 kg m.
MAX_STIFFNESS = 2.0
MAX_REST = 3.15  # rad, half a turn
SOFTEST = 50.0  # Nm/rad: a softer joint is a mistake in a unit, or needs more steps
STIFFEST = 100000.0  # Nm/rad
# After these a worn arm of 150 Nm/rad is within 0.02 Nm of MuJoCo's.
STEPS = 2


@dataclass(frozen=True)
class Springs:
    """A spring across each joint."""

    stiffness: Sequence[float] = (0.0,) * JOINT_COUNT  #: (n,) Nm/rad
    rest: Sequence[float] = (0.0,) * JOINT_COUNT  #: (n,) rad, at which each is slack
    reach: float = np.inf  #: rad from there, beyond which the torque grows no more
    on: bool = field(init=False, repr=False, compare=False)  #: whether any joint has one

    def __post_init__(self) -> None:
        object.__setattr__(self, "on", any(self.stiffness))

    def torque(self, theta: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm that holds the joints at `theta` (n,) rad against their springs."""
        springs, reach = zip(self.stiffness, theta, self.rest, strict=True), self.reach
        return tuple([k * clamp(q - rest, reach) for k, q, rest in springs])

    def torques(self, theta: np.ndarray) -> np.ndarray:
        """Return the same for poses (m, n) in rad: (m, n) Nm."""
        stretch = np.clip(theta - np.asarray(self.rest), -self.reach, self.reach)
        return np.asarray(np.asarray(self.stiffness) * stretch)

    def largest(self, low: Sequence[float], high: Sequence[float]) -> Torque:
        """Return the largest torque (n,) in Nm between the joint limits `low` and `high`, (n,) rad each."""
        return tuple(np.abs(self.torques(np.array((low, high)))).max(axis=0).tolist())


def link_angles(theta: Sequence[float], torque: Sequence[float], stiffness: Sequence[float]) -> Torque:
    """Return the angles (n,) in rad of the links whose motors stand at `theta` (n,) rad.

    torque: (n,) Nm that each joint carries. stiffness: (n,) Nm/rad; 0: rigid.
    """
    columns = zip(theta, torque, stiffness, strict=True)
    return tuple([angle - tau / k if k else angle for angle, tau, k in columns])


def held(torque_at: Callable[[Sequence[float]], Torque], theta: Sequence[float], stiffness: Sequence[float]) -> Torque:
    """Return the torque (n,) in Nm that holds links whose motors stand at `theta` (n,) rad.

    torque_at: that for links at an angle. stiffness: (n,) Nm/rad; 0: rigid.
    """
    torque = torque_at(theta)
    for _ in range(STEPS):
        torque = torque_at(link_angles(theta, torque, stiffness))
    return torque
