"""The way down: lowers an arm at a bounded speed until nothing holds it, so that switching its motors off is safe.

Each joint has a torque s, which starts as the last one applied, and a damping k, which the motor itself applies. With v
the joint's velocity and V the permitted speed:

    |v| <= V:             s fades to zero within FADE_TIME, the part that has grown as fast as it grew; then k, too
    s v > 0:              the motor drives the joint, or the wearer lifts it: s goes to zero, and never beyond
    |v| > V, sinking:     s grows against the motion, and k grows
    |v| > V, otherwise:   k grows

A joint sinks when it moves against the torque that it carried when the descent began: that torque shows which way
gravity pulls. So the brake only takes energy out of the arm, and a wearer who lifts it meets damping alone. The brake
returns at once to what the joint carried, which balanced gravity. Beyond that it grows slowly: gravity changes slowly,
a wearer who pushes does not. It never exceeds `max_effort`, or what the joint carried if that was more.

No model of the arm is needed: masses, tilt and friction may be anything. Where gravity comes to pull the other way, k
alone holds: an arm of 3.7 Nm then sinks at 0.74 rad/s. V halves whenever the joint swings back, so that a frictionless
arm comes to rest, and recovers slowly. A joint is down when s is zero and k holds nothing: it hangs, or lies on
something.

A motor that cannot be reached keeps applying its torque, so s and k of a silent joint are held. When it replies again,
and has received these, they go on; else s continues from the torque that it reports.
"""

import math
from collections.abc import Sequence

from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.delivery import ABSOLUTE, RELATIVE
from exo_gravity.core.safety.limits import DAMPING, MAX_EFFORT_RATE

REST_TIME = 2.0  # s at rest with nothing holding the arm, until it is down
LONGEST_REST = 7.5  # s with nothing holding the arm, after which it is down even if the wearer moves it
DESCENT_TIMEOUT = 40.0  # s for a bridge to let its arm down before its launcher kills it
LONGEST_SILENCE = 5.0  # s for which the way down waits for a silent motor

SETTLING_TIME = 0.5  # s

DESCENT_SPEED = 0.35  # rad/s; a horizontal arm is down within 10 s
MIN_SPEED = 0.04  # rad/s; two codes of the velocity
SPEED_RECOVERY = 5.0  # s, time constant
SWING_SPEED = 0.05  # rad/s; slower motion has no direction
DRIVEN_SPEED = 0.1  # rad/s; a torque must not drive its joint faster. Four codes of the velocity
# At 100 Hz and with a velocity filtered over 20 ms, twice these gains make an arm of 75 kg oscillate.
BRAKE_GAIN = 40.0  # Nm/rad, up to what the joint carried
RELEASE_GAIN = 60.0  # Nm/rad
BRAKE_GROWTH = 3.0  # Nm/s beyond it: gravity of an arm of 75 kg changes no faster while it sinks
MIN_FADE_RATE = 0.5  # Nm/s
FADE_TIME = 2.0  # s from full torque to none: the wearer has time to take over his arm
DAMPING_RISE = 0.2  # s to DAMPING, less of which lets a joint swing longer; a rise at once would be a torque step
DAMPING_FADE = 0.4  # s, time constant
MIN_DAMPING = 0.01  # Nm s/rad; smaller values become zero
FREE_DAMPING = 0.2  # Nm s/rad that holds no joint: 0.07 Nm at DESCENT_SPEED. A swing without friction keeps so much


