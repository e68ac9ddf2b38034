"""The laws: joint angles -> the torque that each motor must give to hold the arm against gravity.

`exact` is the closed form of Newton-Euler for gravity alone, with any centre of gravity and any trunk tilt.
`paper_static` is EQ2-EQ5 and `paper_mobile` EQ1m-EQ4m of the paper, word for word. They agree with `exact` where
every centre of gravity sits at its link's far end (d_n = l_n) and the trunk is upright; elsewhere they do not.

Each formula is written once, for `xp`: the module `math` for one pose in plain floats (control loop), or `numpy` for
whole arrays (analysis). Symbols: t1..t4 joint angles in rad, M1..M4 first moments in kg m, g gravity in m/s^2,
l, d, m1..m4 as in the paper.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from exo_gravity.core.arm import ArmModel
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.tilt import Tilt

Torque = tuple[float, float, float, float]
BLOCK = 4096  # poses computed at once: intermediate arrays then fit the processor's cache


def _exact(xp, arm: ArmModel, theta, direction):
    """Closed form of Newton-Euler for gravity: `direction` is gravity's unit vector in the arm's base frame."""
    t1, t2, t3, t4 = theta
    gx, gy, gz = direction
    M1, M2, M3, M4 = arm.first_moment
    s1, c1, s2, c2 = xp.sin(t1), xp.cos(t1), xp.sin(t2), xp.cos(t2)
    s34, c34 = xp.sin(t3 + t4), xp.cos(t3 + t4)
    # Gravity along joint 1's rotating axes: A across the shoulder, B forward of it.
    A = gx * c1 + gy * s1
    B = gy * c1 - gx * s1
    # First moment of the planar part (links 3 and 4) along link 2 and across it.
    along = M3 * xp.cos(t3) + M4 * c34
    across = M3 * xp.sin(t3) + M4 * s34
    R = A * s2 + gz * c2
    return (
        across * A - (M1 + (M2 + along) * s2) * B,
        (M2 + along) * (gz * s2 - A * c2),
        across * R - along * B,
        M4 * (s34 * R - c34 * B),
    )


def _paper_static(xp, arm: ArmModel, theta):
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


def _paper_mobile(xp, arm: ArmModel, theta, beta, phi):
    """EQ1m-EQ4m: EQ2-EQ5 with theta_3 + beta and theta_2 + phi, times the factors of the tilt.

    They are what EQ2-EQ5 give at the shifted angles, times cos(phi) cos(beta), and for joints 2 to 4 cos(theta_1).
    """
    t1, t2, t3, t4 = theta
    tau1, tau2, tau3, tau4 = _paper_static(xp, arm, (t1, t2 + phi, t3 + beta, t4))
    upright = xp.cos(phi) * xp.cos(beta)
    axis = xp.cos(t1) * upright
    return tau1 * upright, tau2 * axis, tau3 * axis, tau4 * axis


def gravity_torque(arm: ArmModel, theta, direction=(0.0, 0.0, 1.0)) -> np.ndarray:
    """Return the torque in Nm, shape of `theta`, that holds `arm` against gravity: the exact law.

    theta: (4,) or (n, 4) rad. direction: (3,) or (n, 3), unit vector of gravity in the arm's base frame;
    upright it is (0, 0, 1). Raises ParameterError on other shapes, on NaN or infinity, or if it is no unit vector.
    """
    theta = _poses(theta)
    direction = np.asarray(direction, dtype=float)
    if direction.shape not in ((3,), (*theta.shape[:-1], 3)):
        raise ParameterError("direction", direction, f"of shape (3,) or {(*theta.shape[:-1], 3)}")
    if not np.allclose(np.linalg.norm(direction, axis=-1), 1.0, atol=1e-6, rtol=0):
        raise ParameterError("direction", direction, "a unit vector")
    return _in_blocks(_exact, arm, theta, direction)


def paper_static_torque(arm: ArmModel, theta) -> np.ndarray:
    """Return EQ2-EQ5 in Nm, shape of `theta`.

    theta: (4,) or (n, 4) rad, theta_1 being the angle between joint 1's axis and gravity (0 for an upright wearer),
    not joint 1's encoder angle. Raises ParameterError on other shapes, on NaN or infinity.
    """
    return _in_blocks(_paper_static, arm, _poses(theta))


def paper_mobile_torque(arm: ArmModel, theta, pitch, yaw) -> np.ndarray:
    """Return EQ1m-EQ4m in Nm, shape of `theta`.

    theta: (4,) or (n, 4) rad, theta_1 as in `paper_static_torque`. pitch, yaw: the paper's beta and phi in rad,
    a number or (n,) each; `Tilt` gives them, and theta_1, for a trunk. Raises ParameterError as above.
    """
    theta = _poses(theta)
    beta, phi = (np.asarray(angle, dtype=float) for angle in (pitch, yaw))
    for name, angle in (("pitch", beta), ("yaw", phi)):
        if angle.shape not in ((), theta.shape[:-1]) or not np.all(np.isfinite(angle)):
            raise ParameterError(name, angle, f"a finite number or an array of shape {theta.shape[:-1]}")
    tilt = np.stack(np.broadcast_arrays(beta, phi), axis=-1)
    return _in_blocks(lambda xp, arm, angles, tilt: _paper_mobile(xp, arm, angles, *tilt), arm, theta, tilt)


def _poses(theta) -> np.ndarray:
    theta = np.asarray(theta, dtype=float)
    if theta.ndim not in (1, 2) or theta.shape[-1] != 4:
        raise ParameterError("theta", theta, f"of shape (4,) or (n, 4), not {theta.shape}")
    if not np.all(np.isfinite(theta)):
        raise ParameterError("theta", theta, "finite angles in rad")
    return theta


def _in_blocks(formula, arm: ArmModel, theta: np.ndarray, *inputs: np.ndarray) -> np.ndarray:
    """Return `formula` of whole arrays, scaled, in the shape of `theta`; inputs: (k,), or (n, k) with one per pose."""
    scale = arm.gain * arm.gravity
    poses = np.atleast_2d(theta)
    rows = [np.atleast_2d(values) for values in inputs]
    torque = np.empty_like(poses)
    for begin in range(0, len(poses), BLOCK):
        part = slice(begin, begin + BLOCK)
        columns = [(row if len(row) == 1 else row[part]).T for row in rows]
        for joint, tau in enumerate(formula(np, arm, poses[part].T.copy(), *columns)):
            np.multiply(tau, scale[joint], out=torque[part, joint])
    return torque.reshape(theta.shape)


class Law(Protocol):
    """A law as the control loop uses it: one pose in plain floats."""

    def torque(self, arm: ArmModel, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (4,) in Nm that holds `arm` at `theta` (4,) rad."""
        ...

    def outside(self, arm: ArmModel, theta: Sequence[float], tilt: Tilt) -> str:
        """Return a sentence why the law does not apply to this arm, pose or tilt; '' where it does.

        The sentence holds no measured value, so that it stays the same for as long as the reason does.
        """
        ...


class ClosedForm(NamedTuple):
    """A law given by a formula, which applies everywhere: `unscaled(arm, theta, tilt)` -> torque / (c_n g)."""

    unscaled: Callable[[ArmModel, Sequence[float], Tilt], Torque]

    def torque(self, arm: ArmModel, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (4,) in Nm."""
        scale = arm.scale
        tau = self.unscaled(arm, theta, tilt)
        return scale[0] * tau[0], scale[1] * tau[1], scale[2] * tau[2], scale[3] * tau[3]

    def outside(self, arm: ArmModel, theta: Sequence[float], tilt: Tilt) -> str:
        """Return '': a closed form applies everywhere."""
        return ""


LAWS: dict[str, Law] = {
    "exact": ClosedForm(lambda arm, t, tilt: _exact(math, arm, t, tilt.direction)),
    "paper_static": ClosedForm(lambda arm, t, tilt: _paper_static(math, arm, (tilt.axis_angle, *t[1:]))),
    "paper_mobile": ClosedForm(
        lambda arm, t, tilt: _paper_mobile(math, arm, (tilt.axis_angle, *t[1:]), tilt.beta, tilt.phi)
    ),
}
