"""Damping, spring, coupling and soft limits: terms that depend on where the joints are, and how fast they move.

The torque reaches the joint late: the motor's reply, the computation, the bus. DELAY is what every term must bear
without harm; the tests vary it from 0 to 10 ms. A stiffness or viscosity that the arm cannot bear is refused.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.params import check_owned, owned, params_of

DELAY = 0.015  # s from a reading to its torque: 10 ms, and half of a 10 ms cycle in which the torque is held
LATE = 2.0 * DELAY  # s: a spring of k Nm/rad needs the damping LATE k, in Nm s/rad, to be passive despite the delay
SPRING_EFFORT = (1.0, 2.0, 1.0, 1.0)  # Nm that a spring may give: a hand overcomes it
COUPLING_EFFORT = 1.0  # Nm on the joint that follows
EDGE_STIFFNESS = (10.0,) * JOINT_COUNT  # Nm/rad: the whole torque 0.1 and 0.2 rad beyond the edge
EDGE = 0.05  # rad beyond the edge over which the damping rises, so that it does not set in with a jolt
FREE = 3.15  # rad: no edge
MAX_PATH_SPEED = 2.0  # rad/s between two poses of a path


class TermState(NamedTuple):
    """The arm as the terms see it."""

    dt: float  #: s since the last state, 0 for the first
    position: Sequence[float]  #: (4,) rad
    velocity: Sequence[float]  #: (4,) rad/s
    acceleration: Sequence[float]  #: (4,) rad/s^2, low-passed
    elapsed: float  #: s since the spring's settings


@dataclass(frozen=True)
class TermParameters:
    """The parameters of one term, checked; the first one switches it on. `torque` returns the (4,) Nm that it adds."""

    #: whether the parameters ask for any torque; by default they do not
    on: bool = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_owned(self)
        first = params_of(type(self))[0]
        off = tuple(first.default) if isinstance(first.default, list) else first.default
        object.__setattr__(self, "on", getattr(self, first.name) != off)


@dataclass(frozen=True)
class Damping(TermParameters):
    """Virtual viscosity, as a therapist sets it for resistance; it takes energy, except for what comes late."""

    viscosity: Sequence[float] = owned((0.0,) * 4, "virtual viscous friction; 0: off", (0.0, 5.0), "Nm s/rad")

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm, against the motion."""
        b, v = self.viscosity, state.velocity
        return -b[0] * v[0], -b[1] * v[1], -b[2] * v[2], -b[3] * v[3]


