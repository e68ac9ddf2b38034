# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Where the arm's joints and links are, and the torque that accelerates its links: all from Table 1 of the paper.

With the unit vectors x_n along the links (standard Denavit-Hartenberg), a point of link n is at the sum of l_m x_m over
the links before it, plus its distance along x_n. So the kinetic energy is a quadratic form in the x_n with constant
coefficients:

    T = 1/2 sum W_ij x'_i . x'_j     W_ij = W_ji = l_i M_j (i < j)     W_nn = Q_n + l_n^2 (mass beyond link n)

M_j: first moments (gravity.py). Q_n: second moment of link n about its joint. The rest of the paper's Equation 1 is
tau_k = sum W_ij (dx_i/dq_k) . x''_j = z_{k-1} . sum over i >= k of x_i x W_ij x''_j, plus the rotor of joint k. Links
are thin rods around their centres of gravity, Q_n = m_n (d_n^2 + l_n^2 / 12), or points of mass at REACH where only the
moments are known.

Where centres of gravity lie off the axes of their links, the vectors z_1, z_2, y_3 and y_4 of the moments W, Z, Y3 and
Y4 take part as x_5 to x_8; each turns with link 1 to 4. The links that share a moment are taken to be equally far off.
"""

import itertools
import math
import operator
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.arm_data import ArmData
from exo_gravity.core.arm.gravity import NO_TORQUE, Torque
from exo_gravity.core.arm.rotation import ZERO, Floats3, acceleration_of, cross, dot, plus
from exo_gravity.core.motors.ak import USUAL_MOTORS
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.numbers import JOINT_COUNT, Vector

ROTORS = tuple(MOTORS[name].rotor_inertia for name in USUAL_MOTORS)  # kg m^2, where the motors are not known
REACH = (0.8, 0.8, 0.8, 0.6)  # of a link's length, at which the mass of an arm given by its moments is assumed
LEAST_REACH = 0.01  # m
NO_LENGTH = (0.0,) * JOINT_COUNT  # m: directions do not depend on the lengths
NO_OFF_AXIS = (0.0,) * JOINT_COUNT  # kg m: W, Z, Y3, Y4
SHARED = ((0, 1), (1, 2, 3), (2,), (3,))  # links that share W, Z, Y3 and Y4
GRID = tuple(map(math.radians, (0.0, 30.0, 60.0, 90.0, 120.0, 150.0)))  # of joints 2 to 4, for the least inertia


class LinkFrame(NamedTuple):
    """Where a link is, in the arm's base frame: its joint, the joint's axis, and the direction along the link."""

    origin: Floats3
    axis: Floats3
    along: Floats3


def frames(length: Sequence[float], theta: Sequence[float]) -> tuple[LinkFrame, LinkFrame, LinkFrame, LinkFrame]:
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
        LinkFrame(ZERO, (0.0, 0.0, 1.0), first),
        LinkFrame(shoulder, swing, second),
        LinkFrame(flexion, bend, third),
        LinkFrame(elbow, bend, fourth),
    )


class LinkInertia(NamedTuple):
    """The inertia of an arm's links and rotors: the coefficients W of the kinetic energy."""

    weights: tuple[tuple[float, ...], ...]  #: W, (4, 4) kg m^2; (8, 8) if a centre of gravity lies off its link's axis
    rotors: tuple[float, ...] = ROTORS  #: at the joints, (4,) kg m^2

    @classmethod
    def of_moments(
        cls,
        length: Vector,
        moment: Vector,
        load: tuple[float, float] = (0.0, 0.0),
        off_axis: Vector = NO_OFF_AXIS,
    ) -> "LinkInertia":
        """Return the approximate inertia of an arm that is known by its moments.

        length: (4,) m. moment: M1..M4 in kg m, with the load. load: a weight in kg on link 4, and its distance from
        the elbow in m. off_axis: W, Z, Y3, Y4 in kg m, with the load.
        """
        lengths, whole = np.asarray(length, dtype=float), np.asarray(moment, dtype=float)
        weight, lever = load
        bare = whole - weight * np.append(lengths[:3], lever)
        reach = np.maximum(lengths * REACH, LEAST_REACH)
        mass = np.zeros(JOINT_COUNT)
        for link in reversed(range(JOINT_COUNT)):
            mass[link] = max(0.0, bare[link] - mass[link + 1 :].sum() * lengths[link]) / reach[link]
        first, second = mass * reach, mass * reach**2
        mass[3] += weight
        first[3] += weight * lever
        second[3] += weight * lever**2
        return _links(lengths, mass, whole, first, second, off_axis)

    def joined_with(self, other: "LinkInertia") -> "LinkInertia":
        """Return the inertia of these links with those of `other` fixed to them, and the rotors of these."""
        count = max(len(self.weights), len(other.weights))
        whole = np.zeros((count, count))
        for weights in (self.weights, other.weights):
            whole[: len(weights), : len(weights)] += weights
        return self._replace(weights=tuple(map(tuple, whole.tolist())))

    def torque(self, theta: Sequence[float], velocity: Sequence[float], acceleration: Sequence[float]) -> Torque:
        """Return the torque (4,) in Nm for theta rad, velocity rad/s and acceleration rad/s^2, (4,) each."""
        links = frames(NO_LENGTH, theta)
        vectors = _vectors(links, self.weights)
        omega = alpha = ZERO  # angular velocity and acceleration of the link
        motions = []
        for (_, axis, _), speed, change in zip(links, velocity, acceleration, strict=True):
            alpha = plus(plus(alpha, axis, change), cross(omega, axis), speed)
            omega = plus(omega, axis, speed)
            motions.append((omega, alpha))
        second = [acceleration_of(vector, *motions[n % JOINT_COUNT]) for n, vector in enumerate(vectors)]
        rotors = map(operator.mul, self.rotors, acceleration)
        return tuple(map(operator.add, _torque(links, vectors, self.weights, second), rotors))

    def momentum(
        self, theta: Sequence[float], velocity: Sequence[float], turning: Floats3 = ZERO
    ) -> tuple[Torque, Torque]:
        """Return the generalized momentum p = M v, (4,) kg m^2/s, and C^T v, (4,) Nm, with M' = C + C^T.

        C^T v is the derivative of the kinetic energy by the angles: p' = tau + C^T v. For j >= k the derivative of x'_j
        by q_k is z_{k-1} x x'_j + z'_{k-1} x x_j. turning: angular velocity of the base in its own axes, (3,) rad/s,
        which adds to both.
        """
        links = frames(NO_LENGTH, theta)
        vectors = _vectors(links, self.weights)
        swings, turnings = [], []  # z'_{k-1}, and the angular velocities of the links
        for (_, axis, _), speed in zip(links, velocity, strict=True):
            swings.append(cross(turning, axis))
            turning = plus(turning, axis, speed)
            turnings.append(turning)
        derivatives = [cross(turnings[n % JOINT_COUNT], vector) for n, vector in enumerate(vectors)]  # x'_j
        moment, change, momentum, coriolis = ZERO, ZERO, [], []
        for n in (3, 2, 1, 0):
            for own in range(n, len(vectors), JOINT_COUNT):
                impulse = ZERO
                for weight, derivative in zip(self.weights[own], derivatives, strict=True):
                    impulse = plus(impulse, derivative, weight)
                moment = plus(moment, cross(vectors[own], impulse))
                change = plus(change, cross(derivatives[own], impulse))
            momentum.append(dot(links[n].axis, moment) + self.rotors[n] * velocity[n])
            coriolis.append(dot(links[n].axis, change) + dot(swings[n], moment))
        return tuple(momentum[::-1]), tuple(coriolis[::-1])

    def matrix(self, theta: Sequence[float]) -> np.ndarray:
        """Return the mass matrix (4, 4) in kg m^2 at `theta` (4,) rad."""
        return np.array([self.torque(theta, NO_TORQUE, row) for row in np.eye(JOINT_COUNT).tolist()])

    @property
    def least(self) -> tuple[float, ...]:
        """The least inertia (4,) in kg m^2 that each joint feels in any pose, the other joints being free."""
        return least_inertia(self)


