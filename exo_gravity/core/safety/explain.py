# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether the efforts can be used: gravity accounts for their torque, and they are new enough (`StaleEfforts`).

`MotionMonitor` is an independent eye on the compensator: it finds torque that gravity cannot account for, and the speed
that it can cause.

It shares no code and no masses with the compensator. Its own ground is `largest_moment`, M1..M4 in kg m: the largest
first moments of the arm, robot plus wearer, about joints 1 to 4, each along its link (M4 = m4 d4, M3 = m3 d3 + m4 l3,
and so on). Another arm has the same moments, and the directions of its axes and links while all angles are 0. Any load
from none to these, in the arm's pose and at the trunk's tilt, gives a range of torques for each joint, which
`largest_addition` widens both ways: what assistance, springs, friction and inertia terms or a calibration may add, and
what the joints' own springs and masses beside the links need. What is asked for outside that range, beyond a margin, is
unexplained.

Unexplained torque is summed over time, with both signs as positive, and forgotten over `memory`. The sum is an impulse:
it bounds the speed that the motors cause and gravity does not, whatever the wearer does meanwhile. A joint of a link
with moment M has an inertia of about M l, l = 0.3 m: so the impulse that is permitted, `patience` times the full load
g M, is a speed of about g patience / l = 0.4 rad/s.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from exo_gravity.core.arm.rotation import ZERO, Floats3, Quaternion, cross, dot, plus, product, rotated
from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.numbers import clamp
from exo_gravity.core.safety.command import Fault, FaultCode
from exo_gravity.core.safety.limits import EQUIPMENT, Limits

GRAVITY = 9.81  # m/s^2
# Axes and links of the paper's arm in its base frame while all angles are 0 (Table 1): x outwards, y forwards, z down.
PAPER = (
    ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0)),
)


@dataclass(frozen=True)
class MotionLimits:
    """How much torque gravity need not account for, and for how long."""

    surplus: float = 1.1  #: times the largest moments
    least: float = 0.1  #: Nm of margin
    share: float = 0.1  #: of the full load, in addition: 6 degrees of the trunk's tilt
    still: float = 0.01  #: rad by which pose or trunk may turn before the range is computed anew
    slow: float = 0.1  #: s, time constant; faster than this, torque changes only with the pose
    patience: float = 0.012  #: s of the full load
    memory: float = 1.0  #: s, time constant
    near: float = 0.97  #: cosine of 14 degrees: tilts as near as that count as one
    guided: float = 5.0  #: s for which the torque may still be on its way to a tilt before


@dataclass(frozen=True)
class StaleLimits:
    """For how long in s stale efforts are still applied."""

    longest_age: float = 0.18  #: of efforts; less than the gap after which the compensator ramps in from zero
    longest: float = 0.13  #: at a time
    recovery: float = 0.1  #: s of it that each s with sound efforts restores


MOTION, STALE = MotionLimits(), StaleLimits()


