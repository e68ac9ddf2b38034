"""What the safety machine watches beside the motors' readings: the arm's rest, the motors' supply, the efforts' age."""

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.motors.joint_motor import UNKNOWN, JointSample
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.drive import Fault, FaultCode


@dataclass(frozen=True)
class Rest:
    """What a joint at rest is."""

    turn: float = 0.005  #: rad that it may turn meanwhile
    time: float = 0.5  #: s without such a turn, after which the arm counts as at rest


@dataclass(frozen=True)
class Supply:
    """What in its replies shows a motor on or off.

    A motor that is off may report 0.15 Nm of noise (standard deviation); smoothed at 100 Hz that is 0.05 Nm, so one
    read in ten thousand takes such a motor for one that is on.
    """

    torque: float = 0.2  #: Nm, smoothed, from which on it is on; less cannot throw an arm when it is switched off
    smoothing: float = 0.05  #: s, time constant
    read_time: float = 0.2  #: s without torque that show motors off; an arm that sinks under damping shows it sooner


@dataclass(frozen=True)
class Ride:
    """For how long in s late efforts are still applied."""

    longest_age: float = 0.18  #: of efforts; less than the gap after which the compensator ramps in from zero
    longest: float = 0.13  #: at a time
    recovery: float = 0.1  #: of riding that each s with sound efforts makes good


REST, SUPPLY, RIDE = Rest(), Supply(), Ride()


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


class SupplyMonitor:
    """Whether motors that may have lost their power, or may be on unasked, apply torque. Only their replies tell.

    All motors silent at once means that their supply was cut, as by an emergency stop, or that the bus was. A motor
    that restarted is off, and must stay off until the operator enables the arm; one that kept its power still applies
    its last command, and must be let down. Until it is known, a motor is sent nothing that could switch it on
    (`MotorBus`). The same holds for the motors of an owner that left no notes.

    unsure: (4,) whether it is not known of a motor.
    """

    def __init__(self) -> None:
        self._times = list(NO_TORQUE)  # s, of each motor's last reply
        self.suspect(NO_TORQUE)
        self.clear()

    @property
    def returning(self) -> tuple[bool, ...]:
        """Which motors (4,) are unsure and were silent: they may apply another torque than the last one sent."""
        return tuple(map(operator.and_, self.unsure, self._were_silent))

    @property
    def are_off(self) -> bool:
        """Whether every unsure motor has replied for `SUPPLY.read_time` without torque."""
        unsure = [heard for heard, is_unsure in zip(self._heard, self.unsure, strict=True) if is_unsure]
        return bool(unsure) and min(unsure) >= SUPPLY.read_time

    def suspect(self, held: Sequence[float]) -> None:
        """Take every motor for unsure from now on.

        held: (4,) Nm, what they apply if they are on.
        """
        self._held = held
        self.unsure: tuple[bool, ...] = (True,) * len(held)
        self._torque = list(NO_TORQUE)  # smoothed, since the motor replies again
        self._heard = list(NO_TORQUE)  # s for which it has replied again
        self._were_silent = [False] * len(held)

    def clear(self, still: Sequence[bool] = (False,) * JOINT_COUNT) -> None:
        """Take the motors for sure from now on.

        still: (4,) which stay unsure, if they are: those that are silent or `returning`.
        """
        self.unsure = tuple(map(operator.and_, self.unsure, still))

    def step(self, dt: float, joints: Sequence[JointSample], silent: Sequence[bool]) -> bool:
        """Take the newest readings, `dt` s after the last ones; return whether one shows that its motor is on.

        silent: (4,) whether the joint's motor does not reply.
        """
        if not any(self.unsure):
            return False
        for i, joint in enumerate(joints):
            self._heard[i] = 0.0 if silent[i] else self._heard[i] + dt
            if silent[i]:
                self._torque[i], self._were_silent[i] = 0.0, True
            elif joint.time > self._times[i]:
                self._torque[i] += min(1.0, dt / SUPPLY.smoothing) * (joint.effort - self._torque[i])
                self._times[i] = joint.time
        shown = [abs(torque) > SUPPLY.torque for torque in self._torque]
        if not any(shown):
            return False
        # The motors of an arm share a supply: one that has too little to hold for its replies to tell is on, too.
        self.unsure = tuple(
            is_unsure and not is_shown and (is_silent or abs(held) > 2.0 * SUPPLY.torque)
            for is_unsure, is_shown, is_silent, held in zip(self.unsure, shown, silent, self._held, strict=True)
        )
        return True


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
