# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether two motors with exchanged CAN IDs turn each other's joint, as the pushes of the sign check show.

An exchange takes the encoder along with the motor: each joint still moves as it is pushed, and an arm that hangs asks
for hardly any torque. What differs is the inertia. Of two joints with parallel axes, the one nearer to the base turns
all that the other one turns, and the link between them, so under a push that rises at the same rate it is slower.
Friction only delays when a joint breaks loose: the time counts from then on.

Which joints have parallel axes, the efforts tell that the controller asks for while joints are pushed: the outer joint
needs the same torque whichever of the two is turned. So no parameter describes the arm, and where gravity turns
neither joint, nothing is compared. Of the paper's arm these are joints 3 and 4. Exchanges of joints whose axes are not
parallel are not looked for.

A wearer who holds the outer joint firmly makes it slow, too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from statistics import fmean

from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.drive import Fault, FaultCode


@dataclass(frozen=True)
class JointOrderTuning:
    """When joints are compared, and how often. The times of right arms differ by at least 1.5, the inner joint's more."""

    parallel: float = 0.5  #: of the outer joint's stiffness, that turning the inner one must show; 0.1 at a right angle
    least: float = 0.05  #: Nm/rad of gravity's stiffness; a fifth of that of a bare forearm
    rounds: int = 2  #: of pushes: two joints that seem exchanged are pushed again, and the times averaged


JOINT_ORDER = JointOrderTuning()


class JointOrder:
    """Follows the pushes of the joints `names` (n,), from base to hand."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._joints: Sequence[JointSample] = ()  # the newest readings
        self._pushed: int | None = None
        self._path: list[tuple[float, float]] = []  # time in s and angle in rad of the joint that is pushed
        self._times: list[list[float]] = [[] for _ in names]  # s, of each push
        #: of each joint's pushes: the angle in rad at either end, and what was asked for there, (n,) Nm
        self._ends: list[list[tuple[float, tuple[float, ...]]]] = [[] for _ in names]

    def begin(self, i: int) -> None:
        """Note that joint `i` is pushed from now on."""
        self._pushed = i
        self._path = [(self._joints[i].time, self._joints[i].position)]

    def note(self, joints: Sequence[JointSample], asked: Sequence[float]) -> None:
        """Take the newest readings (n,), and what the controller asks for, (n,) Nm."""
        self._joints = joints
        if self._pushed is None:
            return
        sample, ends = joints[self._pushed], self._ends[self._pushed]
        self._path.append((sample.time, sample.position))
        here = [*ends, (sample.position, tuple(asked))]
        ends[:] = min(here), max(here)

    def end(self, still: float, moved: float) -> None:
        """Note that a push has moved its joint by `moved` rad from rest, and that the joint had left it at `still`."""
        if self._pushed is not None:
            self._times[self._pushed].append(_reached(self._path, moved) - _reached(self._path, still))

    @property
    def exchanged(self) -> tuple[int, ...]:
        """Two joints of which the inner one is quicker, from 0 on; () if there are none."""
        pushed = [i for i, times in enumerate(self._times) if times]
        pairs = (pair for pair in combinations(pushed, 2) if self._are_parallel(*pair))
        return next((pair for pair in pairs if self._time(pair[0]) < self._time(pair[1])), ())

    @property
    def fault(self) -> Fault:
        """The fault of the two joints that are exchanged."""
        (inner, outer), times = self.exchanged, [f"{1000.0 * self._time(i):.0f} ms" for i in self.exchanged]
        reason = (
            f"{self._names[inner]} moved sooner than {self._names[outer]}, which it carries: {' and '.join(times)} "
            "under the same push: let the arm hang freely and relaxed, or correct can_id of these two motors"
        )
        return Fault(FaultCode.JOINTS_EXCHANGED, reason)

    def _time(self, i: int) -> float:
        return fmean(self._times[i])

    def _are_parallel(self, inner: int, outer: int) -> bool:
        stiffness = self._stiffness(outer, outer)
        is_parallel = self._stiffness(outer, inner) >= JOINT_ORDER.parallel * stiffness
        return stiffness >= JOINT_ORDER.least and is_parallel

    def _stiffness(self, of: int, turned: int) -> float:
        """Return the torque in Nm that joint `of` needs more for each rad of the joint `turned`."""
        (low, before), (high, after) = self._ends[turned]
        return (after[of] - before[of]) / (high - low) if high > low else 0.0


def _reached(path: Sequence[tuple[float, float]], way: float) -> float:
    """Return the time in s at which `path` was `way` rad from its start, between two readings; NaN if it never was."""
    start = path[0][1]
    for (earlier, before), (later, after) in pairwise(path):
        if after - start >= way:
            return earlier + (later - earlier) * (way - before + start) / (after - before)
    return math.nan