class MotionMonitor:
    """The unexplained impulse of each joint.

    limits.largest_moment: (n,) kg m; zeros switch the monitor off.
    impulse: (n,) Nm s. full: (n,) Nm, the largest load. trunk_tilt: rad from upright, as last told.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        load = [GRAVITY * moment for moment in limits.largest_moment]  # Nm
        self._is_on = any(load if limits.axes else load[1:])
        self.full = tuple(accumulate(load[::-1]))[::-1]
        self._axes, ways = (limits.axes, limits.ways) if limits.axes else PAPER
        self._moments = [plus(ZERO, way, torque) for way, torque in zip(ways, load, strict=False)]  # Nm
        self._until = -math.inf  # s, until when the torque may still be on its way from a tilt before
        self._passed: list[Floats3] = []  # gravity meanwhile: the torque lies between what these need
        upright = Tilt.of(SIDES[0])
        self._gravity, self.trunk_tilt = self._down(upright), upright.axis_angle
        self._pose: Sequence[float] = ()  # rad, for which the range was computed
        self.reset()

    def follow(self, now: float, tilt: Tilt, overtaken: Tilt | None) -> None:
        """Take the tilt of the trunk at `now` s; upright before the first one.

        overtaken: from which the torque is guided, if the trunk has turned (`TiltInput.overtaken`).
        """
        gravity, self.trunk_tilt = self._down(tilt), tilt.axis_angle
        if overtaken or not math.dist(gravity, self._gravity) <= MOTION.still:
            self._gravity, self._pose = gravity, ()
        self._passed = self._passed if now <= self._until else []
        if overtaken:
            self._passed = self._passed or [self._down(overtaken)]
            self._until = now + MOTION.guided
        if self._passed and all(dot(self._gravity, each) < MOTION.near for each in self._passed):
            self._passed.append(self._gravity)

    def reset(self) -> None:
        """Forget the past."""
        self.impulse = [0.0] * len(self.full)
        self._slow: list[float] = []  # the torque, low-passed, (n,) Nm

    def step(
        self, dt: float, joints: Sequence[JointSample], effort: Sequence[float], age: float = 0.0
    ) -> tuple[Sequence[float], Fault | None]:
        """Return what is explained of the `effort` (n,) Nm in the pose of `joints`, and a fault if too little is.

        age: s since the pose that the effort answers. An impossible effort is returned as it is.
        """
        asked = zip(effort, self._limits.max_command, strict=True)
        if not self._is_on or not all(abs(torque) <= most for torque, most in asked):
            return effort, None
        fastest = max([abs(joint.velocity) for joint in joints])
        pose = [joint.position for joint in joints]
        if not self._pose or not math.dist(pose, self._pose) <= MOTION.still:
            self._pose, self._explained = () if self._passed else pose, self.explained(pose)
        lowest, highest = self._explained
        self._slow = self._slow or list(effort)
        passed: list[float] = []
        fault: Fault | None = None
        for i, full in enumerate(self.full):
            most = self._limits.max_effort[i]
            torque = clamp(effort[i], most)
            share = MOTION.share + max(EQUIPMENT.late, age) * fastest  # a fresh torque may answer an old pose
            margin = MOTION.least + self._limits.largest_addition[i] + share * full
            low, high = lowest[i] - margin, highest[i] + margin
            within = max(low, min(high, torque))
            passed.append(within)
            change = torque - self._slow[i]
            self._slow[i] += min(1.0, dt / MOTION.slow) * change
            excess = max(abs(torque - within), abs(change) - margin - MOTION.slow * fastest * full)
            self.impulse[i] += dt * (max(0.0, excess) - self.impulse[i] / MOTION.memory)
            if not self.impulse[i] <= MOTION.patience * full and fault is None:
                reason = f"{torque:.2f} Nm asked for, gravity explains {low:.2f} to {high:.2f} Nm"
                if low <= torque <= high:
                    reason = f"{change:+.2f} Nm asked for in {MOTION.slow:g} s, in which the arm hardly moved"
                fault = Fault.of_joint(FaultCode.UNEXPLAINED_TORQUE, self._limits.joint_names[i], reason)
        return passed, fault

    def explained(self, theta: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
        """Return the least and the greatest torque (n,) in Nm that gravity needs at `theta` (n,) rad of any load.

        Potential -g sum(M_n u_n), u_n being how far down link n points; torques are its derivatives. The joints before
        it turn a joint's axis, and its own joint turns a link, too.
        """
        turn: Quaternion = (0.0, 0.0, 0.0, 1.0)
        axes, moments = list[Floats3](), list[Floats3]()
        for angle, axis, moment in zip(theta, self._axes, self._moments, strict=True):
            axes.append(rotated(turn, axis))
            half = math.sin(angle / 2.0)
            turn = product(turn, (half * axis[0], half * axis[1], half * axis[2], math.cos(angle / 2.0)))
            moments.append(rotated(turn, moment))
        downs = (self._gravity, *self._passed)
        lowest, highest = list[float](), list[float]()
        for n, axis in enumerate(axes):
            # -g . (axis x link) = (axis x g) . link
            levers = [cross(axis, down) for down in downs]
            torques = [[dot(lever, moment) for moment in moments[n:]] for lever in levers]
            lowest.append(MOTION.surplus * min([sum([min(0.0, torque) for torque in each]) for each in torques]))
            highest.append(MOTION.surplus * max([sum([max(0.0, torque) for torque in each]) for each in torques]))
        return lowest, highest

    def _down(self, tilt: Tilt) -> Floats3:
        """Return gravity's unit vector (3,) in the arm's base frame, for an arm with axes in its root link's axes."""
        return tilt.gravity_in_trunk if self._limits.axes else tilt.direction


class StaleEfforts:
    """For a moment the last efforts, and damping that rises, hold the arm as well as new efforts would.

    A compensator that is late on a busy computer, or whose tilt is late, needs no descent. While efforts are older than
    `timeout` (s), or computed from a late tilt, the motors apply the newest ones, and their damping rises as in a
    descent; once the efforts are sound again it falls. Efforts that are stale for too long, too old, or stale too often
    are a fault: ordinary computers are late for less than `STALE.recovery` of the time. Up to `STALE.longest_age` an
    arm that moves on at 1 rad/s makes the torque wrong by 18 % of gravity's largest.

    are_used: whether the efforts are stale and still used.
    count: how often stale ones were used.
    why: what was stale last.
    seen: s, when stale ones were last used.
    """

    def __init__(self, timeout: float) -> None:
        self.are_used = False
        self.count = 0
        self.why, self.seen = "", -math.inf
        self._timeout = timeout
        self._left = STALE.longest

    def step(self, now: float, dt: float, age: float, held: bool) -> Fault | None:
        """Take the age of the newest efforts; return a fault if they can no longer be used.

        now: s.
        dt: s that the loop ran since the last call.
        age: s, of the efforts.
        held: whether they are computed from a late tilt.
        """
        if age <= self._timeout and not held:
            self.are_used = False
            self._left = min(STALE.longest, self._left + STALE.recovery * dt)
            return None
        self._left = max(0.0, self._left - dt)
        self.why = f"efforts {1000.0 * age:.0f} ms old" + (", of a tilt that is late" if held else "")
        if self._left > 0.0 and age <= STALE.longest_age:
            self.count += not self.are_used
            self.are_used, self.seen = True, now
            return None
        self.are_used = False
        limit = f"{1000.0 * self._timeout:.0f} ms, or {1000.0 * STALE.longest:.0f} ms more for a moment"
        return Fault(FaultCode.COMMAND_STALE, f"{self.why}: must be less than {limit}")
