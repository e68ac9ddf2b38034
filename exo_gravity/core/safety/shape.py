# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The last hand on every drive: no torque that is asked for, whatever asks for it, throws an arm.

`shape` limits the torque of an arm that is carried, in this order: soft wall before a joint limit, clamp to the
permitted torque (derated when hot), rate limit. A joint that moves against torque which it does not get is damped.

`damping` then bounds each drive that leaves the safety machine, whether the arm is carried or let down. With tau the
feed-forward of a joint, v > 0 its speed along tau, V = `driven_speed` and F = V + BARRIER.span, the motor gets at least

    kd = |tau| / F * min(1, max(0, (v - V) / (F - V)))

From F on kd v >= |tau|: the motor as a whole takes energy out of the joint, however wrong tau is. So no feed-forward
drives a joint beyond F, but for what happens within a cycle. The motor itself applies kd v, without delay and to its
true speed: one wrong speed in a reply moves nothing. A light arm passes F within a cycle, so v leads the newest speed
by its change over BARRIER.lead, at any rate of the loop. An empty forearm under 3 Nm still reaches 2.7 rad/s at 250 Hz,
and 6.4 at 100 Hz. A wearer who lifts their arm feels nothing up to V; at F they lift it without support.

A motor that is late with its replies may have lost its power. Its joint falls, and the torque of the others, which
answers the pose before, drives them. Meanwhile V is BARRIER.calm and F is BARRIER.still for all joints. This brake ends
with the lateness. Lost frames alone hardly make a motor late (READING.late): with 3 % of them lost each way at 250 Hz,
neither of two reaches at 3 rad/s was braked.

Damping is bounded, too: kd times the newest speed stays within `max_effort`, or tau if that is more, so that neither a
wearer's jerk nor a fall makes a motor brake with more than it may drive. `test/core/test_barrier.py`
plays both.

The motor's damping is delayed after all, by its current loop (time constant T1) and its velocity filter (T2). A joint
of inertia J is unstable if kd > J (1/T1 + 1/T2) (Routh-Hurwitz of J T1 T2 s^3 + J (T1 + T2) s^2 + J s + kd): the bare
elbow, 0.0036 kg m^2, above 4.0 Nm s/rad with 8 and 1 ms, above 0.6 with 8 and 20 ms. J, T1 and T2 are not known. So
when a joint oscillates faster than people can shake it, its damping is reduced (`VibrationLimits`). The brake of a
driven joint is not.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.numbers import limited
from exo_gravity.core.safety.descent import DESCENT
from exo_gravity.core.safety.limits import DAMPING, HEAT, MAX_EFFORT_RATE, WALL, Limits


@dataclass(frozen=True)
class BarrierTuning:
    """How the brake acts beyond `driven_speed`."""

    span: float = 1.0  #: rad/s over which the brake rises; less is felt as a step
    #: s, the speed's change over which is added to it. An empty forearm under 3 Nm gains 2 rad/s in a cycle of 4 ms, a
    #: wearer who reaches at 3 rad/s 0.06
    lead: float = 0.012
    #: s, time constant with which the brake falls. It rises at once; if it fell so, a light arm would be thrown and
    #: caught by turns, one cycle each
    hold: float = 0.05
    calm: float = 0.25  #: rad/s, `driven_speed` while a motor is late: that of a guided motion
    still: float = 0.75  #: rad/s, from which on a motor then drives no joint; 1.25 lets seven joints reach 0.78 (0.58)


@dataclass(frozen=True)
class VibrationLimits:
    """When a joint vibrates under its damping, and how far its damping is then reduced.

    Simulated joints of 0.0024 to 0.0136 kg m^2, with T1 of 8 or 20 ms and T2 of 20 ms, at 100 and 250 Hz: without this
    they oscillate on at 2.6 to 27 rad/s, with up to 33 J in one stretch; with it they reach 15 rad/s once, with 0.5 J,
    and then 3 at most.
    """

    speed: float = 0.3  #: rad/s, each way; seven codes of the velocity. With 0.5 they reach 22, with 1.0 J
    half_period: float = 0.07  #: s at most; these joints need 10 to 63 ms, people who shake an arm at 6 Hz 83
    share: float = 0.25  #: that is left of the damping; with 0.5 they reach 21, with 1.6 J
    least: float = 0.3  #: Nm s/rad, that stays: the lightest of these joints bears 0.42 behind 8 and 20 ms
    recovery: float = 0.5  #: Nm s/rad a second; with 2.5 one of them goes on at 16


