# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The last hand on every command: no torque that is asked for, whatever asks for it, throws an arm.

`shape` limits the torque of an arm that is carried, in this order: soft wall before a joint limit, clamp to the
permitted torque (derated when hot), rate limit. Its damping is the largest that any cause asks for. What a guided
motion, late efforts, and torque that a moving joint does not get ask for rises and falls slowly; what the soft wall
asks for counts at once.

`damping` then bounds each command that leaves the safety machine, whether the arm is carried or let down. With tau the
feed-forward of a joint, v > 0 its speed along tau, V = `driven_speed` and F = V + BARRIER.span, the motor gets at least

    kd = |tau| / F * min(1, max(0, (v - V) / (F - V)))

From F on kd v >= |tau|: the motor as a whole takes energy out of the joint, however wrong tau is. So no feed-forward
drives a joint beyond F, but for what happens within a cycle. The motor itself applies kd v, without delay and to its
true speed: one wrong speed in a reply moves nothing. A light arm passes F within a cycle, so v leads the newest speed
by its change over BARRIER.lead, at any rate of the loop. An empty forearm under 3 Nm still reaches 2.7 rad/s at 250 Hz,
and 6.4 at 100 Hz. A wearer who lifts their arm feels nothing up to V; at F they lift it without support.

An arm can lose its load at once: a strap opens, a tool falls. In the 4 ms until the loop sees it a light forearm gains
2 rad/s. So joints at rest are damped by |tau| / `STILLNESS.speed`, and an unloaded joint gets no faster than that. The
damping is off while the torque is guided: it would hide a torque that is too large. A wearer who moves off frees the
joint within a few cycles. If a joint moves off faster than a wearer can, the whole arm stays damped until nothing
drives it, or someone moves it faster; after `STILLNESS.empty` the arm is let down.

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

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.numbers import rate_limited
from exo_gravity.core.safety.guidance import guide_damping
from exo_gravity.core.safety.limits import DAMPING, DAMPING_RATE, HEAT, MAX_EFFORT_RATE, WALL, Limits


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
    felt: float = 0.05  #: Nm s/rad; less damping has no cause to report
    calm: float = 0.25  #: rad/s, `driven_speed` while a motor is late: that of a guided motion
    still: float = 0.75  #: rad/s, from which on a motor then drives no joint; 1.25 lets seven joints reach 0.78 (0.58)


@dataclass(frozen=True)
class StillnessTuning:
    """How joints at rest are damped, and how an arm that has lost its load shows."""

    speed: float = 1.0  #: rad/s, at which the damping then balances the torque
    still: float = 0.1  #: rad/s; four codes of the velocity
    turn: float = 0.002  #: rad by which a joint may turn and be still; five codes of the position
    time: float = 0.2  #: s for which a joint is still, before it is damped: less than 0.01 rad/s
    release: float = 0.04  #: s, time constant with which a joint that moves off is let go
    #: rad/s beyond the low-passed speed, as no wearer moves off: 0.18 in a reach at 3 rad/s, an empty forearm 1 to 2
    sudden: float = 0.3
    least: float = 0.5  #: Nm; less throws no joint, and a light one that leaves its friction needs no more
    share: float = 0.5  #: of the damping; a joint with less of it has moved before
    wearer: float = 1.5  #: of the torque, beyond which the damping shows that someone moves the joint
    empty: float = 0.2  #: s for which the damping balances the torque: there is no arm in the cuff


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


BARRIER, STILLNESS, VIBRATION = BarrierTuning(), StillnessTuning(), VibrationLimits()


