"""The rest of the paper's Equation 1: the torque that accelerates the links, Coriolis and centrifugal torque included.

With the unit vectors x_n along the links (Table 1 of the paper, standard Denavit-Hartenberg), a point of link n is at
the sum of l_m x_m over the links before it, plus its distance along x_n. So the kinetic energy is a quadratic form in
the x_n with constant coefficients:

    T = 1/2 sum W_ij x'_i . x'_j     W_ij = l_i M_j (i < j)     W_nn = Q_n + l_n^2 (mass beyond link n)

M_j: first moments (moments.py). Q_n: second moment of link n about its joint, of a thin rod as long as the link
around its centre of gravity: m_n (d_n^2 + l_n^2 / 12). Equation of motion: tau_k = sum W_ij (dx_i/dq_k) . x''_j, plus
the rotor of joint k. Offsets of the centres of gravity across the links are left out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.numbers import JOINT_COUNT

ROTORS = (8.8e-4, 4.9e-3, 8.8e-4, 8.8e-4)  # kg m^2 at the output: AK60-6 and AK80-9, published motor tables
NO_ACCELERATION = (0.0,) * JOINT_COUNT
GRID = tuple(map(math.radians, (0.0, 30.0, 60.0, 90.0, 120.0, 150.0)))  # of joints 2 to 4, for the least inertia


class LinkInertia:
    """The inertia of an arm whose masses are known, and of its rotors, (4,) kg m^2 at the joints.

    Raises ParameterError if the arm is given by its moments.
    """

    def __init__(self, arm: ArmModel, rotors: Sequence[float] = ROTORS) -> None:
        if arm.by_moments:
            arm.check_masses("inertia")
        length, moment = arm.length.tolist(), arm.first_moment
        second = arm.mass * (arm.cog**2 + arm.length**2 / 12.0)
        beyond = np.append(np.cumsum(arm.mass[::-1])[-2::-1], 0.0)
        own = (second + arm.length**2 * beyond).tolist()
        self._own = tuple(own)
        self._between = tuple(length[i] * moment[j] for i in range(4) for j in range(i + 1, 4))
        self._rotors = tuple(rotors)

    def torque(self, theta: Sequence[float], velocity: Sequence[float], acceleration: Sequence[float]) -> Torque:
        """Return the torque (4,) in Nm for theta rad, velocity rad/s and acceleration rad/s^2, (4,) each.

        Vectors are given along u = x_2, n = dx_2/dq_2 and t, the axis of joint 2.
        """
        _, q2, q3, q4 = theta
        v1, v2, v3, v4 = velocity
        a1, a2, a3, a4 = acceleration
        s2, c2, s3, c3 = math.sin(q2), math.cos(q2), math.sin(q3), math.cos(q3)
        s4, c4, v4, a4 = math.sin(q3 + q4), math.cos(q3 + q4), v3 + v4, a3 + a4  # forearm and upper arm together
        turn = v1 * v1
        # Second derivatives of x_1, of u, and of t; first derivatives of u and t.
        x1u, x1n, x1t = -turn * s2, -turn * c2, a1
        uu, un, ut = -v2 * v2 - turn * s2 * s2, a2 - turn * s2 * c2, a1 * s2 + 2.0 * v1 * v2 * c2
        tu, tn, tt = -a1 * s2, -a1 * c2, -turn
        dn, dt, du_t, dn_t = v2, v1 * s2, -v1 * s2, -v1 * c2
        # x_3 = c3 u + s3 t, and x_4 likewise.
        k3, g3, k4, g4 = v3 * v3, 2.0 * v3, v4 * v4, 2.0 * v4
        x3u = c3 * uu + s3 * tu + g3 * c3 * du_t - a3 * s3 - k3 * c3
        x3n = c3 * un + s3 * tn + g3 * (c3 * dn_t - s3 * dn)
        x3t = c3 * ut + s3 * tt - g3 * s3 * dt + a3 * c3 - k3 * s3
        x4u = c4 * uu + s4 * tu + g4 * c4 * du_t - a4 * s4 - k4 * c4
        x4n = c4 * un + s4 * tn + g4 * (c4 * dn_t - s4 * dn)
        x4t = c4 * ut + s4 * tt - g4 * s4 * dt + a4 * c4 - k4 * s4
        (w1, w2, w3, w4), (w12, w13, w14, w23, w24, w34) = self._own, self._between
        f1t = w1 * x1t + w12 * ut + w13 * x3t + w14 * x4t
        f2n = w12 * x1n + w2 * un + w23 * x3n + w24 * x4n
        f2t = w12 * x1t + w2 * ut + w23 * x3t + w24 * x4t
        f3u = w13 * x1u + w23 * uu + w3 * x3u + w34 * x4u
        f3n = w13 * x1n + w23 * un + w3 * x3n + w34 * x4n
        f3t = w13 * x1t + w23 * ut + w3 * x3t + w34 * x4t
        f4u = w14 * x1u + w24 * uu + w34 * x3u + w4 * x4u
        f4n = w14 * x1n + w24 * un + w34 * x3n + w4 * x4n
        f4t = w14 * x1t + w24 * ut + w34 * x3t + w4 * x4t
        r1, r2, r3, r4 = self._rotors
        forearm = c4 * f4t - s4 * f4u
        across = s3 * (s2 * f3u + c2 * f3n) + s4 * (s2 * f4u + c2 * f4n)
        return (
            f1t + s2 * (f2t + c3 * f3t + c4 * f4t) - across + r1 * a1,
            f2n + c3 * f3n + c4 * f4n + r2 * a2,
            c3 * f3t - s3 * f3u + forearm + r3 * a3,
            forearm + r4 * (a4 - a3),
        )

    def matrix(self, theta: Sequence[float]) -> np.ndarray:
        """Return the mass matrix (4, 4) in kg m^2 at `theta` (4,) rad."""
        return np.array([self.torque(theta, NO_ACCELERATION, row) for row in np.eye(JOINT_COUNT).tolist()])

    def least(self) -> tuple[float, ...]:
        """Return the least inertia (4,) in kg m^2 that each joint feels in any pose, the other joints being free."""
        poses = itertools.product((0.0,), GRID, GRID, GRID)
        free = [1.0 / np.diag(np.linalg.inv(self.matrix(pose))) for pose in poses]
        return tuple(np.min(free, axis=0).tolist())
