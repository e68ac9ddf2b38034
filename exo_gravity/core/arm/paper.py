# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The paper's arm: Table 1, its four links, and the gravity laws: joint angles -> the torque that holds the arm.

Table 1 (standard Denavit-Hartenberg): a = `length`, alpha = (-pi/2, +pi/2, 0, 0), d = 0, joint offsets (0, -pi/2, 0,
0), z0 along gravity when the trunk is upright. Joint order everywhere: shoulder rotation about the vertical, shoulder
abduction, shoulder flexion, elbow flexion. At theta = (any, 0, 0, 0) the arm hangs straight down.

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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields
from functools import lru_cache
from itertools import chain
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from exo_gravity.core.arm.chain import Body, ChainInertia, frames
from exo_gravity.core.arm.interface import (
    MAX_GAIN,
    MAX_GRAVITY,
    MAX_MASS,
    MAX_PAYLOAD,
    MAX_REACH,
    NO_LOAD,
    STANDARD_GRAVITY,
    Frames,
    Payload,
    Skeleton,
)
from exo_gravity.core.arm.rotation import ZERO
from exo_gravity.core.arm.tilt import Tilt, turning_in_base
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import USUAL_MOTORS
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.numbers import JOINT_COUNT, NO_TORQUE, Torque, Vector, floats, four_floats, one_float

# These bounds catch wrong units (grams for kilograms, millimetres for metres), not unusual designs.
MAX_LENGTH = 1.0  # m
MAX_MOMENT = 10.0  # kg m; it takes 98 Nm to hold, several times a motor's peak torque
MAX_WORN_MOMENT = 4.0  # kg m, of a wearer's arm along a link; stretched out, that of a 150 kg person has 2
MAX_WORN_BESIDE = 0.5  # kg m, of the same across the links: 7 kg at 7 cm
MAX_OFFSET = 0.1  # m of a centre of gravity from its link

NOT_KNOWN = np.full(JOINT_COUNT, np.nan)  # masses and centres of gravity of an arm given by its moments
ROTORS = tuple(MOTORS[name].rotor_inertia for name in USUAL_MOTORS)  # kg m^2, where the motors are not known
REACH = (0.8, 0.8, 0.8, 0.6)  # of a link's length, at which the mass of an arm given by its moments is assumed
LEAST_REACH = 0.01  # m
# Links that share W, Z, Y3 and Y4, all equally far off, and the axis of each along which they are: 1 for y, 2 for z.
SHARED = (((0, 2), (1, 1)), ((1, 2), (2, 2), (3, 2)), ((2, 1),), ((3, 1),))
BLOCK = 8192  # poses at once: what a formula computes on the way stays in the processor's cache
Values = Iterable[Any]  # plain floats, or arrays (n,)