@dataclass(frozen=True)
class Spring(TermParameters):
    """Pulls the joints towards a pose, or along a recorded path, with a limited torque.

    Towards a pose it returns what energy it took, less its damping. A path moves the pose, and gives at most the
    limited torque times the way along the path. Raises ParameterError.
    """

    stiffness: Sequence[float] = owned((0.0,) * 4, "virtual spring towards the pose; 0: off", (0.0, 50.0), "Nm/rad")
    pose: Sequence[float] = owned(
        (0.0, 0.3, 0.3, 0.5),
        "pose that it pulls towards, or a path: rows of s and 4 angles",
        unit="rad",
        any_length=True,
    )
    max_effort: Sequence[float] = SPRING_EFFORT  #: largest torque, (4,) Nm
    times: tuple[float, ...] = field(init=False, repr=False, compare=False)  #: (n,) s of the path's rows, from 0 on
    ways: np.ndarray = field(init=False, repr=False, compare=False)  #: (4, n) rad, each joint's angles

    def __post_init__(self) -> None:
        super().__post_init__()
        numbers = tuple(self.pose)
        path = (0.0, *numbers) if len(numbers) == JOINT_COUNT else numbers
        rows = np.reshape(path, (-1, 1 + JOINT_COUNT)) if len(path) % (1 + JOINT_COUNT) == 0 else np.empty((0, 1))
        times, poses = rows[:, 0], rows[:, 1:]
        if not (len(rows) and np.all(np.abs(poses) <= FREE)):
            raise ParameterError("spring.pose", list(numbers), f"4 angles within {FREE:g} rad, or a path of rows")
        if times[0] != 0.0 or not (np.all(np.diff(times) > 0.0) and times[-1] < math.inf):
            raise ParameterError("times of the path in spring.pose", times[:3].tolist(), "rising from 0 s")
        speed = max((np.linalg.norm(np.diff(poses, axis=0), axis=1) / np.diff(times)).tolist(), default=0.0)
        if speed > MAX_PATH_SPEED:
            raise ParameterError("speed of the path in spring.pose", speed, f"at most {MAX_PATH_SPEED:g} rad/s")
        for name, value in (("pose", numbers), ("times", tuple(times.tolist())), ("ways", poses.T)):
            object.__setattr__(self, name, value)

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm."""
        pose = self.pose
        if len(pose) != JOINT_COUNT:
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
        (0.0,) * 4,
        "torque per angle of each joint on the joint with the largest entry, which follows: "
        "[0, -1, 2, 0] pulls flexion to half of abduction; zeros: off",
        (-50.0, 50.0),
        "Nm/rad",
    )
    max_effort: float = COUPLING_EFFORT  #: largest torque on the follower, Nm

    def __post_init__(self) -> None:
        super().__post_init__()
        if sum(map(bool, self.stiffness)) == 1:
            raise ParameterError("coupling.stiffness", list(self.stiffness), "of two joints or more, or zeros")

    @property
    def largest(self) -> float:
        """Stiffness on the follower, Nm/rad."""
        return max(map(abs, self.stiffness))

    def stable(self, least_inertia: Sequence[float]) -> float:
        """Return the largest stiffness on the follower, Nm/rad, that is stable on these inertias (4,) kg m^2."""
        pairs = zip(self.stiffness, least_inertia, strict=True)
        return 1.0 / sum((k / self.largest) ** 2 / inertia for k, inertia in pairs) / (4.0 * DELAY**2)

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm on the follower and on the joints that it follows."""
        k, q, v, largest = self.stiffness, state.position, state.velocity, self.largest
        stretch = k[0] * q[0] + k[1] * q[1] + k[2] * q[2] + k[3] * q[3]
        damping = LATE * (k[0] * v[0] + k[1] * v[1] + k[2] * v[2] + k[3] * v[3])
        pull = (clamp(-stretch, self.max_effort) - damping) / largest
        return k[0] * pull, k[1] * pull, k[2] * pull, k[3] * pull


@dataclass(frozen=True)
class SoftLimits(TermParameters):
    """Springs at the edge of a workspace that a therapist chooses, within the joint limits of `can_bridge`.

    Raises ParameterError.
    """

    range: Sequence[float] = owned(
        (-FREE, FREE) * 4, f"lower and upper edge of each joint's workspace; {FREE:g}: none", (-FREE, FREE), "rad"
    )
    stiffness: Sequence[float] = EDGE_STIFFNESS  #: of the springs beyond the edges, (4,) Nm/rad
    max_effort: Sequence[float] = SPRING_EFFORT  #: largest torque of the springs, (4,) Nm

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(low < high for low, high in zip(self.range[0::2], self.range[1::2], strict=True)):
            raise ParameterError("limits.range", list(self.range), "lower and upper edge of each joint, rising")

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm: none inside, back towards the workspace outside."""
        torque = []
        edges = self.range[0::2], self.range[1::2]
        columns = zip(self.stiffness, *edges, state.position, state.velocity, self.max_effort, strict=True)
        for k, low, high, q, v, most in columns:
            depth = max(q - high, 0.0) + min(q - low, 0.0)
            damping = LATE * k * min(1.0, abs(depth) / EDGE)
            torque.append(clamp(-k * depth, most) - damping * v)
        return tuple(torque)


def clamp(value: float, limit: float) -> float:
    """Return `value` limited to -limit..limit."""
    return max(-limit, min(limit, value))
