# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Each term that ships: what it adds to gravity compensation, and why it cannot harm.

The torque reaches the joint late: the motor's reply, the computation, the bus. DELAY is what every term must bear
without harm; the tests vary it from 0 to 10 ms. A stiffness or viscosity that the arm cannot bear is refused.

Friction: the term gives at most `share` (below 1) of the friction that takes energy from the same motion. So joint and
term together always take energy, however late the term acts, and at rest, where it is 0, friction holds the arm as
before. This is true as long as the friction that was identified is not above the joint's real friction. Motors report
speed in codes of 0.022 rad/s (AK60-6) and 0.024 rad/s (AK80-9); standstill reads as half a code.

Inertia: acceleration that is measured late gives more energy than it takes back. Two bounds keep that harmless:
- The share is below 1 and the low-pass never amplifies, so on a free arm the loop has a gain below 1 (small gain
  theorem) and cannot oscillate, however late it acts. On an elastic arm, such as a wearer's, it can: the tank ends it.
- An energy tank: the term gives no more than it took, plus the tank's size, plus a share of what the joints' own
  friction takes (`friction.coulomb`). What `friction.share` gave back is not spent twice. If the tank is empty, the
  term fades. On simulated arms with torques 10 ms late the excess was 0.76 J at most, with a tank of 0.5 J.
At standstill there is no torque: 12-bit velocities alternate between two codes, and the acceleration that this feigns
moved the shoulder's rotation against its friction, by up to 1 degree a minute.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.interface import Links
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import JOINT_COUNT, Torque, clamp, for_joints
from exo_gravity.core.params import check_owned, owned, params_of

DELAY = 0.015  # s from a reading to its torque: 10 ms, and half of a 10 ms cycle in which the torque is held
LATE = 2.0 * DELAY  # s: a spring of k Nm/rad needs the damping LATE k, in Nm s/rad, to be passive despite the delay
FREE = 3.15  # rad: no edge of the workspace

# Bounds of the parameters
MAX_COULOMB, MAX_VISCOUS = 3.0, 1.0  # Nm, Nm s/rad
MAX_LOAD_FRICTION = 0.3  # planetary gears lose 0.03 to 0.15
MAX_FRICTION_SHARE = 0.85  # leaves a friction that is 15 % smaller than identified
MAX_INERTIA_SHARE = 0.8  # leaves a fifth for masses that are not known exactly


@dataclass(frozen=True)
class SpringTuning:
    """What the springs of `spring`, `coupling` and `limits` give at most; another arm's joints all get the least."""

    effort: Sequence[float] = (1.0, 2.0, 1.0, 1.0)  #: Nm that a spring may give: a hand overcomes it
    coupling_effort: float = 1.0  #: Nm on the joint that follows
    edge_stiffness: Sequence[float] = (10.0,) * JOINT_COUNT  #: Nm/rad: the whole torque 0.1 and 0.2 rad beyond the edge
    edge: float = 0.05  #: rad beyond the edge over which the damping rises, so that it does not set in with a jolt
    path_speed: float = 2.0  #: rad/s, the fastest between two poses of a path


@dataclass(frozen=True)
class FrictionTuning:
    """Where a joint shows its friction."""

    standstill: float = 0.03  #: rad/s, below which a joint is considered to stand: more than one 12-bit velocity code
    sliding: float = 0.12  #: rad/s, from which on friction is given its full share
    fastest: float = 3.0  #: rad/s, beyond which viscous friction no longer grows


@dataclass(frozen=True)
class InertiaTuning:
    """Where the inertia acts, and what bounds its energy."""

    tank: float = 0.5  #: J, the kinetic energy of the robot and an arm of 3.7 kg at 1.3 rad/s of abduction
    fading: float = 0.2  #: of the tank, below which the term fades
    moving: float = 0.06  #: rad/s of the fastest joint: inertia sets in from standstill to here
    fast: float = 4.0  #: rad/s of any joint, from which on it fades
    too_fast: float = 5.0  #: rad/s, at which it is gone: `can_bridge` trips a fault there
    #: rad/s of the acceleration's low-passes. One code of 12-bit velocity, 0.022 rad/s, moves the acceleration by
    #: 0.022 bandwidth / e = 0.65 rad/s^2 at most: 0.06 Nm on 0.1 kg m^2. It lags by 2 / bandwidth = 25 ms.
    bandwidth: float = 80.0