class JointShaper:
    """Shapes what the motor of joint `i` gets; peak: the most that it can apply, Nm s/rad.

    limiting: which limits acted on its torque in the last `shape`. cause: why it is damped, by the last `bound`.
    """

    def __init__(self, limits: Limits, i: int, peak: float) -> None:
        self._name, self._limits, self._i, self._peak = limits.joint_names[i], limits, i, peak
        self.limiting: Sequence[str] = ()
        self.cause = self._cause = ""
        # Nm s/rad, of the causes that neither rise nor fall at once, and the name of the last one
        self._slowly, self._last = 0.0, ""
        self._slow = 0.0  # rad/s, the speed low-passed by BARRIER.lead
        self._brake = self._given = 0.0  # Nm s/rad, and all that was given last
        self._steady = math.inf  # Nm s/rad, the most that the joint gets of what is asked for
        self._still_for = self._held = 0.0  # s, and Nm s/rad
        self._still_at = math.nan  # rad
        # Whether it moves off as no wearer does, its motor drives it, and someone moves it.
        self.is_sudden = self.is_driven = self.is_moved = False
        self._way = 1.0  # 1 or -1, in which it was last faster than VIBRATION.speed
        self._since = math.inf  # s since it has turned

    def shape(
        self,
        dt: float,
        sample: JointSample,
        effort: float,
        share: float,
        before: float,
        is_guided: bool,
        late: float,
        is_empty: bool,
    ) -> tuple[float, float]:
        """Return torque (Nm) and damping (Nm s/rad) of a carried joint; see `Shaper.shape`. Raises ParameterError."""
        most, limit = self._limits.max_command[self._i], self._limits.max_effort[self._i]
        if not abs(effort) <= most:
            raise ParameterError(f"effort of {self._name}", effort, f"from -{most:g} to {most:g} Nm")
        spring, wall = self._wall(sample)
        colder = HEAT.span if sample.temperature is None else HEAT.most - sample.temperature
        permitted = limit * (0.5 + 0.5 * max(0.0, min(1.0, colder / HEAT.span)))
        wanted = share * (effort + spring)
        clamped = max(-permitted, min(permitted, wanted))
        given = rate_limited(clamped, before, MAX_EFFORT_RATE * dt)
        # The compensator may have clamped it already: all that is permitted counts as clamped.
        missing = given if abs(given) >= permitted else wanted - given
        slow, cause = max(
            (guide_damping(sample.velocity) if is_guided else 0.0, "guided motion"),
            (late, "late efforts"),
            (DAMPING if missing * sample.velocity < 0.0 else 0.0, "torque withheld"),
        )
        self._slowly = rate_limited(slow, self._slowly, DAMPING_RATE * dt)
        self._last = cause if slow else self._last
        acting = {
            "soft wall": wall > 0.5 * DAMPING,  # less is not felt, and an arm may hang just inside
            "derating": permitted < limit,
            "max_effort": clamped != wanted,
            "max_effort_rate": given != clamped,
        }
        self.limiting = [f"{name} ({self._name})" for name, acts in acting.items() if acts]
        still = self._hold(dt, sample, given, is_empty, is_guided)
        damping, self._cause = max((self._slowly, self._last), (wall, "soft wall"), (still, "still joint"))
        return given, damping

    def _hold(self, dt: float, sample: JointSample, effort: float, is_empty: bool, is_guided: bool) -> float:
        """Return the damping in Nm s/rad of a joint that is still, or whose arm seems to be empty.

        effort: Nm, which the motor applies. is_empty: whether what the arm carried seems to have left it. is_guided:
        whether its torque is guided, which is to move a joint that has too much of it.
        """
        along, before = (math.copysign(speed, speed * effort) for speed in (sample.velocity, self._slow))
        full = min(self._peak, abs(effort) / STILLNESS.speed)
        is_held = abs(effort) >= STILLNESS.least and self._held >= STILLNESS.share * full
        share = self._held * along / abs(effort) if is_held else 0.0  # of the torque, that the damping balances
        self.is_sudden = is_held and along - before > STILLNESS.sudden
        self.is_moved = not -STILLNESS.share <= share <= STILLNESS.wearer
        self.is_driven = share > 0.0 and along > STILLNESS.still
        is_still = (
            not is_guided
            and abs(sample.velocity) <= STILLNESS.still
            and abs(sample.position - self._still_at) <= STILLNESS.turn
        )
        self._still_for = self._still_for + dt if is_still else 0.0
        self._still_at = self._still_at if is_still else sample.position
        if is_empty:
            self._held = full
        elif self._still_for >= STILLNESS.time:
            heavy = max(0.0, min(1.0, abs(effort) / STILLNESS.least - 1.0))
            self._held = rate_limited(heavy * full, self._held, DAMPING_RATE * dt)
        elif not self._still_for:
            self._held *= max(0.0, 1.0 - dt / STILLNESS.release)
        return self._held

    def _wall(self, sample: JointSample) -> tuple[float, float]:
        """Return spring in Nm and damping in Nm s/rad of the soft wall in which the joint is; zeros outside."""
        above = sample.position - self._limits.position_max[self._i] + WALL.width
        below = self._limits.position_min[self._i] + WALL.width - sample.position
        depth = above if above > 0.0 else -max(0.0, below)  # rad in a wall, > 0 in the upper one
        # Once the joint leaves the wall, no spring pushes it.
        is_left = math.copysign(sample.velocity, sample.velocity * depth) < -WALL.release
        spring = 0.0 if is_left or not depth else -max(-WALL.most, min(WALL.most, WALL.stiffness * depth))
        return spring, DAMPING * min(1.0, abs(depth) / WALL.edge)

    def bound(
        self, dt: float, sample: JointSample, is_silent: bool, effort: float, damping: float, is_late: bool
    ) -> float:
        """Return the damping in Nm s/rad of the joint's part of a command; see `Shaper.damping`."""
        first, velocity = self._limits.driven_speed, sample.velocity if math.isfinite(sample.velocity) else 0.0
        change = velocity - self._slow  # over the lead, or over a cycle that is longer
        self._slow += min(1.0, dt / BARRIER.lead) * change
        sign = math.copysign(1.0, effort)
        ahead = sign * velocity + max(0.0, BARRIER.lead / max(BARRIER.lead, dt) * sign * change)
        falling = max(0.0, 1.0 - dt / BARRIER.hold) * self._brake
        self._brake = needed = max(_rising(effort, ahead, first, first + BARRIER.span), falling)
        self._steady += VIBRATION.recovery * dt
        self._since += dt
        if sample.velocity * self._way < -VIBRATION.speed:
            if self._given and self._since <= VIBRATION.half_period:
                self._steady = max(VIBRATION.least, VIBRATION.share * min(DAMPING, self._steady))
            self._way, self._since = -self._way, 0.0
        speed, most = 0.0 if is_silent else abs(sample.velocity), max(self._limits.max_effort[self._i], abs(effort))
        if is_late:
            along = math.copysign(speed, effort * sample.velocity)
            needed = max(needed, _rising(effort, along, BARRIER.calm, BARRIER.still))
        asked, cause = min(damping, self._steady), self._cause
        if needed > asked and not is_silent:
            asked, cause = needed, "brake"
        self.cause = f"{cause} ({self._name})" if asked >= BARRIER.felt else ""
        wanted = min(self._peak, asked)
        self._given = most / speed if wanted * speed > most else wanted
        return self._given


