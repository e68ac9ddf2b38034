# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether two motors with exchanged CAN IDs turn each other's joint, as the pushes of the sign check show.

An exchange takes the encoder along with the motor: each joint still moves as it is pushed, and an arm that hangs asks
for hardly any torque. What differs is the inertia. Of two joints with parallel axes, the one nearer to the base turns
all that the other one turns, and the link between them, so under a push that rises at the same rate it gains speed
later. Friction only delays when a joint breaks loose: the time counts from then on, until the push is taken back.

The efforts that the controller asks for while joints are pushed tell which axes are parallel: the outer joint needs the
same torque whichever of the two is turned. So no parameter describes the arm, and where gravity turns neither joint,
nothing is compared. Of the paper's arm these are joints 3 and 4. Exchanges of joints whose axes are not
parallel are not looked for.

A wearer who holds the outer joint firmly makes it slow, too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from statistics import fmean
from typing import NamedTuple

import numpy as np

from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.drive import Fault, FaultCode


@dataclass(frozen=True)
class JointOrderTuning:
    """When joints are compared, and how often.

    The inner joint took at least 1.77 times as long as the outer one in 60 right arms, bare or with a wearer of 50 to
    110 kg who relaxes or holds it lightly (1 to 3 Nm/rad), and at most 0.51 times in 60 exchanged ones.
    """

    parallel: float = 0.25  #: of the outer joint's stiffness, by which turning the inner one may show another one
    left: float = 0.0015  #: rad from where it rested: the joint moves; four codes of the position
    sooner: float = 0.9  #: of the outer joint's time, below which the inner joint is the quicker one
    clear: float = 0.01  #: s more than that, a cycle at 100 Hz: the times of two light joints differ by less
    least: float = 0.05  #: Nm/rad of gravity's stiffness; a fifth of that of a bare forearm
    rounds: int = 2  #: of pushes: two joints that seem exchanged are pushed again, and the times averaged


JOINT_ORDER = JointOrderTuning()


class Extreme(NamedTuple):
    """Where a joint was farthest while it was pushed."""

    angle: float  #: rad
    pose: tuple[float, ...]  #: (n,) rad
    asked: tuple[float, ...]  #: (n,) Nm that the controller asked for there


class JointOrder:
    """Follows the pushes of the joints `names` (n,), from base to hand."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._joints: Sequence[JointSample] = ()  # the newest readings
        self._pushed: int | None = None
        self._path: list[JointSample] = []  # readings of the joint that is pushed
        self._times: list[list[float]] = [[] for _ in names]  # s, of each push
        self._ends: list[list[Extreme]] = [[] for _ in names]  # the two ends of each joint's motion while it was pushed

    def begin(self, i: int) -> None:
        """Note that joint `i` is pushed from now on."""
        self._pushed = i
        self._path = [self._joints[i]]

    def note(self, joints: Sequence[JointSample], asked: Sequence[float]) -> None:
        """Take the newest readings (n,), and what the controller asks for, (n,) Nm."""
        self._joints = joints
        if self._pushed is None:
            return
        sample, ends = joints[self._pushed], self._ends[self._pushed]
        self._path.append(sample)
        if not all(map(math.isfinite, asked)):
            return
        here = [*ends, Extreme(sample.position, tuple(joint.position for joint in joints), tuple(asked))]
        ends[:] = min(here), max(here)

    def end(self, slow: float) -> None:
        """Note that a push has moved its joint, and was taken back once that was faster than `slow` rad/s."""
        if self._pushed is None:
            return
        start = self._path[0].position
        left = _reached([(sample.time, sample.position - start) for sample in self._path], JOINT_ORDER.left)
        quick = _reached([(sample.time, sample.velocity) for sample in self._path], slow)
        self._times[self._pushed].append(max(0.0, quick - left))

    @property
    def exchanged(self) -> tuple[int, ...]:
        """An inner and an outer joint, from 0 on, of which the inner one is quicker; () if there is no such pair."""
        pushed = [i for i, (times, ends) in enumerate(zip(self._times, self._ends, strict=True)) if times and ends]
        stiffness = self._stiffness(pushed) if pushed else np.empty((0, 0))
        for inner, outer in combinations(pushed, 2):
            own, shared = stiffness[outer, outer], stiffness[outer, inner]
            are_parallel = own >= JOINT_ORDER.least and abs(shared - own) <= JOINT_ORDER.parallel * own
            latest = JOINT_ORDER.sooner * self._time(outer) - JOINT_ORDER.clear
            if are_parallel and self._time(inner) < latest:
                return inner, outer
        return ()

    @property
    def fault(self) -> Fault:
        """The fault of the two joints that are exchanged."""
        inner, outer = pair = self.exchanged
        times = [f"{1000.0 * self._time(i):.0f} ms" for i in pair]
        reason = (
            f"{self._names[inner]} moved sooner than {self._names[outer]}, which it carries: {' and '.join(times)} "
            "under the same push: let the arm hang freely and relaxed, or correct can_id of these two motors"
        )
        return Fault(FaultCode.JOINTS_EXCHANGED, reason)

    def _time(self, i: int) -> float:
        return fmean(self._times[i])

    def _stiffness(self, pushed: Sequence[int]) -> np.ndarray:
        """Return the torque (n, n) in Nm that each joint is asked for more for each rad of each other joint.

        A push moves others than its joint, too.
        """
        ends = [self._ends[i] for i in pushed]
        turned = [np.subtract(after.pose, before.pose) for before, after in ends]
        asked = [np.subtract(after.asked, before.asked) for before, after in ends]
        return np.asarray(np.linalg.lstsq(np.array(turned), np.array(asked), rcond=None)[0].T)


def _reached(course: Sequence[tuple[float, float]], level: float) -> float:
    """Return when `course`, times in s with a value each, first reached `level`; its last time if it never did."""
    for (earlier, before), (later, after) in pairwise(course):
        if after >= level:
            return earlier + (later - earlier) * max(0.0, level - before) / max(after - before, 1e-9)
    return course[-1][0]
