# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The way down: lowers an arm at a bounded speed until nothing holds it, so that switching its motors off is safe.

Each joint has a torque s, which starts as the last one applied, and a damping k, which the motor itself applies. With v
the joint's velocity and V the permitted speed:

    |v| <= V:             s fades to zero within `fade_time`, the part that has grown as fast as it grew; then k, too
    s v > 0:              the motor drives the joint, or the wearer lifts it: s goes to zero, and never beyond
    |v| > V, sinking:     s grows against the motion, and k grows
    |v| > V, otherwise:   k grows

A joint sinks when it moves against the torque that it carried when the descent began: that torque shows which way
gravity pulls. So the brake only takes energy out of the arm, and a wearer who lifts it feels damping alone. The brake
returns at once to what the joint carried, which balanced gravity. Beyond that it grows slowly: gravity changes slowly,
a wearer who pushes does not. It never exceeds `max_effort`, or what the joint carried if that was more.

No model of the arm is needed: masses, tilt and friction may be anything. Where gravity comes to pull the other way, k
alone holds: an arm of 3.7 Nm then sinks at 0.74 rad/s. V halves whenever the joint swings back, so that a frictionless
arm comes to rest, and recovers slowly. A joint is down when s is zero and k holds nothing: it hangs, or lies on
something.

A motor that does not reply is taken to obey: k rises, and s stays for `blind_hold`, then fades slowly and blindly. If
it was cut off it applies its last torque instead, and drops what has faded when it hears its commands again, under full
damping. When it replies and has received these, s and k go on; else both continue from the torque t that it reports. No
reply says how much of t is damping: k is the one, from 0 to DAMPING, that leaves in s = t + k v least that s did not
have. Taken for a feed-forward, the damping of a light joint that a hand had thrown (7 Nm on 0.002 kg m²) drove it at 38
rad/s.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.numbers import rate_limited
from exo_gravity.core.safety.limits import DAMPING, DAMPING_RATE, MAX_EFFORT_RATE
from exo_gravity.core.safety.watch import excess_torque, expected_torque

DESCENT_TIMEOUT = 40.0  # s for a bridge to let its arm down before its launcher kills it


@dataclass(frozen=True)
class Descent:
    """How fast a joint sinks, and when an arm is down.

    At 100 Hz and with a velocity filtered over 20 ms, twice these gains make an arm of 75 kg oscillate.
    """

    speed: float = 0.35  #: rad/s; a horizontal arm is down within 10 s
    min_speed: float = 0.04  #: rad/s; two codes of the velocity
    speed_recovery: float = 5.0  #: s, time constant
    swing_speed: float = 0.05  #: rad/s; slower motion has no direction
    driven_speed: float = 0.1  #: rad/s; a torque must not drive its joint faster. Four codes of the velocity
    brake_gain: float = 40.0  #: Nm/rad, up to what the joint carried
    release_gain: float = 60.0  #: Nm/rad
    brake_growth: float = 3.0  #: Nm/s beyond it: gravity of an arm of 75 kg changes no faster while it sinks
    min_fade_rate: float = 0.5  #: Nm/s
    fade_time: float = 2.0  #: s from full torque to none: the wearer has time to take over the arm
    damping_fade: float = 0.4  #: s, time constant
    min_damping: float = 0.01  #: Nm s/rad; smaller values become zero
    #: Nm s/rad that holds no joint: 0.07 Nm at `speed`. A swing without friction keeps so much
    free_damping: float = 0.2
    rest_time: float = 2.0  #: s at rest with nothing holding the arm, until it is down
    longest_rest: float = 7.5  #: s with nothing holding the arm, after which it is down even if the wearer moves it
    longest_silence: float = 12.0  #: s for which a silent motor is waited for: until it has faded
    blind_hold: float = 3.0  #: s for which a silent joint's torque stays: a bus that is back by then finds no step
    blind_fade_time: float = 8.0  #: s from full torque to none of a silent joint, as slowly as a horizontal arm sinks


DESCENT = Descent()