BARRIER, VIBRATION = BarrierTuning(), VibrationLimits()


class Shaped(NamedTuple):
    """What a carried arm gets of what is asked for."""

    effort: tuple[float, ...]  #: (n,) Nm
    damping: tuple[float, ...]  #: (n,) Nm s/rad
    acted: frozenset[str]  #: which limits acted, for people


class Shaper:
    """The bounds of one arm's drives.

    limits: of the arm.
    peak_damping: the most that each motor can apply, (n,) Nm s/rad.
    """

    def __init__(self, limits: Limits, peak_damping: Sequence[float]) -> None:
        self._limits, self._peak = limits, tuple(peak_damping)
        self._asked = [0.0] * len(self._peak)  # Nm s/rad, that neither rises nor falls at once
        self._slow = [0.0] * len(self._peak)  # rad/s, the speed low-passed by BARRIER.lead
        self._brake = [0.0] * len(self._peak)  # Nm s/rad
        self._steady = [math.inf] * len(self._peak)  # Nm s/rad, the most that a joint gets of what is asked for
        self._way = [1.0] * len(self._peak)  # 1 or -1, in which a joint was last faster than VIBRATION.speed
        self._since = [math.inf] * len(self._peak)  # s since it has turned
        self._given = [0.0] * len(self._peak)  # Nm s/rad, last

    def shape(
        self,
        dt: float,
        joints: Sequence[JointSample],
        effort: Sequence[float],
        share: Sequence[float],
        before: Sequence[float],
        damping: Sequence[float],
    ) -> Shaped:
        """Return what a carried arm gets.

        dt: s since the last call.
        joints: the newest readings (n,).
        effort, damping: what is asked for, (n,) Nm and (n,) Nm s/rad.
        share: 0..1, the factor (n,) on effort and soft wall where torque begins.
        before: the torque of the last drive, (n,) Nm.

        Raises ParameterError if an effort is NaN or beyond `max_command`.
        """
        step, step_of_damping = MAX_EFFORT_RATE * dt, DESCENT.damping_rate * dt
        shaped, dampings, acted = [], [], set()
        for i, (name, joint) in enumerate(zip(self._limits.joint_names, joints, strict=True)):
            if not abs(effort[i]) <= (most := self._limits.max_command[i]):
                raise ParameterError(f"effort of {name}", effort[i], f"from -{most:g} to {most:g} Nm")
            spring, wall = self._wall(i, joint)
            permitted = self._permitted(i, joint)
            wanted = share[i] * (effort[i] + spring)
            clamped = max(-permitted, min(permitted, wanted))
            given = limited(clamped, before[i], step)
            # The compensator may have clamped it already: all that is permitted counts as clamped.
            missing = given if abs(given) >= permitted else wanted - given
            asked = DAMPING if missing * joint.velocity < 0.0 else damping[i]
            self._asked[i] = limited(asked, self._asked[i], step_of_damping)
            shaped.append(given)
            # A wall's damping rises at once, since it already rises with the position.
            dampings.append(max(wall, self._asked[i]))
            if wall:
                acted.add(f"soft wall ({name})")
            if permitted < self._limits.max_effort[i]:
                acted.add(f"derating ({name})")
            if clamped != wanted:
                acted.add(f"max_effort ({name})")
            if given != clamped:
                acted.add(f"max_effort_rate ({name})")
        return Shaped(tuple(shaped), tuple(dampings), frozenset(acted))

    def damping(
        self,
        dt: float,
        joints: Sequence[JointSample],
        silent: Sequence[bool],
        effort: Sequence[float],
        damping: Sequence[float],
        is_late: bool,
    ) -> tuple[float, ...]:
        """Return the damping (n,) in Nm s/rad of a drive that is to apply `effort` (n,) Nm.

        dt: s since the last call.
        joints: the newest readings (n,).
        silent: which motors (n,) do not reply: their speed is not known, so that it bounds nothing.
        damping: what is asked for, (n,) Nm s/rad.
        is_late: whether a motor is late with its replies.
        """
        brakes = self.brake(dt, joints, effort)
        self._watch(dt, joints)
        steady = map(min, damping, self._steady)
        columns = zip(joints, silent, effort, steady, brakes, self._peak, self._limits.max_effort, strict=True)
        bounded = []
        for joint, is_silent, tau, asked, brake, peak, limit in columns:
            speed, most = 0.0 if is_silent else abs(joint.velocity), max(limit, abs(tau))
            along = math.copysign(speed, tau * joint.velocity)
            needed = max(brake, _rising(tau, along, BARRIER.calm, BARRIER.still)) if is_late else brake
            wanted = min(peak, asked if is_silent else max(asked, needed))
            bounded.append(most / speed if wanted * speed > most else wanted)
        self._given = bounded
        return tuple(bounded)

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return the damping (n,) in Nm s/rad that joints need which `effort` (n,) Nm drives; see the module."""
        first, last = self._limits.driven_speed, self._limits.driven_speed + BARRIER.span
        share, kept = min(1.0, dt / BARRIER.lead), max(0.0, 1.0 - dt / BARRIER.hold)
        ahead = BARRIER.lead / max(BARRIER.lead, dt)
        for i, (joint, tau) in enumerate(zip(joints, effort, strict=True)):
            velocity = joint.velocity if math.isfinite(joint.velocity) else 0.0
            change = velocity - self._slow[i]  # over the lead, or over a cycle that is longer
            self._slow[i] += share * change
            sign = math.copysign(1.0, tau)
            driven = sign * velocity + max(0.0, ahead * sign * change)
            self._brake[i] = max(_rising(tau, driven, first, last), kept * self._brake[i])
        return tuple(self._brake)

    def _watch(self, dt: float, joints: Sequence[JointSample]) -> None:
        """Reduce the damping limit of each joint that vibrates, and let the limits rise again."""
        for i, joint in enumerate(joints):
            self._steady[i] += VIBRATION.recovery * dt
            self._since[i] += dt
            if not joint.velocity * self._way[i] < -VIBRATION.speed:
                continue
            if self._given[i] and self._since[i] <= VIBRATION.half_period:
                self._steady[i] = max(VIBRATION.least, VIBRATION.share * min(DAMPING, self._steady[i]))
            self._way[i], self._since[i] = -self._way[i], 0.0

    def _wall(self, i: int, joint: JointSample) -> tuple[float, float]:
        """Return spring in Nm and damping in Nm s/rad of the soft wall in which a joint is; zeros outside."""
        above = joint.position - self._limits.position_max[i] + WALL.width
        below = self._limits.position_min[i] + WALL.width - joint.position
        depth = above if above > 0.0 else -max(0.0, below)  # rad in a wall, > 0 in the upper one
        # Once the joint leaves the wall, no spring pushes it.
        is_left = math.copysign(joint.velocity, joint.velocity * depth) < -WALL.release
        spring = 0.0 if is_left or not depth else -max(-WALL.most, min(WALL.most, WALL.stiffness * depth))
        return spring, DAMPING * min(1.0, abs(depth) / WALL.edge)

    def _permitted(self, i: int, joint: JointSample) -> float:
        """Return the torque in Nm that a joint's motor may apply at its temperature."""
        colder = HEAT.span if joint.temperature is None else HEAT.most - joint.temperature
        return self._limits.max_effort[i] * (0.5 + 0.5 * max(0.0, min(1.0, colder / HEAT.span)))


def _rising(torque: float, speed: float, first: float, last: float) -> float:
    """Return the damping in Nm s/rad of a joint that `torque` (Nm) drives at `speed`; none up to `first` rad/s.

    last: rad/s, from which on it takes as much out of the joint as the torque gives.
    """
    return abs(torque) / last * max(0.0, min(1.0, (speed - first) / (last - first)))
