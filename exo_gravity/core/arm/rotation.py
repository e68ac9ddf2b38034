# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Vectors (3,) and unit quaternions (x, y, z, w), ROS order, as plain floats.

For one at a time this is faster than NumPy.
"""

import math
from contextlib import suppress

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Vector

Floats3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

ZERO: Floats3 = (0.0, 0.0, 0.0)


def three_floats(name: str, values: Vector | None) -> Floats3:
    """Return `values` as 3 finite floats, or raise ParameterError that names them."""
    with suppress(TypeError, ValueError):
        x, y, z = map(float, values)  # type: ignore[arg-type]  # None is one of the wrong values
        if -math.inf < x + y + z < math.inf:
            return x, y, z
    raise ParameterError(name, values, "3 finite numbers")


def unit_quaternion(name: str, values: Vector | None) -> Quaternion:
    """Return `values` as a unit quaternion.

    Raises ParameterError that names `name` unless their norm is within 1 % of 1, which allows for rounding in drivers.
    """
    with suppress(TypeError, ValueError):
        x, y, z, w = map(float, values)  # type: ignore[arg-type]  # None is one of the wrong values
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        if abs(norm - 1.0) < 0.01:
            return x / norm, y / norm, z / norm, w / norm
    raise ParameterError(name, values, "a unit quaternion (x, y, z, w)")


def up_in_body(q: Quaternion) -> Floats3:
    """Return the world's z axis in the axes of a body at `q`, world from body: the last row of its matrix."""
    x, y, z, w = q
    return 2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)


def rotated(q: Quaternion, vector: Floats3) -> Floats3:
    """Return `vector` (3,) in world axes for a body at `q`, world from body."""
    x, y, z, w = q
    a, b, c = vector
    # v + 2 w (u x v) + 2 u x (u x v), u = (x, y, z)
    i, j, k = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return a + w * i + y * k - z * j, b + w * j + z * i - x * k, c + w * k + x * j - y * i


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the Hamilton product of two quaternions."""
    (px, py, pz, pw), (qx, qy, qz, qw) = p, q
    return (
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    )


def plus(a: Floats3, b: Floats3, times: float = 1.0) -> Floats3:
    """Return a + times b."""
    return a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]


def dot(a: Floats3, b: Floats3) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Floats3, b: Floats3) -> Floats3:
    """Return the cross product a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def acceleration_of(place: Floats3, angular_velocity: Floats3, angular_acceleration: Floats3) -> Floats3:
    """Return the acceleration of `place` on a rigid body relative to the body's origin, in m/s^2.

    place: m from the origin. angular_velocity: rad/s. angular_acceleration: rad/s^2.
    """
    return plus(cross(angular_acceleration, place), cross(angular_velocity, cross(angular_velocity, place)))