class JointDescent:
    """One joint on its way down: `effort` in Nm and `damping` in Nm s/rad are to be applied now.

    effort, damping: what the motor applies when the descent starts; the damping first rises to DAMPING, within
    DAMPING_RISE. max_effort: Nm, which the brake exceeds only where `effort` does.
    """

    def __init__(self, effort: float, damping: float, max_effort: float) -> None:
        self._carried, self._most = 0.0, max_effort
        self._speed, self._direction = DESCENT_SPEED, 0.0
        self.restart(effort, damping)

    @property
    def is_down(self) -> bool:
        """Whether neither torque nor damping holds the joint."""
        return self.effort == 0.0 and self.damping <= FREE_DAMPING

    def restart(self, effort: float, damping: float = 0.0) -> None:
        """Continue from `effort` (Nm), which the motor is found to apply after a silence, without damping."""
        self.effort, self.damping = effort, damping
        self._carried = max(self._carried, effort, key=abs)
        self._most = max(self._most, abs(effort))
        self._fade_rate = min(MAX_EFFORT_RATE, max(MIN_FADE_RATE, abs(effort) / FADE_TIME))
        self._is_rising = True  # the damping has not yet reached DAMPING

    def step(self, dt: float, velocity: float) -> None:
        """Advance by `dt` s with the joint's `velocity` in rad/s; NaN is taken as 0."""
        if not math.isfinite(velocity):
            velocity = 0.0
        self._speed += (DESCENT_SPEED - self._speed) * dt / SPEED_RECOVERY
        if abs(velocity) > SWING_SPEED:
            if velocity * self._direction < 0.0:
                self._speed = max(MIN_SPEED, 0.5 * self._speed)
            self._direction = math.copysign(1.0, velocity)
        speed, excess = abs(velocity), max(0.0, abs(velocity) - self._speed)
        if self.effort * velocity > 0.0 and speed > DRIVEN_SPEED:
            self._approach(0.0, RELEASE_GAIN * (speed - DRIVEN_SPEED), dt)
        elif excess and self._carried * velocity < 0.0:
            if abs(self.effort) < abs(self._carried):
                self._approach(self._carried, BRAKE_GAIN * excess, dt)
            elif abs(self.effort) < self._most:
                rate = min(BRAKE_GROWTH, BRAKE_GAIN * excess)
                self._approach(math.copysign(self._most, self._carried), rate, dt)
        else:
            is_beyond = abs(self.effort) > abs(self._carried)
            self._approach(0.0, max(self._fade_rate, BRAKE_GROWTH) if is_beyond else self._fade_rate, dt)
        self._step_damping(dt, excess)

    def _approach(self, effort: float, rate: float, dt: float) -> None:
        """Bring the torque nearer to `effort` (Nm), by at most `rate` (Nm/s)."""
        most = min(MAX_EFFORT_RATE, rate) * dt
        self.effort += max(-most, min(most, effort - self.effort))

    def _step_damping(self, dt: float, excess: float) -> None:
        if self._is_rising:
            self.damping = min(DAMPING, self.damping + DAMPING / DAMPING_RISE * dt)
            self._is_rising = self.damping < DAMPING
        elif excess:
            rise = DAMPING / DAMPING_RISE * min(1.0, excess / self._speed)
            self.damping = min(DAMPING, self.damping + rise * dt)
        elif self.effort == 0.0:
            self.damping *= math.exp(-dt / DAMPING_FADE)
            if self.damping < MIN_DAMPING:
                self.damping = 0.0


class ArmDescent:
    """The four joints of an arm on their way down, from `effort` (4,) Nm and `damping` (4,) Nm s/rad.

    max_effort: (4,) Nm, which the torque of a joint exceeds only where `effort` does.
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
        """Torque (4,) in Nm and damping (4,) in Nm s/rad to apply now."""
        return tuple(joint.effort for joint in self._joints), tuple(joint.damping for joint in self._joints)

    def step(self, now: float, dt: float, samples: Sequence[JointSample], silent: Sequence[bool]) -> None:
        """Advance by `dt` s to `now` (s) with the newest readings; silent: (4,) whose motor does not reply."""
        for joint, sample, is_silent, was_silent in zip(self._joints, samples, silent, self._silent, strict=True):
            expected = joint.effort - joint.damping * sample.velocity
            is_obeying = abs(sample.effort - expected) <= ABSOLUTE + RELATIVE * abs(expected)
            if was_silent and not is_silent and not is_obeying:
                joint.restart(sample.effort)
            elif not is_silent:
                joint.step(dt, sample.velocity)
        self._silent = tuple(silent)
        if not all(joint.is_down for joint, is_silent in zip(self._joints, silent, strict=True) if not is_silent):
            self._held = now

    def is_down(self, now: float, rest_since: float) -> bool:
        """Return whether the arm is down at `now` (s), as far as its motors reply; at rest since `rest_since` (s)."""
        free = now - self._held
        is_down = free >= LONGEST_REST or (free >= REST_TIME and now - rest_since >= REST_TIME)
        return is_down and (not any(self._silent) or now - self._start >= LONGEST_SILENCE)