SPRING, FRICTION, INERTIA = SpringTuning(), FrictionTuning(), InertiaTuning()


class TermState(NamedTuple):
    """The arm as the terms see it."""

    dt: float  #: s since the last state, 0 for the first
    position: Sequence[float]  #: (n,) rad
    velocity: Sequence[float]  #: (n,) rad/s
    acceleration: Sequence[float]  #: (n,) rad/s^2, low-passed
    elapsed: float  #: s since the spring's settings


@dataclass(frozen=True)
class TermParameters:
    """The parameters of one term, checked; the first one switches it on. `torque` returns the (n,) Nm that it adds."""

    #: whether the parameters ask for any torque; by default they do not
    on: bool = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_owned(self)
        first = params_of(type(self))[0]
        value = getattr(self, first.name)
        off = tuple(first.for_joints(len(value)).default) if isinstance(value, tuple) else first.default
        object.__setattr__(self, "on", value != off)


@dataclass(frozen=True)
class Damping(TermParameters):
    """Virtual viscosity, as a therapist sets it for resistance; it takes energy, except for what comes late."""

    viscosity: Sequence[float] = owned((0.0,) * JOINT_COUNT, "virtual viscous friction; 0: off", (0.0, 5.0), "Nm s/rad")

    def torque(self, state: TermState) -> Torque:
        """Return the torque (n,) in Nm, against the motion."""
        return tuple([-b * v for b, v in zip(self.viscosity, state.velocity, strict=True)])


@dataclass(frozen=True)
class Spring(TermParameters):
    """Pulls the joints towards a pose, or along a recorded path, with a limited torque.

    Towards a pose it returns what energy it took, less its damping. A path moves the pose, and gives at most the
    limited torque times the way along the path. Raises ParameterError.
    """

    stiffness: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT, "virtual spring towards the pose; 0: off", (0.0, 50.0), "Nm/rad"
    )
    pose: Sequence[float] = owned(
        (0.0, 0.3, 0.3, 0.5),
        "pose that it pulls towards, or a path: rows of s and an angle of each joint",
        unit="rad",
        any_length=True,
    )
    max_effort: Sequence[float] = SPRING.effort  #: largest torque, (n,) Nm
    times: np.ndarray = field(init=False, repr=False, compare=False)  #: (m,) s of the path's rows, from 0 on
    ways: np.ndarray = field(init=False, repr=False, compare=False)  #: (n, m) rad, each joint's angles

    def __post_init__(self) -> None:
        super().__post_init__()
        numbers, count = tuple(self.pose), len(self.stiffness)
        object.__setattr__(self, "max_effort", for_joints(self.max_effort, count))
        path = (0.0, *numbers) if len(numbers) == count else numbers
        rows = np.reshape(path, (-1, 1 + count)) if len(path) % (1 + count) == 0 else np.empty((0, 1))
        times, *_ = columns = rows.T.copy()  # in one piece, or `np.interp` would copy them in each cycle
        if not (len(rows) and np.all(np.abs(columns[1:]) <= FREE)):
            raise ParameterError("spring.pose", list(numbers), f"{count} angles within {FREE:g} rad, or a path of rows")
        if times[0] != 0.0 or not (np.all(np.diff(times) > 0.0) and times[-1] < math.inf):
            raise ParameterError("times of the path in spring.pose", times[:3].tolist(), "rising from 0 s")
        speed = max((np.linalg.norm(np.diff(columns[1:]), axis=0) / np.diff(times)).tolist(), default=0.0)
        if speed > SPRING.path_speed:
            raise ParameterError("speed of the path in spring.pose", speed, f"at most {SPRING.path_speed:g} rad/s")
        for name, value in (("pose", numbers), ("times", times), ("ways", columns[1:])):
            object.__setattr__(self, name, value)

    def torque(self, state: TermState) -> Torque:
        """Return the torque (n,) in Nm."""
        pose = self.pose
        if len(pose) != len(self.stiffness):
            pose = [float(np.interp(state.elapsed, self.times, way)) for way in self.ways]
        columns = zip(self.stiffness, pose, state.position, state.velocity, self.max_effort, strict=True)
        return tuple([clamp(k * (to - q), most) - LATE * k * v for k, to, q, v, most in columns])


