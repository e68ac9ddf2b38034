# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the motors' readings say: the newest that count, who is silent, a fault, and whether the angles can be trusted.

After power-up a motor knows its angle modulo a turn of its rotor only: 60 degrees at the joint of an AK60-6, 40 at an
AK80-9. So zeros and signs are proven while the arm hangs. A proof holds for as long as the angles are continuous, and
that is judged here alone, whichever fault lets the arm down. The angles of an arm are no longer continuous when

- a motor may have lost its power: it was silent for long enough to restart, or has come back from a shorter silence at
  an angle that its velocity does not explain;
- an angle jumps, or a joint turns faster than `max_velocity`: an encoder that slips looks like a joint that is thrown;
- angle and velocity contradict each other: a wrong `velocity_range` or sign, a frozen angle, a slow slip;
- a motor reports an error;
- another part has a reason of its own (`doubt`): a motor found off, a command of another sender.

What no reading shows: an encoder that slips by less than `CONTINUITY.jump` at a time while its velocity follows, and a
motor that repeats one angle with a velocity of 0. The proof of signs, at the next start, finds the second.

Chosen against ordinary equipment: 3 % of the frames lost each way, a computer that is late by 20 ms in one cycle of
ten, adapters that deliver in batches of 1 ms, velocities of 12 bits without a code for 0 that lag by 20 ms, knocks at
5 rad/s, and a motor that reports one wrong reading now and then.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from exo_gravity.core.motors.joint_motor import UNKNOWN, JointSample
from exo_gravity.core.safety.drive import Fault, FaultCode
from exo_gravity.core.safety.limits import READING, Limits


@dataclass(frozen=True)
class ContinuityLimits:
    """How far readings may differ from a continuous motion."""

    #: s of silence after which a motor may have restarted while it held the arm; a forearm whose motor has lost its
    #: power has fallen by 0.3 rad by then. Until then its angle shows whether it has: a lost turn is at least twice
    #: `home_tolerance`
    restart: float = 0.1
    restart_off: float = 0.3  #: s, of motors that are off: only a person moves an arm that is down
    jump: float = 0.05  #: rad between two readings, in addition to what `max_velocity` allows
    #: s, time constant with which angle and integrated velocity forget their difference; a velocity that is wrong by
    #: half a code of an AK80-9 (0.012 rad/s) adds 0.024 rad
    memory: float = 2.0
    #: rad of difference: knocks at 5 rad/s, a velocity that lags by 20 ms, lost frames and a late computer together
    #: make 0.09 (test/core/test_readings.py)
    slip: float = 0.15
    #: of the way that the velocity shows, in addition: a `velocity_range` of 50 in place of 45 rad/s is wrong by 0.11,
    #: which no arm feels
    share: float = 0.25


CONTINUITY = ContinuityLimits()
# Readings after which the angles are no longer continuous.
BREAKS = frozenset(
    {FaultCode.MOTOR_ERROR, FaultCode.OVER_SPEED, FaultCode.POSITION_JUMP, FaultCode.READINGS_CONTRADICT}
)


class Slip(NamedTuple):
    """How far a joint's angle and its integrated velocity differ; all is forgotten over `CONTINUITY.memory`."""

    turned: float  #: rad, by the angle
    difference: float  #: rad, of that, which the velocity does not explain
    way: float  #: rad, to and fro, by the velocity

    def after(self, before: JointSample, after: JointSample) -> "Slip":
        """Return the slip after the motion between two readings."""
        turned, expected = after.position - before.position, _expected(before, after)
        kept = math.exp((before.time - after.time) / CONTINUITY.memory)
        difference = kept * self.difference + turned - expected
        return Slip(kept * self.turned + turned, difference, kept * self.way + abs(expected))

    @property
    def is_contradiction(self) -> bool:
        """Whether no ordinary motor makes such a difference."""
        return abs(self.difference) > CONTINUITY.slip + CONTINUITY.share * self.way


NO_SLIP = Slip(0.0, 0.0, 0.0)


def _expected(before: JointSample, after: JointSample) -> float:
    """Return the angle in rad by which the velocities of two readings say that the joint has turned between them."""
    return 0.5 * (before.velocity + after.velocity) * (after.time - before.time)


