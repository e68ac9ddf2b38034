"""Quaternions (x, y, z, w) from the angles that some sensors send."""

from __future__ import annotations

import math

from exo_gravity.core.model.rotation import Quaternion


def from_angles(*turns: tuple[str, float]) -> Quaternion:
    """Return the orientation after turns by (axis, rad) in order, each about an axis of the body as turned so far."""
    x, y, z, w = 0.0, 0.0, 0.0, 1.0
    for axis, angle in turns:
        s, c = math.sin(angle / 2), math.cos(angle / 2)
        if axis == "x":
            x, y, z, w = x * c + w * s, y * c + z * s, z * c - y * s, w * c - x * s
        elif axis == "y":
            x, y, z, w = x * c - z * s, y * c + w * s, z * c + x * s, w * c - y * s
        else:
            x, y, z, w = x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s
    return x, y, z, w
