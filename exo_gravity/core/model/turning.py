"""The torque that an arm needs to turn along with its base, beyond the torque against gravity.

A trunk that turns faster and faster takes the arm along only if the motors accelerate it: joint n must give the moment
of all m (alpha x r) beyond it about its axis. Each link counts as a slender rod with its mass and its centre of
gravity; what depends on speed is neglected (at 1 rad/s it is a tenth of gravity's torque, or less).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.rotation import Floats3, cross, dot, plus

Link = tuple[float, float, float]  # length m, centre of gravity m, mass kg


def turning_torque(
    arm: ArmModel, side: str, theta: Sequence[float], angular_acceleration: Sequence[float]
) -> tuple[float, ...]:
    """Return the torque (4,) in Nm of the `side` arm at `theta` (4,) rad.

    angular_acceleration: of the trunk, (3,) rad/s^2 in its own axes. An arm that is given by its moments counts as
    links with their centres of gravity halfway.
    """
    x, y, z = angular_acceleration
    # In the base frame; a mirror, as the right arm is of the left one, reverses rotations.
    alpha = (y, x, -z) if side == "left" else (y, -x, z)
    force = moment = (0.0, 0.0, 0.0)
    torque = []
    for (length, cog, mass), (origin, axis, along), gain in zip(
        _links(arm)[::-1], _frames(arm, theta)[::-1], arm.gain.tolist()[::-1], strict=True
    ):
        place = plus(origin, along, cog)
        push = cross(alpha, place)
        force = plus(force, push, mass)
        moment = plus(moment, cross(place, push), mass)
        spin = plus(alpha, along, -dot(along, alpha))
        moment = plus(moment, spin, mass * length**2 / 12.0)
        torque.append(gain * dot(axis, plus(moment, cross(origin, force), -1.0)))
    return tuple(torque[::-1])


@lru_cache(8)
def _links(arm: ArmModel) -> tuple[Link, ...]:
    """Return the links from the shoulder to the hand."""
    length = arm.length.tolist()
    if not arm.by_moments:
        return tuple(zip(length, arm.cog.tolist(), arm.mass.tolist(), strict=True))
    links: list[Link] = []
    beyond = 0.0  # kg
    for own, moment in zip(length[::-1], arm.first_moment[::-1], strict=True):
        mass = max(0.0, 2.0 * (moment / own - beyond)) if own else 0.0
        links.append((own, own / 2.0, mass))
        beyond += mass
    return tuple(links[::-1])


def _frames(arm: ArmModel, theta: Sequence[float]) -> list[tuple[Floats3, Floats3, Floats3]]:
    """Return origin, joint axis and direction of each link in the base frame (Table 1 of the paper)."""
    t1, t2, t3, t4 = theta
    l1, l2, l3, _ = arm.length.tolist()
    s1, c1, s2, c2 = math.sin(t1), math.cos(t1), math.sin(t2), math.cos(t2)
    first: Floats3 = (c1, s1, 0.0)
    swing: Floats3 = (-s1, c1, 0.0)  # the axis of joint 2
    second: Floats3 = (s2 * c1, s2 * s1, c2)
    bend: Floats3 = (-c2 * c1, -c2 * s1, s2)  # the axis of joints 3 and 4
    third = plus(plus((0.0, 0.0, 0.0), second, math.cos(t3)), swing, math.sin(t3))
    fourth = plus(plus((0.0, 0.0, 0.0), second, math.cos(t3 + t4)), swing, math.sin(t3 + t4))
    shoulder = plus((0.0, 0.0, 0.0), first, l1)
    flexion = plus(shoulder, second, l2)
    return [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), first),
        (shoulder, swing, second),
        (flexion, bend, third),
        (plus(flexion, third, l3), bend, fourth),
    ]
