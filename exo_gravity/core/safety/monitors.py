"""What the safety machine watches: the motors' readings, the arm's rest, the age of the efforts.

Chosen against ordinary equipment: 3 % of the frames lost each way, a computer that is late by 20 ms in one cycle of
ten, adapters that deliver in batches of 1 ms, and a motor that reports one wrong reading now and then.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.motors.joint_motor import UNKNOWN, JointSample
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.drive import Fault, FaultCode
from exo_gravity.core.safety.limits import READING, Limits


@dataclass(frozen=True)
class TurnCount:
    """For how long in s a motor may be silent until its turn count is no longer trusted.

    Until then it is, if the angle is within `home_tolerance` of the one before: a lost turn is twice as large, less
    what the joint has moved.
    """

    on: float = 0.1  #: while the motors hold the arm: a forearm whose motor has lost its power falls by 0.3 rad
    off: float = 0.3  #: while they are off: an arm that is down, only a person moves


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


TURN_COUNT, REST, RIDE = TurnCount(), Rest(), Ride()


class Readings:
    """Follows the readings of an arm's motors, cycle by cycle.

    joints: (4,) the newest ones. One that shows a fault is left out until the next one shows a fault too.
    silent: (4,) whether a motor is silent: no reply for `reply_timeout`, nor in `missed` cycles. A loop that stood
        still has not asked.
    fault: what the newest readings show, or None.
    lost: whether a motor may have lost its power in this cycle, and with it the turn count of its encoder.
    """

    def __init__(self, limits: Limits) -> None:
        self.joints: tuple[JointSample, ...] = (UNKNOWN,) * JOINT_COUNT
        self.silent: Sequence[bool] = (True,) * JOINT_COUNT
        self.fault: Fault | None = None
        self.lost = True
        self._limits = limits
        self._newest = [-math.inf] * JOINT_COUNT  # s
        self._missed = [READING.missed] * JOINT_COUNT
        self._asked = [-math.inf] * JOINT_COUNT  # s; each of `joints` was taken later
        self._is_suspect = [False] * JOINT_COUNT
        self._now = -math.inf  # s, of the last cycle

    def step(self, now: float, joints: Sequence[JointSample], powered: bool = True) -> None:
        """Take the newest readings of a cycle.

        now: s.
        joints: (4,) the newest readings.
        powered: whether the motors are on.
        """
        limits = self._limits
        longest = TURN_COUNT.on if powered else TURN_COUNT.off
        counting = list(self.joints)
        self.fault, self.lost = None, False
        for i, joint in enumerate(joints):
            if joint.time > self._newest[i]:
                gap = joint.time - self._newest[i]
                moved = abs(joint.position - self.joints[i].position)
                self.lost |= gap > limits.reply_timeout and moved > limits.home_tolerance[i]
                self._newest[i], self._missed[i] = joint.time, 0
                fault = limits.find_fault(i, joint, self.joints[i], self._asked[i])
                is_confirmed, self._is_suspect[i] = self._is_suspect[i], fault is not None
                if is_confirmed or not fault or self.joints[i] is UNKNOWN:
                    counting[i], self._asked[i] = joint, self._now
                    self.fault = self.fault or (fault if is_confirmed else None)
            else:
                self._missed[i] += 1
                self.lost |= self._missed[i] >= READING.missed and now - joint.time > longest
        self.joints = tuple(counting)
        asked = zip(joints, self._missed, strict=True)
        self.silent = [missed >= READING.missed and limits.is_silent(now, joint) for joint, missed in asked]
        if any(self.silent):
            name, buses = limits.joint_names[self.silent.index(True)], set(limits.channels)
            columns = zip(limits.channels, self._missed, strict=True)
            replying = {bus for bus, missed in columns if missed < READING.missed}
            reason = f"{name}: no reply for more than {limits.reply_timeout * 1000:.0f} ms"
            if len(buses) > 1 and (dead := buses - replying):
                reason += f"; no motor on {' and '.join(sorted(dead))} replies: the bus is lost, or the supply is cut"
            self.fault = Fault(FaultCode.MOTOR_SILENT, reason)
        self._now = now


class RestTracker:
    """Whether an arm is at rest, judged by position: a damped arm can creep at less than one code of the velocity.

    since: s, the time since which no replying joint has turned by more than `REST.turn`.
    """

    def __init__(self) -> None:
        self.since = -math.inf
        self._reference: Sequence[JointSample] = (UNKNOWN,) * JOINT_COUNT

    def step(self, now: float, joints: Sequence[JointSample], silent: Sequence[bool]) -> None:
        """Take the newest readings at `now` s.

        silent: (4,) whether the joint's motor does not reply.
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
        self._left -= dt
        self.why = f"efforts {1000.0 * age:.0f} ms old" + (", of a tilt that is late" if held else "")
        if self._left >= 0.0 and age <= RIDE.longest_age:
            return None
        self.is_riding = False
        limit = f"{1000.0 * self._timeout:.0f} ms, or {1000.0 * RIDE.longest:.0f} ms more for a moment"
        return Fault(FaultCode.COMMAND_STALE, f"{self.why}: must be less than {limit}")
