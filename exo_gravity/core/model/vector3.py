"""Vectors (3,) as plain floats: for one at a time this is faster than NumPy."""

from __future__ import annotations

from exo_gravity.core.model.quaternion import Floats3


def plus(a: Floats3, b: Floats3, times: float = 1.0) -> Floats3:
    """Return a + times b."""
    return a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]


def dot(a: Floats3, b: Floats3) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Floats3, b: Floats3) -> Floats3:
    """Return the cross product a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def acceleration_of(place: Floats3, turning: Floats3, spin_up: Floats3) -> Floats3:
    """Return by how much `place` on a turning body accelerates beyond the body's origin, in m/s^2.

    place: m from the origin. turning: rad/s, spin_up: rad/s^2.
    """
    return plus(cross(spin_up, place), cross(turning, cross(turning, place)))