class Shaper:
    """The bounds of one arm's commands.

    peak_damping: the most that each motor can apply, (n,) Nm s/rad.

    empty_for: s for which motors have driven joints as if what these carried had left them.
    """

    def __init__(self, limits: Limits, peak_damping: Sequence[float]) -> None:
        self.joints = [JointShaper(limits, i, peak) for i, peak in enumerate(peak_damping)]
        self.empty_for = 0.0

    def shape(
        self,
        dt: float,
        samples: Sequence[JointSample],
        effort: Sequence[float],
        share: Sequence[float],
        before: Sequence[float],
        is_guided: bool,
        late: float = 0.0,
    ) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return torque (n,) in Nm and damping (n,) in Nm s/rad of a carried arm.

        dt: s since the last call. samples: the newest readings (n,).
        effort: what is asked for, (n,) Nm.
        share: 0..1, the factor (n,) on effort and soft wall where torque begins.
        before: the torque of the last command, (n,) Nm.
        is_guided: whether the torque is guided.
        late: the damping that late efforts ask for, Nm s/rad.

        Raises ParameterError if an effort is NaN or beyond `max_command`.
        """
        columns = zip(self.joints, samples, effort, share, before, strict=True)
        given = [
            joint.shape(dt, sample, asked, part, last, is_guided, late, self.empty_for > 0.0)
            for joint, sample, asked, part, last in columns
        ]
        is_empty = self.empty_for or any(joint.is_sudden for joint in self.joints)
        is_alone = any(joint.is_driven for joint in self.joints) and not any(joint.is_moved for joint in self.joints)
        self.empty_for = self.empty_for + dt if is_empty and is_alone else 0.0
        return tuple([torque for torque, _ in given]), tuple([damping for _, damping in given])

    def damping(
        self,
        dt: float,
        samples: Sequence[JointSample],
        silent: Sequence[bool],
        effort: Sequence[float],
        damping: Sequence[float],
        is_late: bool,
    ) -> tuple[float, ...]:
        """Return the damping (n,) in Nm s/rad of a command that is to apply `effort` (n,) Nm.

        dt: s since the last call. samples: the newest readings (n,).
        silent: which motors (n,) do not reply: their speed is not known, so that it bounds nothing.
        damping: what is asked for, (n,) Nm s/rad. is_late: whether a motor is late with its replies.
        """
        columns = zip(self.joints, samples, silent, effort, damping, strict=True)
        return tuple([joint.bound(dt, sample, mute, tau, own, is_late) for joint, sample, mute, tau, own in columns])


def _rising(torque: float, speed: float, first: float, last: float) -> float:
    """Return the damping in Nm s/rad of a joint that `torque` (Nm) drives at `speed`; none up to `first` rad/s.

    last: rad/s, from which on it takes as much out of the joint as the torque gives.
    """
    return abs(torque) / last * max(0.0, min(1.0, (speed - first) / (last - first)))