@lru_cache(8)
def least_inertia(links: LinkInertia) -> tuple[float, ...]:
    """Return `LinkInertia.least`."""
    poses = itertools.product((0.0,), GRID, GRID, GRID)
    free = [1.0 / np.diag(np.linalg.inv(links.matrix(pose))) for pose in poses]
    return tuple(np.min(free, axis=0).tolist())


@lru_cache(8)
def links_of(arm: ArmData) -> LinkInertia:
    """Return the inertia of `arm` with the usual rotors; approximate if it is given by its moments."""
    load, lever = arm.payload[0], float(arm.length[3]) + arm.payload[1]  # a point in the hand
    if arm.by_moments:
        return LinkInertia.of_moments(arm.length, arm.first_moment, (load, lever), arm.off_axis)
    held = np.array((0.0, 0.0, 0.0, load))
    first, second = arm.mass * arm.cog, arm.mass * (arm.cog**2 + arm.length**2 / 12.0)
    places = first + held * lever, second + held * lever**2
    return _links(arm.length, arm.mass + held, arm.first_moment, *places, arm.off_axis)


def _links(
    length: np.ndarray, mass: np.ndarray, moment: Vector, first: np.ndarray, second: np.ndarray, off_axis: Vector
) -> LinkInertia:
    """Return the inertia of links of `length` m and `mass` kg.

    moment, off_axis: (4,) kg m of the arm. first, second: (4,) kg m and kg m^2, moments of each link about its joint.
    """
    beyond = np.append(np.cumsum(mass[::-1])[-2::-1], 0.0)
    between = np.triu(np.outer(length, moment), 1)
    weights = between + between.T + np.diag(second + length**2 * beyond)
    if any(off_axis):
        weights = np.pad(weights, (0, JOINT_COUNT))
        along = np.tril(np.tile(length, (JOINT_COUNT, 1)), -1) * mass[:, None] + np.diag(first)  # kg m, of each link
        beside = np.zeros((JOINT_COUNT, JOINT_COUNT))  # m, of each link along z_1, z_2, y_3 and y_4
        for n, (links, shared) in enumerate(zip(SHARED, off_axis, strict=True)):
            carried = mass[list(links)].sum()
            beside[list(links), n] = shared / carried if carried else 0.0
        weights[:JOINT_COUNT, JOINT_COUNT:] = along.T @ beside
        weights[JOINT_COUNT:, :JOINT_COUNT] = beside.T @ along
        weights[JOINT_COUNT:, JOINT_COUNT:] = beside.T @ (mass[:, None] * beside)
    return LinkInertia(tuple(map(tuple, weights.tolist())))


