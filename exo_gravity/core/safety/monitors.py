# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Monitors of the safety machine that read no single motor: whether the arm is at rest, and how old the efforts are."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.motors.joint_motor import UNKNOWN, JointSample
from exo_gravity.core.safety.drive import Fault, FaultCode


@dataclass(frozen=True)
class Rest:
    """What a joint at rest is."""

    turn: float = 0.005  #: rad that it may turn meanwhile
    time: float = 0.5  #: s without such a turn, after which the arm counts as at rest


@dataclass(frozen=True)
class Ride:
    """For how long in s late efforts are still applied."""

    longest_age: float = 0.18  #: of efforts; less than the gap after which the compensator ramps in from zero
    longest: float = 0.13  #: at a time
    recovery: float = 0.1  #: of riding that each s with sound efforts makes good


REST, RIDE = Rest(), Ride()


class RestTracker:
    """Whether an arm of `count` joints is at rest, judged by position: a damped arm can creep at less than one code.

    since: s, the time since which no replying joint has turned by more than `REST.turn`.
    """

    def __init__(self, count: int) -> None:
        self.since = -math.inf
        self._reference: Sequence[JointSample] = (UNKNOWN,) * count

    def step(self, now: float, joints: Sequence[JointSample], silent: Sequence[bool]) -> None:
        """Take the newest readings at `now` s.

        silent: (n,) whether the joint's motor does not reply.
        """
        columns = zip(joints, self._reference, silent, strict=True)
        if any(
            not is_silent and not abs(joint.position - last.position) <= REST.turn for joint, last, is_silent in columns
        ):
            self.since, self._reference = now, joints
        if any(silent):  # a silent joint may have moved by the time it replies again
            known = zip(self._reference, silent, strict=True)
            self._reference = [UNKNOWN if is_silent else last for last, is_silent in known]


class RideThrough:
    """For a moment the last efforts, and damping that rises, hold the arm as well as new efforts would.

    A compensator that is late on a busy computer, or whose tilt is late, needs no descent. While efforts are older than
    `timeout` (s), or computed from a late tilt, the motors apply the newest ones, and their damping rises as in a
    descent; once the efforts are sound again it falls. The ride ends in a fault once it is too long, efforts are too
    old, or they have been late too often: ordinary computers are late for less than `RIDE.recovery` of the time. Up to
    `RIDE.longest_age` an arm that moves on at 1 rad/s makes the torque wrong by 18 % of gravity's largest.

    is_riding: whether efforts are late and still used.
    rides: how often that began.
    why: of the last ride.
    ended: s, when it was last going on.
    """

    def __init__(self, timeout: float) -> None:
        self.is_riding = False
        self.rides = 0
        self.why, self.ended = "", -math.inf
        self._timeout = timeout
        self._left = RIDE.longest

    def step(self, now: float, dt: float, age: float, held: bool) -> Fault | None:
        """Take the age of the newest efforts; return a fault if they can no longer be used.

        now: s.
        dt: s that the loop ran since the last call.
        age: s, of the efforts.
        held: whether they are computed from a late tilt.
        """
        if age <= self._timeout and not held:
            self.is_riding = False
            self._left = min(RIDE.longest, self._left + RIDE.recovery * dt)
            return None
        self.rides += not self.is_riding
        self.is_riding, self.ended = True, now
        self._left = max(0.0, self._left - dt)
        self.why = f"efforts {1000.0 * age:.0f} ms old" + (", of a tilt that is late" if held else "")
        if self._left > 0.0 and age <= RIDE.longest_age:
            return None
        self.is_riding = False
        limit = f"{1000.0 * self._timeout:.0f} ms, or {1000.0 * RIDE.longest:.0f} ms more for a moment"
        return Fault(FaultCode.COMMAND_STALE, f"{self.why}: must be less than {limit}")
