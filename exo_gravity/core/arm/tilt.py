# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Trunk tilt: orientation of the trunk -> pitch and roll -> direction of gravity in each arm's base frame.

Trunk axes (REP-103): x forward, y left, z up. The trunk rolls by r about x, then pitches by p about y, both fixed axes:
p > 0 bows forward, r > 0 leans to the right. The heading does not affect gravity. Base frame of the left arm in trunk
axes: x0 left, y0 forward, z0 down. The right arm is its mirror image: its gravity is the left arm's at roll -r.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.rotation import Floats3, rotated, unit_quaternion
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Vector, one_float

SIDES = ("left", "right")


class Tilt(NamedTuple):
    """The trunk's tilt in one arm's base frame; create it with one of the `of` methods."""

    #: the trunk's, rad (REP-103)
    pitch: float
    roll: float
    #: (3,) unit vector of gravity in the arm's base frame
    direction: tuple[float, float, float]
    #: angle between joint 1's axis and gravity, rad, 0..pi; the paper's theta_1
    axis_angle: float
    #: the paper's tilt angles, rad, which its mobile law adds to theta_3 and theta_2
    beta: float
    phi: float
    #: of gravity as the arm feels it, as a share of its own; the laws multiply their torque by it
    magnitude: float = 1.0

    @property
    def gravity_in_trunk(self) -> tuple[float, float, float]:
        """Unit vector of gravity (3,) in the trunk's axes, which the root link of a URDF has on either side."""
        level = math.cos(self.pitch)
        return math.sin(self.pitch), -math.sin(self.roll) * level, -math.cos(self.roll) * level

    @classmethod
    def of(cls, side: str, pitch: float = 0.0, roll: float = 0.0) -> "Tilt":
        """Return the tilt of the `side` ('left' or 'right') arm for a trunk at `pitch` and `roll` in rad."""
        pitch = one_float("pitch", pitch, -math.pi, math.pi, "rad")
        roll = one_float("roll", roll, -math.pi, math.pi, "rad")
        return cls._of(side, pitch, roll, *gravity_in_trunk(pitch, roll).tolist())

    @classmethod
    def of_gravity(cls, side: str, gravity_in_trunk: Vector) -> "Tilt":
        """Return the tilt of the `side` arm for gravity's direction in the trunk's axes, a vector (3,) of any length.

        It has no singularity: a trunk that bows past 90 degrees, or lies, has a direction like any other. Raises
        ParameterError.
        """
        x, y, z = map(float, gravity_in_trunk)
        pitch, roll = pitch_roll((x, y, z))
        norm = math.hypot(x, y, z)
        return cls._of(side, pitch, roll, x / norm, y / norm, z / norm)

    @classmethod
    def of_felt(cls, side: str, felt: Vector, one_g: float = 1.0) -> "Tilt":
        """Return `of_gravity` of what the trunk feels as gravity, (3,) in its axes, with its magnitude.

        one_g: 1 g in the unit of `felt`. Raises ParameterError.
        """
        return cls.of_gravity(side, felt)._replace(magnitude=math.hypot(*felt) / one_g)

    @classmethod
    def _of(cls, side: str, pitch: float, roll: float, x: float, y: float, z: float) -> "Tilt":
        if side not in SIDES:
            raise ParameterError("side", side, f"one of {', '.join(SIDES)}")
        y, outward = (y, roll) if side == "left" else (-y, -roll)
        return cls(pitch, roll, (y, x, -z), math.acos(max(-1.0, min(1.0, -z))), -pitch, outward)


def gravity_in_trunk(pitch: float, roll: float) -> np.ndarray:
    """Return the unit vector of gravity, (3,), in the trunk's axes (x forward, y left, z up)."""
    return np.array((math.sin(pitch), -math.sin(roll) * math.cos(pitch), -math.cos(roll) * math.cos(pitch)))


def pitch_roll(gravity_in_trunk: Vector) -> tuple[float, float]:
    """Return the trunk's pitch (-pi/2..pi/2) and roll (-pi..pi) in rad for a gravity vector (3,) in its axes."""
    x, y, z = map(float, gravity_in_trunk)
    norm = math.hypot(x, y, z)
    if not 0.0 < norm < math.inf:
        raise ParameterError("gravity_in_trunk", gravity_in_trunk, "a finite, non-zero vector")
    return math.atan2(x, math.hypot(y, z)), math.atan2(-y, -z)


def turning_in_base(side: str, vector: Sequence[float]) -> Floats3:
    """Return an angular velocity or acceleration (3,) of the trunk in the base frame of the `side` arm."""
    x, y, z = vector
    return (y, x, -z) if side == "left" else (y, -x, z)  # a mirror, as the right arm is of the left, reverses rotations


def angle_between(a: Vector, b: Vector) -> float:
    """Return the angle in rad, 0..pi, between two unit vectors (3,); accurate for small and large angles."""
    return 2.0 * math.atan2(math.dist(a, b), math.dist(a, [-component for component in b]))


def rotation_matrix(quaternion: Vector | None, name: str = "quaternion") -> np.ndarray:
    """Return the rotation matrix (3, 3) of a unit quaternion (x, y, z, w), ROS order.

    Raises ParameterError that names `name` unless its norm is within 1 % of 1, which allows for rounding in drivers.
    """
    unit = unit_quaternion(name, quaternion)
    return np.column_stack([rotated(unit, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))])


#: gravity along each axis of the base frame, for the exact law: in the trunk's axes to the left, forward, down
AXES = tuple(Tilt.of_gravity("left", axis) for axis in ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