def _vectors(links: Sequence[LinkFrame], weights: Sequence[Sequence[float]]) -> list[Floats3]:
    """Return x_1 to x_4, and z_1, z_2, y_3 and y_4 where `weights` has entries for them."""
    along = [link.along for link in links]
    if len(weights) == len(along):
        return along
    swing, bend = links[1].axis, links[2].axis
    return [*along, swing, bend, cross(bend, along[2]), cross(bend, along[3])]


def _torque(
    links: Sequence[LinkFrame],
    vectors: Sequence[Floats3],
    weights: Sequence[Sequence[float]],
    second: Sequence[Floats3],
) -> list[float]:
    """Return the torque (4,) in Nm that gives the `vectors` of the `links` the second derivatives `second`, 1/s^2."""
    moment, torque = ZERO, []
    for n in (3, 2, 1, 0):
        for own in range(n, len(vectors), JOINT_COUNT):
            force = ZERO
            for weight, derivative in zip(weights[own], second, strict=True):
                force = plus(force, derivative, weight)
            moment = plus(moment, cross(vectors[own], force))
        torque.append(dot(links[n].axis, moment))
    return torque[::-1]


def turning_torque(arm: ArmData, side: str, theta: Sequence[float], angular_acceleration: Sequence[float]) -> Torque:
    """Return the torque (4,) in Nm that turns the `side` arm at `theta` (4,) rad along with its base.

    A trunk that turns faster and faster takes the arm along only if the motors accelerate it. What depends on speed is
    neglected (at 1 rad/s it is a tenth of gravity's torque, or less). angular_acceleration: of the trunk, (3,) rad/s^2
    in its own axes.
    """
    alpha = turning_in_base(side, angular_acceleration)
    links, weights = frames(NO_LENGTH, theta), links_of(arm).weights
    vectors = _vectors(links, weights)
    torque = _torque(links, vectors, weights, [cross(alpha, vector) for vector in vectors])
    return tuple(map(operator.mul, arm.gain.tolist(), torque))


def turning_in_base(side: str, vector: Sequence[float]) -> Floats3:
    """Return an angular velocity or acceleration (3,) of the trunk in the base frame of the `side` arm."""
    x, y, z = vector
    return (y, x, -z) if side == "left" else (y, -x, z)  # a mirror, as the right arm is of the left, reverses rotations