class Readings:
    """Follows the readings of an arm's motors, cycle by cycle.

    joints: (n,) the newest ones. One that shows a fault is left out until the next one shows a fault too.
    silent: (n,) whether a motor is silent: no reply for `reply_timeout`, nor to `missed` commands. A loop that stood
        still has sent none.
    fault: what the newest readings show, or None.
    trusted: whether zeros and signs were proven, and the angles have been continuous since.
    is_being_proven: whether the arm was seen to hang and its signs are being proven, set from outside: the angles must
        be continuous from then on.
    """

    def __init__(self, limits: Limits) -> None:
        count = len(limits.joint_names)
        self.joints: tuple[JointSample, ...] = (UNKNOWN,) * count
        self.silent: Sequence[bool] = (True,) * count
        self.fault: Fault | None = None
        self.trusted = False
        self.is_being_proven = False
        self._limits = limits
        self._newest = [-math.inf] * count  # s
        self._missed = [READING.missed] * count
        self._asked = [-math.inf] * count  # s; each of `joints` was taken later
        self._is_suspect = [False] * count
        self._slips = [NO_SLIP] * count
        self._now = -math.inf  # s, of the last cycle

    @property
    def is_late(self) -> bool:
        """Whether a motor has not replied to some commands."""
        return max(self._missed) >= READING.late

    def prove(self) -> None:
        """Note that zeros and signs have just been proven."""
        self.trusted = True

    def doubt(self) -> None:
        """Note that the angles may no longer be continuous, for a reason that no reading shows."""
        self.trusted = False

    def step(self, now: float, joints: Sequence[JointSample], held_back: Sequence[bool], powered: bool = True) -> None:
        """Take the newest readings of a cycle.

        now: s.
        joints: (n,) the newest readings.
        held_back: (n,) whether the motor was sent nothing in the last cycle on purpose.
        powered: whether the motors are on.
        """
        restart = CONTINUITY.restart if powered else CONTINUITY.restart_off
        counting = list(self.joints)
        found: list[Fault] = []
        for i, joint in enumerate(joints):
            if joint.time <= self._newest[i]:
                self._missed[i] += not held_back[i]
                self.trusted &= self._missed[i] < READING.missed or now - joint.time <= restart
                continue
            faults = self._faults(i, joint, restart)
            self._newest[i], self._missed[i] = joint.time, 0
            is_confirmed, self._is_suspect[i] = self._is_suspect[i], bool(faults)
            if faults and not is_confirmed and self.joints[i] is not UNKNOWN:
                continue
            is_continuous = not faults and joint.time - self.joints[i].time <= self._limits.reply_timeout
            self._slips[i] = self._slips[i].after(self.joints[i], joint) if is_continuous else NO_SLIP
            counting[i], self._asked[i] = joint, self._now
            found += faults if is_confirmed else ()
            found += [self._contradiction(i)] if self._slips[i].is_contradiction else ()
        self.trusted &= not any(fault.code in BREAKS for fault in found)
        self.joints = tuple(counting)
        asked = zip(joints, self._missed, strict=True)
        self.silent = [missed >= READING.missed and self._limits.is_silent(now, joint) for joint, missed in asked]
        self.fault = self._silence() if any(self.silent) else next(iter(found), None)
        self._now = now

    def _faults(self, i: int, joint: JointSample, restart: float) -> list[Fault]:
        """Return what the new reading of joint `i` shows, compared with the last one that counts.

        restart: s of silence after which its motor may have restarted.
        """
        limits, last = self._limits, self.joints[i]
        faults = limits.find_faults(i, joint)
        turned, silence = joint.position - last.position, joint.time - last.time
        is_jump = abs(turned) > CONTINUITY.jump + limits.max_velocity[i] * (joint.time - self._asked[i])
        is_turn = abs(turned - _expected(last, joint)) > limits.home_tolerance[i]
        is_known = self.trusted or self.is_being_proven
        was_short = limits.reply_timeout < silence and (is_known or silence <= restart)
        if is_jump or (is_turn and was_short):
            what = f"from {last.position:.3f} to {joint.position:.3f} rad in {1000.0 * (joint.time - last.time):.0f} ms"
            faults.append(Fault.of_joint(FaultCode.POSITION_JUMP, limits.joint_names[i], what))
        return sorted(faults, key=lambda fault: fault.code is FaultCode.OUTSIDE_LIMITS)  # what a jump explains

    def _contradiction(self, i: int) -> Fault:
        slip = self._slips[i]
        reason = (
            f"its angle has turned by {slip.turned:+.2f} rad, but its velocity says "
            f"{slip.turned - slip.difference:+.2f}: check velocity_range, and whether the encoder slips"
        )
        return Fault.of_joint(FaultCode.READINGS_CONTRADICT, self._limits.joint_names[i], reason)

    def _silence(self) -> Fault:
        limits = self._limits
        name, buses = limits.joint_names[self.silent.index(True)], set(limits.channels)
        columns = zip(limits.channels, self._missed, strict=True)
        replying = {bus for bus, missed in columns if missed < READING.missed}
        reason = f"no reply for more than {limits.reply_timeout * 1000:.0f} ms"
        if len(buses) > 1 and (dead := buses - replying):
            reason += f"; no motor on {' and '.join(sorted(dead))} replies: the bus is lost, or the supply is cut"
        return Fault.of_joint(FaultCode.MOTOR_SILENT, name, reason)
