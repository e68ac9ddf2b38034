# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The gravity laws: joint angles -> the torque that each motor must give to hold the arm against gravity.

`exact` is the closed form of Newton-Euler for gravity alone, valid for any centre of gravity, on its link's axis or off
it, and any trunk tilt: docs/mathematics.md derives it. `paper_static` is EQ2-EQ5 and `paper_mobile` is EQ1m-EQ4m of the
paper, word for word. They agree with `exact` only if every centre of gravity is at the far end of its link (d_n = l_n)
and the trunk is upright.

Each formula is written once, for one pose in plain floats (control loop) and for whole arrays (analysis); `xp` is
`math` or `numpy`. Symbols: t1..t4 joint angles in rad, M1..M4 first moments along the links and W, Z, Y3, Y4 across
them in kg m, g gravity in m/s^2; l, d and m1..m4 as in the paper. With the frames of Table 1 (joint n turns about
z_{n-1}, and z_3 = z_4 = z_2) and gravity's unit vector d in the base frame, the torque is linear in the moments:

    S4 = M4 x4 + Y4 y4        S2 = S3 + M2 x2 + Z z2
    S3 = S4 + M3 x3 + Y3 y3   S1 = S2 + M1 x1 + W z1        torque n = g z_{n-1} . (d x S_n)

M_n: mass of link n times its centre of gravity along the link, plus all mass beyond link n times the link's length. W:
of link 1 along z_1 and of link 2 along y_2 = z_1. Z: of links 2, 3 and 4 along z_2. Y3, Y4: of links 3 and 4 along
their y. What lies along a joint's own axis (link 1 along y_1) needs no torque.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from exo_gravity.core.arm.arm_data import ArmData
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import JOINT_COUNT

Torque = tuple[float, ...]  # (n,) Nm in joint order
NO_TORQUE: Torque = (0.0,) * JOINT_COUNT
BLOCK = 8192  # poses at once: what a formula computes on the way stays in the processor's cache
Values = Iterable[Any]  # plain floats, or arrays (n,)


def _exact(arm: ArmData, turned: Values, direction: Values) -> tuple[Any, ...]:
    """Return the closed form of Newton-Euler.

    turned: sine and cosine of t1, t2, t3 and t3 + t4. direction: gravity's unit vector in the arm's base frame.
    """
    s1, c1, s2, c2, s3, c3, s34, c34 = turned
    gx, gy, gz = direction
    (M1, M2, M3, M4), (W, Z, Y3, Y4) = arm.first_moment, arm.off_axis
    # Gravity along the axes that rotate with joint 1: A across the shoulder, B forward.
    A = gx * c1 + gy * s1
    B = gy * c1 - gx * s1
    R = A * s2 + gz * c2
    # First moments of link 4 and of links 3 and 4 together, along link 2 and across it.
    along4, across4 = M4 * c34 - Y4 * s34, M4 * s34 + Y4 * c34
    along, across = M3 * c3 - Y3 * s3 + along4, M3 * s3 + Y3 * c3 + across4
    along2 = M2 + along
    return (
        (W + across) * A - (M1 + along2 * s2 - Z * c2) * B,
        along2 * (gz * s2 - A * c2) - Z * R,
        across * R - along * B,
        across4 * R - along4 * B,
    )


def _paper_static(xp: ModuleType, arm: ArmData, theta: Values) -> tuple[Any, ...]:
    """EQ2-EQ5; theta_1 is the angle between joint 1's axis and gravity."""
    t1, t2, t3, t4 = theta
    (_, l2, l3, l4), (d1, d2, d3, d4), (m1, m2, m3, m4) = (a.tolist() for a in (arm.length, arm.cog, arm.mass))
    return (
        (d1 * (m1 + m2 + m3 + m4) + l2 * (m2 + m3 + m4) * xp.sin(t2) + l3 * (m3 + m4) * xp.cos(t3)
         + l4 * m4 * xp.cos(t3 + t4)) * xp.sin(t1),
        (d2 * (m2 + m3 + m4) + l3 * (m3 + m4) * xp.cos(t3) + l4 * m4 * xp.cos(t3 + t4)) * xp.sin(t2),
        (d3 * (m3 + m4) * xp.sin(t3) + l4 * m4 * xp.sin(t3 + t4)) * xp.cos(t2),
        d4 * m4 * xp.sin(t3 + t4) * xp.cos(t2),
    )  # fmt: skip


def _paper_mobile(xp: ModuleType, arm: ArmData, theta: Values, beta: Any, phi: Any) -> tuple[Any, ...]:
    """EQ1m-EQ4m: EQ2-EQ5 at theta_2 + phi and theta_3 + beta, times cos(phi) cos(beta).

    Joints 2 to 4 have the additional factor cos(theta_1).
    """
    t1, t2, t3, t4 = theta
    tau1, tau2, tau3, tau4 = _paper_static(xp, arm, (t1, t2 + phi, t3 + beta, t4))
    upright = xp.cos(phi) * xp.cos(beta)
    axis = xp.cos(t1) * upright
    return tau1 * upright, tau2 * axis, tau3 * axis, tau4 * axis


def gravity_torque(arm: ArmData, theta: ArrayLike, direction: ArrayLike = (0.0, 0.0, 1.0)) -> np.ndarray:
    """Return the torque in Nm that holds `arm` against gravity by the exact law, in the shape of `theta`.

    theta: (4,) or (n, 4) rad. direction: (3,) or (n, 3), unit vector of gravity in the arm's base frame; (0, 0, 1) if
    the trunk is upright. Raises ParameterError if a shape is wrong, a number is not finite, or a direction is not a
    unit vector.
    """
    poses = _poses(theta)
    down = np.asarray(direction, dtype=float)
    if down.shape not in ((3,), (*poses.shape[:-1], 3)):
        raise ParameterError("direction", down, f"of shape (3,) or {(*poses.shape[:-1], 3)}")
    if not np.allclose(np.linalg.norm(down, axis=-1), 1.0, atol=1e-6, rtol=0):
        raise ParameterError("direction", down, "a unit vector")
    return _torque(lambda xp, arm, theta, down: _exact(arm, _turned(*theta), down), arm, poses, down)


