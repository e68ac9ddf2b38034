"""Where the arm's joints and links are, and the torque that accelerates its links: all from Table 1 of the paper.

With the unit vectors x_n along the links (standard Denavit-Hartenberg), a point of link n is at the sum of l_m x_m over
the links before it, plus its distance along x_n. So the kinetic energy is a quadratic form in the x_n with constant
coefficients:

    T = 1/2 sum W_ij x'_i . x'_j     W_ij = l_i M_j (i < j)     W_nn = Q_n + l_n^2 (mass beyond link n)

M_j: first moments (moments.py). Q_n: second moment of link n about its joint. Equation of motion, the rest of the
paper's Equation 1: tau_k = sum W_ij (dx_i/dq_k) . x''_j, plus the rotor of joint k. Links are thin rods around their
centres of gravity, Q_n = m_n (d_n^2 + l_n^2 / 12); where only the moments are known, they are points of mass at REACH.
Offsets of the centres of gravity across the links are left out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from exo_gravity.core.model.arm import ZEROS, ArmModel
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.model.rotation import ZERO, Floats3, cross, dot, plus
from exo_gravity.core.numbers import JOINT_COUNT, Vector

# kg m^2 at the gear's output: 243.5 and 607 g cm^2 (published motor tables) times the gear ratio squared, AK60-6 and
# AK80-9.
ROTORS = (8.8e-4, 4.9e-3, 8.8e-4, 8.8e-4)
REACH = (0.8, 0.8, 0.8, 0.6)  # of a link's length, at which the mass of an arm given by its moments is assumed
LEAST_REACH = 0.01  # m
GRID = tuple(map(math.radians, (0.0, 30.0, 60.0, 90.0, 120.0, 150.0)))  # of joints 2 to 4, for the least inertia
PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # the order of `LinkInertia.between`


class Frame(NamedTuple):
    """Where a link is, in the arm's base frame: its joint, the joint's axis, and the direction along the link."""

    origin: Floats3
    axis: Floats3
    along: Floats3


def frames(length: Sequence[float], theta: Sequence[float]) -> tuple[Frame, Frame, Frame, Frame]:
    """Return the four links of `length` (4,) m at `theta` (4,) rad."""
    t1, t2, t3, t4 = theta
    l1, l2, l3, _ = length
    s1, c1, s2, c2 = math.sin(t1), math.cos(t1), math.sin(t2), math.cos(t2)
    first: Floats3 = (c1, s1, 0.0)
    swing: Floats3 = (-s1, c1, 0.0)  # the axis of joint 2
    second: Floats3 = (s2 * c1, s2 * s1, c2)
    bend: Floats3 = (-c2 * c1, -c2 * s1, s2)  # the axis of joints 3 and 4
    third = plus(plus(ZERO, second, math.cos(t3)), swing, math.sin(t3))
    fourth = plus(plus(ZERO, second, math.cos(t3 + t4)), swing, math.sin(t3 + t4))
    shoulder = plus(ZERO, first, l1)
    flexion = plus(shoulder, second, l2)
    elbow = plus(flexion, third, l3)
    return (
        Frame(ZERO, (0.0, 0.0, 1.0), first),
        Frame(shoulder, swing, second),
        Frame(flexion, bend, third),
        Frame(elbow, bend, fourth),
    )


class LinkInertia(NamedTuple):
    """The inertia of an arm's links and rotors: the coefficients W of the kinetic energy, kg m^2."""

    own: tuple[float, ...]  #: W_nn, (4,)
    between: tuple[float, ...]  #: W_ij of `PAIRS`, (6,)
    rotors: tuple[float, ...] = ROTORS  #: at the joints, (4,)

    @classmethod
    def of(cls, arm: ArmModel, rotors: Sequence[float] = ROTORS) -> LinkInertia:
        """Return the inertia of `arm`. Raises ParameterError if it is given by its moments."""
        if arm.by_moments:
            arm.check_masses("terms that depend on the inertia")
        return _links_of(arm)._replace(rotors=tuple(rotors))

    @classmethod
    def of_moments(cls, length: Vector, moment: Vector, load: tuple[float, float] = (0.0, 0.0)) -> LinkInertia:
        """Return the approximate inertia of an arm that is known by its moments.

        length: (4,) m. moment: M1..M4 in kg m, with the load. load: a weight in kg on link 4, and its distance from
        the elbow in m.
        """
        lengths, whole = np.asarray(length, dtype=float), np.asarray(moment, dtype=float)
        weight, lever = load
        bare = whole - weight * np.append(lengths[:3], lever)
        reach = np.maximum(lengths * REACH, LEAST_REACH)
        mass = np.zeros(JOINT_COUNT)
        for link in reversed(range(JOINT_COUNT)):
            mass[link] = max(0.0, bare[link] - mass[link + 1 :].sum() * lengths[link]) / reach[link]
        second = mass * reach**2
        mass[3] += weight
        second[3] += weight * lever**2
        return _links(lengths, mass, whole, second)

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
        (w1, w2, w3, w4), (w12, w13, w14, w23, w24, w34), (r1, r2, r3, r4) = self
        f1t = w1 * x1t + w12 * ut + w13 * x3t + w14 * x4t
        f2n = w12 * x1n + w2 * un + w23 * x3n + w24 * x4n
        f2t = w12 * x1t + w2 * ut + w23 * x3t + w24 * x4t
        f3u = w13 * x1u + w23 * uu + w3 * x3u + w34 * x4u
        f3n = w13 * x1n + w23 * un + w3 * x3n + w34 * x4n
        f3t = w13 * x1t + w23 * ut + w3 * x3t + w34 * x4t
        f4u = w14 * x1u + w24 * uu + w34 * x3u + w4 * x4u
        f4n = w14 * x1n + w24 * un + w34 * x3n + w4 * x4n
        f4t = w14 * x1t + w24 * ut + w34 * x3t + w4 * x4t
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
        return np.array([self.torque(theta, ZEROS, row) for row in np.eye(JOINT_COUNT).tolist()])