@dataclass(frozen=True, init=False)
class ArmModel:
    """Lengths, centres of gravity, masses and gains of a 4-joint arm.

    Immutable. Raises ParameterError that names the invalid value. `from_moments` makes an arm whose masses are not
    known.
    """

    length: np.ndarray = field(compare=False)  #: (4,) m, link lengths l_n (the a_n of Table 1)
    #: (4,) m, d_n of link n's centre of gravity from joint n along the link, 0 <= d_n <= l_n
    cog: np.ndarray = field(compare=False)
    mass: np.ndarray = field(compare=False)  #: (4,) kg, link masses m_n
    #: (4,), the paper's c_n, which scales the torque of joint n; 0..2, 1 by default
    gain: np.ndarray = field(compare=False)
    gravity: float  #: m/s^2
    off_axis: tuple[float, ...]  #: (W, Z, Y3, Y4) kg m across the links, see above; 0 by default
    #: M1..M4 in kg m: the mass of link n times d_n plus all mass beyond link n times l_n; plain floats
    first_moment: tuple[float, ...] = field(init=False, repr=False)
    #: (4,) m/s^2, c_n times gravity; plain floats
    scale: tuple[float, ...] = field(init=False, repr=False)
    #: whether the arm was made by `from_moments`; then `cog` and `mass` are NaN
    by_moments: bool = field(init=False, repr=False)
    payload: Payload = field(init=False, repr=False)  #: in the hand, by `with_payload`; the moments contain it
    arrays: tuple[bytes, ...] = field(init=False, repr=False)  #: the four above, which do not compare by themselves

    def __init__(
        self,
        length: Vector,
        cog: Vector,
        mass: Vector,
        gain: Vector = (1.0,) * JOINT_COUNT,
        gravity: float = STANDARD_GRAVITY,
        off_axis: Vector = (0.0,) * JOINT_COUNT,
        first_moment: Vector | None = None,
    ) -> None:
        lengths = four_floats("length", length, 0.0, MAX_LENGTH, "m")
        if first_moment is None:
            cogs = four_floats("cog", cog, 0.0, MAX_LENGTH, "m")
            if np.any(cogs > lengths):
                raise ParameterError("cog", cog, f"within its link, at most length = {lengths.tolist()} m")
            masses = four_floats("mass", mass, 0.0, MAX_MASS, "kg")
            moments = moments_along(lengths, cogs, masses)
        else:
            cogs = masses = NOT_KNOWN
            moments = four_floats("first_moment", first_moment, 0.0, MAX_MOMENT, "kg m")
        gains = four_floats("gain", gain, 0.0, MAX_GAIN)
        gravity = one_float("gravity", gravity, 0.0, MAX_GRAVITY, "m/s^2")
        across = tuple(four_floats("off_axis", off_axis, -MAX_MOMENT, MAX_MOMENT, "kg m").tolist())
        scale = tuple((gains * gravity).tolist())
        arrays = lengths, cogs, masses, gains
        given = (gravity, across, tuple(moments.tolist()), scale, masses is NOT_KNOWN, NO_LOAD)
        values = (*arrays, *given, tuple(array.tobytes() for array in arrays))
        for own_field, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, own_field.name, value)

    @classmethod
    def from_moments(
        cls,
        length: Vector,
        first_moment: Vector,
        off_axis: Vector = (0.0,) * JOINT_COUNT,
        gain: Vector = (1.0,) * JOINT_COUNT,
        gravity: float = STANDARD_GRAVITY,
    ) -> "ArmModel":
        """Return the arm with links of `length` (4,) m that is given by its moments, (4,) kg m each.

        first_moment: M1..M4, 0..MAX_MOMENT. The other arguments are those of the constructor. Raises ParameterError.
        """
        return cls(length, NOT_KNOWN, NOT_KNOWN, gain, gravity, off_axis, first_moment)

    @property
    def total_mass(self) -> float:
        """Mass of links and load in kg; of an arm given by its moments, the least mass that can have them."""
        if not self.by_moments:
            return float(self.mass.sum()) + self.payload.mass
        moment = np.array(self.first_moment)
        return float(np.max(np.divide(moment, self.length, out=np.zeros(JOINT_COUNT), where=self.length > 0)))

    def check_masses(self, what: str) -> None:
        """Raise ParameterError unless masses are known and all centres of gravity lie on the links, as `what` needs."""
        if self.payload.mass:
            raise ParameterError("payload.mass", self.payload.mass, f"0 for {what}, which knows no load in the hand")
        if self.by_moments:
            raise ParameterError("robot.first_moment", self.first_moment, f"0 for {what}, which needs mass and cog")
        if any(self.off_axis):
            raise ParameterError("robot.off_axis", self.off_axis, f"0 for {what}, which knows no moments across links")

    def with_masses(self, law: str) -> "ArmModel":
        """Return this arm for a law that needs its masses. Raises ParameterError."""
        self.check_masses(f"law {law}")
        return self

    def with_payload(self, mass: float, cog: Vector = ZERO) -> "ArmModel":
        """Return this arm with a load of `mass` kg in its hand, instead of any other.

        cog: (3,) m, its centre of gravity in frame 4 of Table 1: from the end of link 4, along link 4 (x_4), across it
        in the plane in which the elbow bends (y_4), and along the elbow's axis (z_4). Raises ParameterError.
        """
        mass = one_float("payload.mass", mass, 0.0, MAX_PAYLOAD, "kg")
        loaded, bare = copy(self), _payload_moments(self.length, self.payload)
        x, y, z = floats("payload.cog", cog, 3, -MAX_REACH, MAX_REACH, "m").tolist()
        payload = Payload(mass, (x, y, z))
        change = _payload_moments(self.length, payload) - bare
        for name, moments in zip(("first_moment", "off_axis"), change, strict=True):
            object.__setattr__(loaded, name, tuple(np.add(getattr(self, name), moments).tolist()))
        object.__setattr__(loaded, "payload", payload)
        return loaded

    def with_wearer(self, mass: Vector, cog: Vector, support: float = 1.0) -> "ArmModel":
        """Return this arm plus a share `support` (0..1) of the wearer's arm: 0 is One-G, 1 is full Zero-G.

        mass: (4,) kg and cog: (4,) m of the wearer's segments on each link. Masses add up, and so do first moments.
        """
        carried = four_floats("wearer.mass", mass, 0.0, MAX_MASS, "kg") * one_float("support", support, 0.0, 1.0)
        distance = four_floats("wearer.cog", cog, 0.0, MAX_LENGTH, "m")
        if np.any(distance > self.length):
            raise ParameterError("wearer.cog", cog, f"within its link, at most length = {self.length.tolist()} m")
        bare, scale = self.with_payload(0.0), (self.gain, self.gravity)
        if self.by_moments:
            moment = np.add(bare.first_moment, moments_along(self.length, distance, carried))
            worn = ArmModel.from_moments(self.length, moment, bare.off_axis, *scale)
        else:
            total = self.mass + carried
            moment = self.mass * self.cog + carried * distance
            combined = np.divide(moment, total, out=self.cog.copy(), where=total > 0)
            worn = ArmModel(self.length, np.minimum(combined, self.length), total, *scale, bare.off_axis)
        return worn.with_payload(*self.payload)

    def with_wearer_moments(self, moments: Sequence[Vector], support: float = 1.0) -> "ArmModel":
        """Return this arm plus a share `support` (0..1) of a wearer's arm that is known by its moments.

        moments: what it adds to M1..M4 and to W, Z, Y3, Y4, (2, 4) kg m. Raises ParameterError.
        """
        first_moment, off_axis = moments
        share = one_float("support", support, 0.0, 1.0)
        along = four_floats("wearer.first_moment", first_moment, 0.0, MAX_WORN_MOMENT, "kg m")
        across = four_floats("wearer.off_axis", off_axis, -MAX_WORN_BESIDE, MAX_WORN_BESIDE, "kg m")
        bare = self.with_payload(0.0)
        whole = bare.first_moment + share * along, bare.off_axis + share * across
        worn = ArmModel.from_moments(self.length, *whole, self.gain, self.gravity)
        return worn.with_payload(*self.payload)

    def torque(self, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (4,) in Nm that holds the arm by the exact law, of one pose (4,) rad in plain floats."""
        t1, t2, t3, t4 = theta
        sin, cos = math.sin, math.cos
        turned = sin(t1), cos(t1), sin(t2), cos(t2), sin(t3), cos(t3), sin(t3 + t4), cos(t3 + t4)
        return _scaled(self, tilt, _exact(self, turned, tilt.direction))

    def torques(self, theta: ArrayLike, direction: ArrayLike) -> np.ndarray:
        """Return `gravity_torque`."""
        return gravity_torque(self, theta, direction)

    def turning_torque(self, side: str, theta: Sequence[float], angular_acceleration: Sequence[float]) -> Torque:
        """Return the torque (4,) in Nm that turns the `side` arm at `theta` (4,) rad along with its base.

        A trunk that turns faster and faster takes the arm along only if the motors accelerate it. What depends on speed
        is neglected (at 1 rad/s it is a tenth of gravity's torque, or less). angular_acceleration: of the trunk, (3,)
        rad/s^2 in its own axes.
        """
        torque = self.links.turning_torque(theta, turning_in_base(side, angular_acceleration))
        return tuple([gain * tau for gain, tau in zip(self.gain.tolist(), torque, strict=True)])

    @property
    def moments(self) -> np.ndarray:
        """M1..M4 and W, Z, Y3, Y4, (8,) kg m."""
        return np.array((*self.first_moment, *self.off_axis))

    @property
    def given_mass(self) -> float:
        """Kg: all of it."""
        return self.total_mass

    @property
    def has_hand(self) -> bool:
        """True: a load is held at the end of link 4."""
        return True

    @property
    def links(self) -> ChainInertia:
        """The inertia, with the usual rotors; approximate if the arm is given by its moments."""
        return _inertia(self)

    def worn_links(self, mass: Vector, cog: Vector) -> ChainInertia:
        """Return the inertia with the wearer's segments, (4,) kg at (4,) m along their links, as rods of their own."""
        return self.links.joined_with(ArmModel(self.length, cog, mass).links)

    def frames(self, theta: np.ndarray) -> Frames:
        """Return where the arm is at `theta` (m, 4) rad, in the arm's base frame; the hand is the end of link 4.

        Frames are those of Table 1: a joint has that of the link before.
        """
        at = (theta[0].tolist(), math) if len(theta) == 1 else (theta.T, np)  # plain floats are faster for one
        numbers = np.empty((JOINT_COUNT * 15, len(theta)))
        for row, value in zip(numbers, chain.from_iterable(chain(*frames(self.length.tolist(), *at))), strict=True):
            row[:] = value
        links = numbers.T.reshape(-1, JOINT_COUNT, 5, 3)
        after, base = np.swapaxes(links[:, :, 2:], 2, 3), np.broadcast_to(np.eye(3), (len(links), 1, 3, 3))
        hand = links[:, 3:, 0] + self.length[3] * links[:, 3:, 2]
        places = np.concatenate((links[:, :, 0], hand), axis=1)
        return Frames(np.concatenate((base, after[:, :-1]), axis=1), after, places)

    def skeleton(self) -> Skeleton:
        """Return the largest moments; axes and links are what `can_bridge` assumes."""
        w, z, y3, y4 = map(abs, self.off_axis)
        beside = np.array((w + z + y3 + y4, z + y3 + y4, y3 + y4, y4))
        return Skeleton(np.empty((0, 3)), np.empty((0, 3)), np.array(self.first_moment), beside)

    @property
    def facts(self) -> Mapping[str, Sequence[float] | None]:
        """Masses and centres of gravity of the links, None if only the moments are known, and the moments."""
        mass, cog = (None, None) if self.by_moments else (self.mass.tolist(), self.cog.tolist())
        return {"mass (kg)": mass, "cog (m)": cog, "moments (kg m)": self.moments.tolist()}

    def massless(self, gravity: float) -> "ArmModel":
        """Return an arm with these links, without any mass, with gains of 1, where gravity is `gravity` m/s^2."""
        return ArmModel.from_moments(self.length, NO_TORQUE, gravity=gravity)


@lru_cache(8)
def _inertia(arm: ArmModel) -> ChainInertia:
    """Return the inertia of `arm`: thin rods, or points at REACH if only its moments are known, and the load."""
    length, bare = arm.length.tolist(), arm.with_payload(0.0)
    if arm.by_moments:
        mass, centre = [0.0] * JOINT_COUNT, np.maximum(arm.length * REACH, LEAST_REACH).tolist()
        for n in reversed(range(JOINT_COUNT)):
            mass[n] = max(0.0, bare.first_moment[n] - sum(mass[n + 1 :]) * length[n]) / centre[n]
    else:
        mass, centre = arm.mass.tolist(), arm.cog.tolist()
    places = [[along, 0.0, 0.0] for along in centre]
    for shared, links in zip(bare.off_axis, SHARED, strict=True):
        carried = sum(mass[n] for n, _ in links)
        for n, axis in links:
            places[n][axis] += shared / carried if carried else 0.0
    extent = [0.0] * JOINT_COUNT if arm.by_moments else length
    bodies = [Body.rod(*one) for one in zip(mass, places, extent, strict=True)]
    for n, body in enumerate(bodies):  # the moments hold where no masses at REACH can have them
        along = bare.first_moment[n] - sum(mass[n + 1 :]) * length[n]
        bodies[n] = body._replace(first=(along, *body.first[1:]))
    x, y, z = arm.payload.cog
    bodies[3] = bodies[3].joined_with(Body.rod(arm.payload.mass, (length[3] + x, y, z)))
    return ChainInertia(tuple(length), tuple(bodies), ROTORS)


def _payload_moments(length: np.ndarray, payload: Payload) -> np.ndarray:
    """Return what a load in the hand adds to M1..M4 and to W, Z, Y3, Y4, (2, 4) kg m."""
    mass, (x, y, z) = payload
    return mass * np.array(((*length[:3], length[3] + x), (0.0, z, 0.0, y)))


def moments_along(length: np.ndarray, cog: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Return the first moments M1..M4 (4,) in kg m: mass n times cog n, plus all mass beyond link n times length n."""
    beyond = np.append(np.cumsum(mass[::-1])[-2::-1], 0.0)
    return np.asarray(mass * cog + beyond * length)


def _exact(arm: ArmModel, turned: Values, direction: Values) -> tuple[Any, ...]:
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


def _paper_static(xp: ModuleType, arm: ArmModel, theta: Values) -> tuple[Any, ...]:
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


def _paper_mobile(xp: ModuleType, arm: ArmModel, theta: Values, beta: Any, phi: Any) -> tuple[Any, ...]:
    """EQ1m-EQ4m: EQ2-EQ5 at theta_2 + phi and theta_3 + beta, times cos(phi) cos(beta).

    Joints 2 to 4 have the additional factor cos(theta_1).
    """
    t1, t2, t3, t4 = theta
    tau1, tau2, tau3, tau4 = _paper_static(xp, arm, (t1, t2 + phi, t3 + beta, t4))
    upright = xp.cos(phi) * xp.cos(beta)
    axis = xp.cos(t1) * upright
    return tau1 * upright, tau2 * axis, tau3 * axis, tau4 * axis


def gravity_torque(arm: ArmModel, theta: ArrayLike, direction: ArrayLike = (0.0, 0.0, 1.0)) -> np.ndarray:
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


def paper_static_torque(arm: ArmModel, theta: ArrayLike) -> np.ndarray:
    """Return the torque of EQ2-EQ5 in Nm, in the shape of `theta`.

    theta: (4,) or (n, 4) rad. Here theta_1 is the angle between joint 1's axis and gravity (0 for an upright wearer),
    not joint 1's encoder angle. Raises ParameterError if the shape is wrong, a number is not finite, or the arm is
    given by its moments or has moments across its links.
    """
    arm.check_masses("paper_static")
    return _torque(_paper_static, arm, _poses(theta))


def paper_mobile_torque(arm: ArmModel, theta: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> np.ndarray:
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


def _torque(formula: Callable[..., tuple[Any, ...]], arm: ArmModel, *inputs: np.ndarray) -> np.ndarray:
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


def static_torque(arm: ArmModel, theta: Sequence[float], tilt: Tilt) -> Torque:
    """Return the torque of EQ2-EQ5 of one pose, as `ArmModel.torque`; joint 1's own angle is not used."""
    return _scaled(arm, tilt, _paper_static(math, arm, (tilt.axis_angle, *theta[1:])))


def mobile_torque(arm: ArmModel, theta: Sequence[float], tilt: Tilt) -> Torque:
    """Return the torque of EQ1m-EQ4m of one pose, as `ArmModel.torque`; joint 1's own angle is not used."""
    return _scaled(arm, tilt, _paper_mobile(math, arm, (tilt.axis_angle, *theta[1:]), tilt.beta, tilt.phi))


def _scaled(arm: ArmModel, tilt: Tilt, tau: Torque) -> Torque:
    a, b, c, d = arm.scale
    felt = tilt.magnitude
    return felt * a * tau[0], felt * b * tau[1], felt * c * tau[2], felt * d * tau[3]