def _turned(t1: np.ndarray, t2: np.ndarray, t3: np.ndarray, t4: np.ndarray) -> Iterator[np.ndarray]:
    """Yield sine and cosine (n,) of t1, t2, t3 and t3 + t4 (n,) in rad.

    Both follow from the tangent of half the angle, within 3e-16: one call in place of two, which take most of the time.
    """
    for angle in (t1, t2, t3, t3 + t4):
        tangent = np.tan(0.5 * angle)
        one_plus_cosine = 2.0 / (1.0 + tangent * tangent)
        yield tangent * one_plus_cosine
        yield one_plus_cosine - 1.0


def paper_static_torque(arm: ArmData, theta: ArrayLike) -> np.ndarray:
    """Return the torque of EQ2-EQ5 in Nm, in the shape of `theta`.

    theta: (4,) or (n, 4) rad. Here theta_1 is the angle between joint 1's axis and gravity (0 for an upright wearer),
    not joint 1's encoder angle. Raises ParameterError if the shape is wrong, a number is not finite, or the arm is
    given by its moments or has moments across its links.
    """
    arm.check_masses("paper_static")
    return _torque(_paper_static, arm, _poses(theta))


def paper_mobile_torque(arm: ArmData, theta: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> np.ndarray:
    """Return the torque of EQ1m-EQ4m in Nm, in the shape of `theta`.

    theta: (4,) or (n, 4) rad, with theta_1 as in `paper_static_torque`. pitch, yaw: the paper's beta and phi in rad, a
    number or (n,) each. `Tilt` computes beta, phi and theta_1 for a trunk. Raises ParameterError as above.
    """
    arm.check_masses("paper_mobile")
    poses = _poses(theta)
    beta, phi = (np.asarray(angle, dtype=float) for angle in (pitch, yaw))
    for name, angle in (("pitch", beta), ("yaw", phi)):
        if angle.shape not in ((), poses.shape[:-1]) or not np.all(np.isfinite(angle)):
            raise ParameterError(name, angle, f"a finite number or an array of shape {poses.shape[:-1]}")
    tilt = np.stack(np.broadcast_arrays(beta, phi), axis=-1)
    return _torque(lambda xp, arm, angles, tilt: _paper_mobile(xp, arm, angles, *tilt), arm, poses, tilt)


def _poses(theta: ArrayLike) -> np.ndarray:
    poses = np.asarray(theta, dtype=float)
    if poses.ndim not in (1, 2) or poses.shape[-1] != JOINT_COUNT:
        raise ParameterError("theta", poses, f"of shape (4,) or (n, 4), not {poses.shape}")
    if not np.all(np.isfinite(poses)):
        raise ParameterError("theta", poses, "finite angles in rad")
    return poses


def _torque(formula: Callable[..., tuple[Any, ...]], arm: ArmData, *inputs: np.ndarray) -> np.ndarray:
    """Return the scaled torque (4,) or (n, 4) by `formula`; inputs: (k,) for all poses, or (n, k), the angles first."""
    poses, *others = inputs
    rows, scale = np.atleast_2d(poses), arm.gain * arm.gravity
    result = np.empty_like(rows)
    for begin in range(0, len(rows), BLOCK):
        part = slice(begin, begin + BLOCK)
        columns = (values[part].T.copy() if values.ndim == 2 else values for values in (rows, *others))
        for torque, factor, column in zip(formula(np, arm, *columns), scale, result[part].T, strict=True):
            np.multiply(torque, factor, out=column)
    return result.reshape(poses.shape)


def exact_torque(arm: ArmData, theta: Sequence[float], tilt: Tilt) -> Torque:
    """Return the torque (4,) in Nm that holds `arm` by the exact law, of one pose in plain floats.

    theta: (4,) rad.
    """
    t1, t2, t3, t4 = theta
    sin, cos = math.sin, math.cos
    turned = sin(t1), cos(t1), sin(t2), cos(t2), sin(t3), cos(t3), sin(t3 + t4), cos(t3 + t4)
    return _scaled(arm, tilt, _exact(arm, turned, tilt.direction))


def static_torque(arm: ArmData, theta: Sequence[float], tilt: Tilt) -> Torque:
    """Return the torque of EQ2-EQ5 like `exact_torque`; joint 1's own angle is not used."""
    return _scaled(arm, tilt, _paper_static(math, arm, (tilt.axis_angle, *theta[1:])))


def mobile_torque(arm: ArmData, theta: Sequence[float], tilt: Tilt) -> Torque:
    """Return the torque of EQ1m-EQ4m like `exact_torque`; joint 1's own angle is not used."""
    return _scaled(arm, tilt, _paper_mobile(math, arm, (tilt.axis_angle, *theta[1:]), tilt.beta, tilt.phi))


def _scaled(arm: ArmData, tilt: Tilt, tau: Torque) -> Torque:
    a, b, c, d = arm.scale
    felt = tilt.magnitude
    return felt * a * tau[0], felt * b * tau[1], felt * c * tau[2], felt * d * tau[3]


MAX_OFFSET = 0.1  # m of a centre of gravity from its link


def moments_of(arm: ArmData) -> np.ndarray:
    """Return the eight moments (8,) of `arm` in kg m."""
    return np.array((*arm.first_moment, *arm.off_axis))