@dataclass(frozen=True)
class Coupling(TermParameters):
    """One joint follows others by a ratio, as in the shoulder rhythm of the exoskeleton HARMONY.

    A spring between them, of which all feel their part: torque on the follower alone could be turned into energy by
    moving the joints in a circle. Raises ParameterError.
    """

    stiffness: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT,
        "torque per angle of each joint on the joint with the largest entry, which follows: "
        "[0, -1, 2, 0] pulls flexion to half of abduction; zeros: off",
        (-50.0, 50.0),
        "Nm/rad",
    )
    max_effort: float = SPRING.coupling_effort  #: largest torque on the follower, Nm

    def __post_init__(self) -> None:
        super().__post_init__()
        if sum(map(bool, self.stiffness)) == 1:
            raise ParameterError("coupling.stiffness", list(self.stiffness), "of two joints or more, or zeros")

    @property
    def largest(self) -> float:
        """Stiffness on the follower, Nm/rad."""
        return max(map(abs, self.stiffness))

    def stable(self, least_inertia: Sequence[float]) -> float:
        """Return the largest stiffness on the follower, Nm/rad, that is stable on these inertias (n,) kg m^2."""
        pairs = zip(self.stiffness, least_inertia, strict=True)
        return 1.0 / sum((k / self.largest) ** 2 / inertia for k, inertia in pairs) / (4.0 * DELAY**2)

    def torque(self, state: TermState) -> Torque:
        """Return the torque (n,) in Nm on the follower and on the joints that it follows."""
        k, q, v, largest = self.stiffness, state.position, state.velocity, self.largest
        pull = (clamp(-_dot(k, q), self.max_effort) - LATE * _dot(k, v)) / largest
        return tuple([each * pull for each in k])


@dataclass(frozen=True)
class SoftLimits(TermParameters):
    """Springs at the edge of a workspace that a therapist chooses, within the joint limits of `can_bridge`.

    Raises ParameterError.
    """

    lower: Sequence[float] = owned(
        (-FREE,) * JOINT_COUNT, f"lower edge of each joint's workspace; {-FREE:g}: none", (-FREE, FREE), "rad"
    )
    upper: Sequence[float] = owned(
        (FREE,) * JOINT_COUNT, f"upper edge of each joint's workspace; {FREE:g}: none", (-FREE, FREE), "rad"
    )
    stiffness: Sequence[float] = SPRING.edge_stiffness  #: of the springs beyond the edges, (n,) Nm/rad
    max_effort: Sequence[float] = SPRING.effort  #: largest torque of the springs, (n,) Nm

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(low < high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ParameterError("limits.lower", list(self.lower), f"below limits.upper = {list(self.upper)}")
        object.__setattr__(self, "on", max(self.lower) > -FREE or min(self.upper) < FREE)
        for name in ("stiffness", "max_effort"):
            object.__setattr__(self, name, for_joints(getattr(self, name), len(self.lower)))

    def torque(self, state: TermState) -> Torque:
        """Return the torque (n,) in Nm: none inside, back towards the workspace outside."""
        torque = []
        edges = self.lower, self.upper
        columns = zip(self.stiffness, *edges, state.position, state.velocity, self.max_effort, strict=True)
        for k, low, high, q, v, most in columns:
            depth = (high < FREE) * max(q - high, 0.0) + (low > -FREE) * min(q - low, 0.0)
            damping = LATE * k * min(1.0, abs(depth) / SPRING.edge)
            torque.append(clamp(-k * depth, most) - damping * v)
        return tuple(torque)


@dataclass(frozen=True)
class Friction(TermParameters):
    """The term `friction`. Raises ParameterError."""

    share: float = owned(
        0.0, "share of the joints' friction that the motors take over; 0: off", (0.0, MAX_FRICTION_SHARE)
    )
    coulomb: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT, "Coulomb friction of each joint, by `calibrate friction`", (0.0, MAX_COULOMB), "Nm"
    )
    viscous: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT, "viscous friction of each joint, by `calibrate friction`", (0.0, MAX_VISCOUS), "Nm s/rad"
    )
    #: The term leaves it to the joint, which it so overcompensates less.
    load: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT,
        "share of a gear's torque that is friction, by `calibrate friction`, for `wearer`",
        (0.0, MAX_LOAD_FRICTION),
    )

    def torque(self, state: TermState) -> Torque:
        """Return the torque (n,) in Nm, along the motion."""
        torque = []
        for v, coulomb, viscous in zip(state.velocity, self.coulomb, self.viscous, strict=True):
            whole = self.share * (coulomb + viscous * min(abs(v), FRICTION.fastest))
            torque.append(math.copysign(sliding(v) * whole, v))
        return tuple(torque)


