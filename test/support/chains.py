# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Serial arms at random, as URDFs: any axes, any centres of gravity, fixed joints between some of the links."""

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

LEAST = math.radians(20.0)  # between the axes of neighbouring joints


def random_chain(count: int, seed: int, zero: Sequence[float] = ()) -> tuple[str, list[str]]:
    """Return the URDF of an arm with `count` turning joints, and their names; the last link is `hand`.

    zero: rad, where the angles of the same arm without `zero` are 0 here; () where they are 0 there.
    """
    random, most = np.random.default_rng(seed), 0.2 if count < 9 else 0.15  # m: no arm reaches farther than 2
    names = [f"joint_{n}" for n in range(count)]
    parts, parent, last = ['<link name="base"/>'], "base", np.zeros(3)
    for name, angle in zip(names, zero or [0.0] * count, strict=True):
        while True:
            axis = random.normal(size=3)
            axis /= np.linalg.norm(axis)
            if abs(axis @ last) < math.cos(LEAST):
                break
        last, child = axis, f"link_of_{name}"
        middle = f"{child}_mount"
        place, rpy = random.uniform(-most, most, 3), random.uniform(-3, 3, 3)
        parts += [
            joint(f"{name}_mount", "fixed", parent, middle, random.uniform(-0.05, 0.05, 3), random.uniform(-3, 3, 3)),
            f'<link name="{middle}">{inertial(random, 0.1)}</link>',
            joint(name, "revolute", middle, child, place, turned(rpy, axis, angle), axis),
            f'<link name="{child}">{inertial(random, 0.6)}</link>',
        ]
        parent = child
    parts += [joint("grip", "fixed", parent, "hand", random.uniform(-0.2, 0.2, 3), np.zeros(3)), '<link name="hand"/>']
    return f'<robot name="chain">{"".join(parts)}</robot>', names


def joint(
    name: str, kind: str, parent: str, child: str, place: np.ndarray, turn: np.ndarray, axis: np.ndarray | None = None
) -> str:
    """Return the element of a joint."""
    turning = "" if axis is None else f'<axis xyz="{row(axis)}"/><limit lower="-3" upper="3" effort="30" velocity="5"/>'
    origin = f'<origin xyz="{row(place)}" rpy="{row(turn)}"/>'
    return (
        f'<joint name="{name}" type="{kind}">{origin}<parent link="{parent}"/><child link="{child}"/>{turning}</joint>'
    )


def turned(rpy: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rpy of a joint's origin after it is turned about its axis."""
    matrix = pin.rpy.rpyToMatrix(rpy) @ pin.AngleAxis(angle, axis).toRotationMatrix()
    return pin.rpy.matrixToRpy(matrix)


def inertial(random: np.random.Generator, most: float) -> str:
    """Return the inertia of a body of up to `most` kg."""
    mass, cog = random.uniform(0.2 * most, most), random.uniform(-0.08, 0.08, 3)
    ixx, iyy, izz = (mass * 0.01 * random.uniform(0.8, 1.2, 3)).tolist()
    moments = f'ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"'
    return f'<inertial><origin xyz="{row(cog)}"/><mass value="{mass}"/><inertia {moments}/></inertial>'


def row(values: np.ndarray) -> str:
    return " ".join(map(repr, values.tolist()))
