# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Where the joints and links of Table 1 are, and the torque that accelerates what they carry, in plain floats.

Each link carries a rigid body (the link, a load, a wearer's segment), of which mass, first and second moments about the
joint count. Per joint, force and moment of all bodies beyond it are summed (Newton-Euler), and likewise their momentum.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.arm.rotation import ZERO, Floats3, acceleration_of, cross, dot, plus
from exo_gravity.core.numbers import NO_TORQUE, Torque

GRID = tuple(map(math.radians, (0.0, 30.0, 60.0, 90.0, 120.0, 150.0)))  # of joints 2 to 4, for the least inertia


class LinkFrame(NamedTuple):
    """Where a link is, in the arm's base frame: its joint, the joint's axis, and the axes x_n, y_n, z_n of Table 1."""

    origin: Floats3
    axis: Floats3
    along: Floats3
    beside: Floats3
    across: Floats3  #: the axis of the next joint


def frames(
    length: Sequence[float], theta: Sequence[Any], xp: ModuleType = math
) -> tuple[LinkFrame, LinkFrame, LinkFrame, LinkFrame]:
    """Return the four links of `length` (4,) m at `theta` (4,) rad; with NumPy as `xp` also (4, m), for m poses."""
    t1, t2, t3, t4 = theta
    l1, l2, l3, _ = length
    s1, c1, s2, c2 = xp.sin(t1), xp.cos(t1), xp.sin(t2), xp.cos(t2)
    vertical = (0.0, 0.0, 1.0)
    first: Floats3 = (c1, s1, 0.0)
    swing: Floats3 = (-s1, c1, 0.0)  # the axis of joint 2
    second: Floats3 = (s2 * c1, s2 * s1, c2)
    bend: Floats3 = (-c2 * c1, -c2 * s1, s2)  # the axis of joints 3 and 4
    third = plus(plus(ZERO, second, xp.cos(t3)), swing, xp.sin(t3))
    fourth = plus(plus(ZERO, second, xp.cos(t3 + t4)), swing, xp.sin(t3 + t4))
    shoulder = plus(ZERO, first, l1)
    flexion = plus(shoulder, second, l2)
    elbow = plus(flexion, third, l3)
    return (
        LinkFrame(ZERO, vertical, first, plus(ZERO, vertical, -1.0), swing),
        LinkFrame(shoulder, swing, second, swing, bend),
        LinkFrame(flexion, bend, third, cross(bend, third), bend),
        LinkFrame(elbow, bend, fourth, cross(bend, fourth), bend),
    )


class Body(NamedTuple):
    """What a link carries, in the link's own frame, from its joint."""

    mass: float  #: kg
    first: Floats3  #: kg m, mass times the centre of gravity
    second: tuple[Floats3, ...]  #: (3, 3) kg m^2, the sum of mass times x_i x_j over all points

    @classmethod
    def rod(cls, mass: float, centre: Sequence[float], length: float = 0.0) -> "Body":
        """Return a thin rod of `mass` kg and `length` m along its link, with its centre at `centre` (3,) m."""
        spread = np.diag((mass * length**2 / 12.0, 0.0, 0.0))
        return cls._of(mass, mass * np.array(centre), mass * np.outer(centre, centre) + spread)

    def joined_with(self, other: "Body") -> "Body":
        """Return this body with `other` fixed to it."""
        return self._of(self.mass + other.mass, np.add(self.first, other.first), np.add(self.second, other.second))

    @classmethod
    def _of(cls, mass: float, first: np.ndarray, second: np.ndarray) -> "Body":
        x, y, z = first.tolist()
        return cls(mass, (x, y, z), tuple(map(tuple, second.tolist())))

    def moved(self, link: LinkFrame, joint: Floats3, turned: Callable[[Floats3], Floats3]) -> tuple[Floats3, Floats3]:
        """Return the sum of mass times velocity, or acceleration, of its points, and their moment about the joint.

        joint: that of the joint. turned: of a vector that is fixed to the link.
        """
        whole, moment, axes = plus(ZERO, joint, self.mass), ZERO, link[2:]
        for n, axis in enumerate(axes):
            if self.first[n] or self.second[n][n]:  # else nothing lies along it
                change, lever = turned(axis), ZERO
                for other, share in zip(axes, self.second[n], strict=True):
                    lever = plus(lever, other, share)
                whole = plus(whole, change, self.first[n])
                moment = plus(plus(moment, cross(lever, change)), cross(axis, joint), self.first[n])
        return whole, moment


class ChainInertia(NamedTuple):
    """The inertia of what the links of Table 1 carry, and of the rotors: `Links` of core/arm/interface.py."""

    length: tuple[float, ...]  #: (4,) m
    bodies: tuple[Body, ...]  #: of each link
    rotors: tuple[float, ...]  #: at the joints, (4,) kg m^2

    def joined_with(self, other: "ChainInertia") -> "ChainInertia":
        """Return the inertia of these links with the bodies of `other` fixed to them."""
        return self._replace(bodies=tuple(map(Body.joined_with, self.bodies, other.bodies)))

    def torque(self, theta: Sequence[float], velocity: Sequence[float], acceleration: Sequence[float]) -> Torque:
        """Return the torque (4,) in Nm for theta rad, velocity rad/s and acceleration rad/s^2, (4,) each."""
        links, loads = frames(self.length, theta), []
        omega, alpha, moved, origin = ZERO, ZERO, ZERO, ZERO  # of the link before; moved: of its joint, m/s^2
        for link, body, speed, change in zip(links, self.bodies, velocity, acceleration, strict=True):
            moved = plus(moved, acceleration_of(plus(link.origin, origin, -1.0), omega, alpha))
            alpha = plus(plus(alpha, link.axis, change), cross(omega, link.axis), speed)
            omega, origin = plus(omega, link.axis, speed), link.origin
            turned = partial(acceleration_of, angular_velocity=omega, angular_acceleration=alpha)
            loads.append(body.moved(link, moved, turned))
        columns = zip(links, _beyond(links, loads), self.rotors, acceleration, strict=True)
        return tuple([dot(link.axis, moment) + rotor * change for link, (_, moment), rotor, change in columns])

    def turning_torque(self, theta: Sequence[float], turning: Floats3) -> Torque:
        """Return the torque (4,) in Nm that turns the links at `theta` (4,) rad along with their base.

        turning: angular acceleration of the base in its own axes, (3,) rad/s^2.
        """
        links, turned = frames(self.length, theta), partial(cross, turning)
        loads = [body.moved(link, turned(link.origin), turned) for link, body in zip(links, self.bodies, strict=True)]
        return tuple([dot(link.axis, moment) for link, (_, moment) in zip(links, _beyond(links, loads), strict=True)])

    def momentum(
        self, theta: Sequence[float], velocity: Sequence[float], turning: Floats3 = ZERO
    ) -> tuple[Torque, Torque]:
        """Return the generalized momentum p = M v, (4,) kg m^2/s, and C^T v, (4,) Nm, with M' = C + C^T.

        C^T v is the derivative of the kinetic energy by the angles: p' = tau + C^T v. What turns about an axis has the
        momentum z . L about it; the rest of the derivative of this product is z' . L less that of the joint's own way.
        turning: angular velocity of the base in its own axes, (3,) rad/s, which adds to both.
        """
        links, loads, swings, ways = frames(self.length, theta), [], [], []
        omega, moved, origin = turning, ZERO, ZERO
        for link, body, speed in zip(links, self.bodies, velocity, strict=True):
            moved = plus(moved, cross(omega, plus(link.origin, origin, -1.0)))
            swings.append(cross(omega, link.axis))
            ways.append(moved)
            omega, origin = plus(omega, link.axis, speed), link.origin
            loads.append(body.moved(link, moved, partial(cross, omega)))
        momentum, coriolis = [], []
        for n, (whole, moment) in enumerate(_beyond(links, loads)):
            momentum.append(dot(links[n].axis, moment) + self.rotors[n] * velocity[n])
            coriolis.append(dot(swings[n], moment) - dot(links[n].axis, cross(ways[n], whole)))
        return tuple(momentum), tuple(coriolis)

    def matrix(self, theta: Sequence[float]) -> np.ndarray:
        """Return the mass matrix (4, 4) in kg m^2 at `theta` (4,) rad."""
        return np.array([self.torque(theta, NO_TORQUE, row) for row in np.eye(len(self.length)).tolist()])

    @property
    def least(self) -> tuple[float, ...]:
        """The least inertia (4,) in kg m^2 that each joint feels in any pose, the other joints being free."""
        return least_inertia(self)


@lru_cache(8)
def least_inertia(links: ChainInertia) -> tuple[float, ...]:
    """Return `ChainInertia.least`."""
    poses = itertools.product((0.0,), GRID, GRID, GRID)
    free = [1.0 / np.diag(np.linalg.inv(links.matrix(pose))) for pose in poses]
    return tuple(np.min(free, axis=0).tolist())


def _beyond(links: Sequence[LinkFrame], loads: Sequence[tuple[Floats3, Floats3]]) -> list[tuple[Floats3, Floats3]]:
    """Return, for each joint, the sum of the vectors of all bodies from its own on, and their moment about it.

    loads: of each body, the sum of its vectors and their moment about its own joint.
    """
    whole, moment, place, sums = ZERO, ZERO, links[-1].origin, []
    for link, (own, turn) in zip(reversed(links), reversed(loads), strict=True):
        moment = plus(plus(moment, cross(plus(place, link.origin, -1.0), whole)), turn)
        whole, place = plus(whole, own), link.origin
        sums.append((whole, moment))
    return sums[::-1]