def sliding(speed: float) -> float:
    """Return the share of its friction that a joint at `speed` rad/s shows: 0 where it stands, 1 where it slides."""
    return max(0.0, min(1.0, (abs(speed) - FRICTION.standstill) / (FRICTION.sliding - FRICTION.standstill)))


class EnergyTank:
    """The energy in J that a term may give away; what it takes fills the tank again, up to its size.

    The torque may act at once or DELAY later; whichever gives more energy is counted.
    """

    def __init__(self) -> None:
        self.level = INERTIA.tank
        self._given: deque[tuple[float, Torque]] = deque()  # time in s and torque; the first one acts now at the latest
        self._time = 0.0

    def pass_on(self, torque: Torque, velocity: Sequence[float], dt: float, income: float) -> Torque:
        """Return `torque` (n,) in Nm, reduced when the tank is nearly empty and the torque would give energy.

        velocity: (n,) rad/s. income: W that flows into the tank, from the joints' friction.
        """
        power = _dot(torque, velocity)
        if power > 0.0 and self.level < INERTIA.fading * INERTIA.tank:
            share = max(0.0, self.level) / (INERTIA.fading * INERTIA.tank)
            torque, power = tuple([share * tau for tau in torque]), share * power
        self._time += dt
        given = self._given
        given.append((self._time, torque))
        while given[0][0] < self._time - DELAY:
            given.popleft()
        self.level = min(INERTIA.tank, self.level + (income - max(power, _dot(given[0][1], velocity))) * dt)
        return torque


@dataclass(frozen=True)
class Inertia(TermParameters):
    """The term `inertia`. Raises ParameterError."""

    share: float = owned(0.0, "share of the arm's inertia that the motors take over; 0: off", (0.0, MAX_INERTIA_SHARE))

    def torque(self, links: Links, friction: Sequence[float], tank: EnergyTank, state: TermState) -> Torque:
        """Return the torque (n,) in Nm: a share of what accelerates `links` as they are accelerated now.

        friction: (n,) Nm of Coulomb friction that is left to fill the `tank`.
        """
        velocity = state.velocity
        fastest = max(map(abs, velocity))
        slow, fast = FRICTION.standstill, INERTIA.too_fast
        rising, falling = (fastest - slow) / (INERTIA.moving - slow), (fast - fastest) / (fast - INERTIA.fast)
        share = self.share * max(0.0, min(1.0, rising, falling))
        whole = links.torque(state.position, velocity, state.acceleration)
        income = _dot(friction, map(abs, velocity))
        return tank.pass_on(tuple([share * tau for tau in whole]), velocity, state.dt, income)


def _dot(a: Iterable[float], b: Iterable[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


class AccelerationFilter:
    """The joints' acceleration from the motors' velocity: its derivative behind two low-passes."""

    def __init__(self) -> None:
        self._once: list[float] = []  # velocity behind one low-pass
        self._twice: list[float] = []  # and behind two

    def update(self, velocity: Sequence[float], dt: float) -> Sequence[float]:
        """Return the acceleration (n,) in rad/s^2 for the `velocity` (n,) in rad/s, `dt` s after the last call.

        dt: 0 starts anew, with the acceleration 0. Its gain is below 1 at any frequency and any dt.
        """
        if dt <= 0.0 or not self._once:
            self._once, self._twice = list(velocity), list(velocity)
            return [0.0] * len(velocity)
        share = dt * INERTIA.bandwidth / (1.0 + dt * INERTIA.bandwidth)
        once = [a + share * (v - a) for v, a in zip(velocity, self._once, strict=True)]
        rate = share / dt
        acceleration = [rate * (a - b) for a, b in zip(once, self._twice, strict=True)]
        self._twice = [b + dt * a for b, a in zip(self._twice, acceleration, strict=True)]
        self._once = once
        return acceleration