@lru_cache(8)
def least_inertia(links: LinkInertia) -> tuple[float, ...]:
    """Return the least inertia (4,) in kg m^2 that each joint feels in any pose, the other joints being free."""
    poses = itertools.product((0.0,), GRID, GRID, GRID)
    free = [1.0 / np.diag(np.linalg.inv(links.matrix(pose))) for pose in poses]
    return tuple(np.min(free, axis=0).tolist())


@lru_cache(8)
def _links_of(arm: ArmModel) -> LinkInertia:
    if arm.by_moments:
        return LinkInertia.of_moments(arm.length, arm.first_moment)
    return _links(arm.length, arm.mass, arm.first_moment, arm.mass * (arm.cog**2 + arm.length**2 / 12.0))


def _links(length: np.ndarray, mass: np.ndarray, moment: Vector, second: np.ndarray) -> LinkInertia:
    beyond = np.append(np.cumsum(mass[::-1])[-2::-1], 0.0)
    own = second + length**2 * beyond
    return LinkInertia(tuple(own.tolist()), tuple(float(length[i] * moment[j]) for i, j in PAIRS))


def turning_torque(arm: ArmModel, side: str, theta: Sequence[float], angular_acceleration: Sequence[float]) -> Torque:
    """Return the torque (4,) in Nm that turns the `side` arm at `theta` (4,) rad along with its base.

    A trunk that turns faster and faster takes the arm along only if the motors accelerate it. What depends on speed is
    neglected (at 1 rad/s it is a tenth of gravity's torque, or less). angular_acceleration: of the trunk, (3,) rad/s^2
    in its own axes.
    """
    x, y, z = angular_acceleration
    # In the base frame; a mirror, as the right arm is of the left one, reverses rotations.
    alpha = (y, x, -z) if side == "left" else (y, -x, z)
    (w1, w2, w3, w4), (w12, w13, w14, w23, w24, w34), _ = _links_of(arm)
    links = frames(arm.length.tolist(), theta)
    rows = (w1, w12, w13, w14), (w12, w2, w23, w24), (w13, w23, w3, w34), (w14, w24, w34, w4)
    moment = ZERO
    torque = []
    for (_, axis, along), row, gain in zip(links[::-1], rows[::-1], arm.gain.tolist()[::-1], strict=True):
        place = ZERO
        for weight, link in zip(row, links, strict=True):
            place = plus(place, link.along, weight)
        moment = plus(moment, cross(along, cross(alpha, place)))
        torque.append(gain * dot(axis, moment))
    return tuple(torque[::-1])