class JointDescent:
    """One joint on its way down: `effort` in Nm and `damping` in Nm s/rad are to be applied now.

    effort, damping: what the motor applies when the descent starts; the damping first rises to DAMPING.
    max_effort: Nm, which the brake exceeds only where `effort` does.
    """

    def __init__(self, effort: float, damping: float, max_effort: float) -> None:
        self._carried, self._most = 0.0, max_effort
        self._blind = 0.0  # s without a reading
        self._speed, self._direction = DESCENT.speed, 0.0
        self.restart(effort, damping)

    @property
    def is_down(self) -> bool:
        """Whether neither torque nor damping holds the joint."""
        return self.effort == 0.0 and self.damping <= DESCENT.free_damping

    def resume(self, torque: float, velocity: float) -> None:
        """Continue from the whole `torque` (Nm) of a motor that replies again, at its joint's `velocity` (rad/s)."""
        damping = 0.0
        if abs(velocity) > DESCENT.swing_speed:
            damping = max(0.0, min(DAMPING, (self.effort - torque) / velocity))
        self.restart(torque + damping * velocity, damping)

    def restart(self, effort: float, damping: float = 0.0) -> None:
        """Continue from `effort` (Nm) and `damping` (Nm s/rad), which rises to DAMPING."""
        self.effort, self.damping = effort, damping
        self._carried = max(self._carried, effort, key=abs)
        self._most = max(self._most, abs(effort))
        self._fade_rate = min(MAX_EFFORT_RATE, max(DESCENT.min_fade_rate, abs(self._carried) / DESCENT.fade_time))
        self._is_rising = True  # the damping has not yet reached DAMPING

    def step_blind(self, dt: float) -> None:
        """Advance by `dt` s without a reading: damping rises and stays, torque stays for a while, then fades slowly."""
        self._blind += dt
        if self._blind > DESCENT.blind_hold:
            self._approach(0.0, max(DESCENT.min_fade_rate, abs(self._carried)) / DESCENT.blind_fade_time, dt)
        self._raise_damping(dt)
        self._is_rising = True

    def step(self, dt: float, velocity: float) -> None:
        """Advance by `dt` s with the joint's `velocity` in rad/s; NaN is taken as 0."""
        self._blind = 0.0
        if not math.isfinite(velocity):
            velocity = 0.0
        self._speed += (DESCENT.speed - self._speed) * dt / DESCENT.speed_recovery
        if abs(velocity) > DESCENT.swing_speed:
            if velocity * self._direction < 0.0:
                self._speed = max(DESCENT.min_speed, 0.5 * self._speed)
            self._direction = math.copysign(1.0, velocity)
        speed, excess = abs(velocity), max(0.0, abs(velocity) - self._speed)
        if self.effort * velocity > 0.0 and speed > DESCENT.driven_speed:
            self._approach(0.0, DESCENT.release_gain * (speed - DESCENT.driven_speed), dt)
        elif excess and self._carried * velocity < 0.0:
            if abs(self.effort) < abs(self._carried):
                self._approach(self._carried, DESCENT.brake_gain * excess, dt)
            elif abs(self.effort) < self._most:
                rate = min(DESCENT.brake_growth, DESCENT.brake_gain * excess)
                self._approach(math.copysign(self._most, self._carried), rate, dt)
        else:
            is_beyond = abs(self.effort) > abs(self._carried)
            fastest = max(self._fade_rate, DESCENT.brake_growth)
            self._approach(0.0, fastest if is_beyond else self._fade_rate, dt)
        self._step_damping(dt, excess)

    def _approach(self, effort: float, rate: float, dt: float) -> None:
        """Bring the torque nearer to `effort` (Nm), by at most `rate` (Nm/s)."""
        self.effort = rate_limited(effort, self.effort, min(MAX_EFFORT_RATE, rate) * dt)

    def _raise_damping(self, dt: float, share: float = 1.0) -> None:
        """Raise the damping by this share of the full rate."""
        self.damping = min(DAMPING, self.damping + DAMPING_RATE * share * dt)

    def _step_damping(self, dt: float, excess: float) -> None:
        if self._is_rising:
            self._raise_damping(dt)
            self._is_rising = self.damping < DAMPING
        elif excess:
            self._raise_damping(dt, min(1.0, excess / self._speed))
        elif self.effort == 0.0:
            self.damping *= math.exp(-dt / DESCENT.damping_fade)
            if self.damping < DESCENT.min_damping:
                self.damping = 0.0


class ArmDescent:
    """The joints of an arm on their way down, from `effort` (n,) Nm and `damping` (n,) Nm s/rad.

    max_effort: (n,) Nm, which the torque of a joint exceeds only where `effort` does.
    """

    def __init__(
        self, now: float, effort: Sequence[float], damping: Sequence[float], max_effort: Sequence[float]
    ) -> None:
        self._joints = tuple(JointDescent(*joint) for joint in zip(effort, damping, max_effort, strict=True))
        self._silent: Sequence[bool] = (False,) * len(self._joints)
        self._start = now
        self._held = now  # when something last held the arm, s

    @property
    def applied(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Torque (n,) in Nm and damping (n,) in Nm s/rad to apply now."""
        return tuple(joint.effort for joint in self._joints), tuple(joint.damping for joint in self._joints)

    def step(
        self, now: float, dt: float, samples: Sequence[JointSample], silent: Sequence[bool], unsent: Sequence[bool]
    ) -> None:
        """Advance by `dt` s to `now` (s) with the newest readings.

        silent: (n,) whether the joint's motor does not reply.
        unsent: (n,) whether its last command did not leave: it holds what it had.
        """
        columns = zip(self._joints, samples, silent, self._silent, unsent, strict=True)
        for joint, sample, is_silent, was_silent, is_unsent in columns:
            expected = expected_torque(joint.effort, joint.damping, sample.velocity)
            is_obeying = excess_torque(sample.effort, expected) <= 0.0
            if was_silent and not is_silent and not is_obeying:
                joint.resume(sample.effort, sample.velocity)
            elif is_silent:
                joint.step_blind(0.0 if is_unsent else dt)
            else:
                joint.step(dt, sample.velocity)
        self._silent = tuple(silent)
        if not all(joint.is_down for joint, is_silent in zip(self._joints, silent, strict=True) if not is_silent):
            self._held = now

    def rejoin(self, i: int) -> None:
        """Continue joint `i` without torque, under full damping: its motor was found off, and is switched on again."""
        self._joints[i].restart(0.0, DAMPING)

    def is_down(self, now: float, rest_since: float) -> bool:
        """Return whether the arm is down at `now` (s), as far as its motors reply; at rest since `rest_since` (s)."""
        free = now - self._held
        is_at_rest = min(free, now - rest_since) >= DESCENT.rest_time
        is_down = is_at_rest or free >= DESCENT.longest_rest
        return is_down and (not any(self._silent) or now - self._start >= DESCENT.longest_silence)
