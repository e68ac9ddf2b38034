"""What keeps the torque from stepping, for any number of joints: ramp, rate, guided changes of load, and a last fade.

A change of law, mode, masses, gain, `max_effort` or terms is a guided motion: only as fast as the joint stays calm, its
torque moves from what the settings before it would give in this pose to what the new ones give:

    torque = after + share * (before - after + offset)

The share falls from 1 to 0 within `fade_time` or longer, more slowly the faster the joint moves where the change drives
it. Beyond GUIDE.speed it rises again, at `speed_gain`: so an arm that becomes heavy sinks at about that speed until it
hangs, and a spring that is switched on pulls no faster. The torque always lies between the old load's and the new
one's in this pose, wherever the arm has moved meanwhile: it cannot wind up. What the two settings do not explain,
because a change follows another or a law does not apply in this pose, is the constant offset of the start.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.arm.gravity import Torque
from exo_gravity.core.safety.limits import GUIDE

CAUSE_TIME = 5.0  # s within which a change of load may be the cause of a fault or a motion


@dataclass(frozen=True)
class Ramp:
    """How torque begins and ends."""

    time: float = 1.0  #: s from zero to full torque, at the start and after a pause
    #: s without an answer, after which the torque ramps in from zero. This is longer than any command_timeout: the arm
    #: is already being let down, so the restart from zero cannot drop it.
    pause: float = 0.2
    #: s that the rate limit allows for after a pause, so that the torque does not catch up in one step
    longest_step: float = 0.01
    last_fade: float = 2.0  #: s of the last fade; a launcher kills a node 5 s after it asked it to end


@dataclass(frozen=True)
class Guidance:
    """How fast a change of load is."""

    fade_time: float = 2.0  #: s from the old load to the new one where the joint does not move,
    max_rate: float = 4.0  #: Nm/s, but no faster than this,
    longest: float = 10.0  #: s, of larger arms; and always where the velocity is not known
    speed_gain: float = 20.0  #: Nm/rad, beyond GUIDE.speed
    watch: float = 1.0  #: s after the last fade in which a joint that begins to move is still guided
    #: Nm between old and new load; less is slow enough without damping, which a wearer who moves would feel
    large: float = 1.0
    small: float = 0.05  #: Nm; a smaller difference needs no guiding


@dataclass(frozen=True)
class DropLimits:
    """By what a load that leaves the hand shows."""

    rise: float = 0.25  #: m/s that the hand gains over its own low-passed speed: 8 m/s^2 for a moment,
    low_pass: float = 0.03  #: s, time constant of that
    speed: float = 0.8  #: m/s upwards, however slowly it was gained: a light load
    least_mass: float = 0.1  #: kg; less throws no arm
    least_carried: float = 0.5  #: of the load's torque, that motors must apply to carry it


RAMP, GUIDANCE, DROP = Ramp(), Guidance(), DropLimits()


def limited(wanted: float, last: float, limit: float, step: float) -> float:
    """Return `wanted` within -limit..limit and within `step` of `last`."""
    target = limit if wanted > limit else -limit if wanted < -limit else wanted
    return last + step if target > last + step else last - step if target < last - step else target


class DropWatch:
    """Whether a load that the motors carry has left the hand: its torque then throws the arm upwards.

    A person who lifts as fast loses the support for the load, and nothing else.
    """

    def __init__(self) -> None:
        self._slow = 0.0  # m/s

    def step(self, dt: float, speed: float, mass: float) -> bool:
        """Return whether the load of `mass` kg was dropped; speed: m/s of the hand, upwards, `dt` s after the last."""
        self._slow += min(1.0, dt / DROP.low_pass) * (speed - self._slow)
        is_sudden = speed > 0.0 and speed - self._slow > DROP.rise
        return mass > DROP.least_mass and (speed > DROP.speed or is_sudden)


class GuidedChange:
    """The way of `count` joints from one load to another. remainder: (n,) Nm that the torque still has to go."""

    def __init__(self, count: int) -> None:
        self._zeros: Torque = (0.0,) * count
        self.stop()

    def stop(self) -> None:
        """Forget the change: the next torque is the new load's."""
        self._share, self._offset, self.remainder = self._zeros, self._zeros, self._zeros
        self._largest = 0.0  # Nm between old and new load in this pose
        self._done = GUIDANCE.watch  # s for which every share has been zero

    @property
    def is_over(self) -> bool:
        """Whether no change is under way."""
        return self._done >= GUIDANCE.watch

    @property
    def is_large(self) -> bool:
        """Whether the change is large enough for the motors to damp the joints meanwhile."""
        return not self.is_over and self._largest > GUIDANCE.large

    def begin(self, torque: Torque, starts: Sequence[Torque], after: Torque) -> list[int]:
        """Begin at the present `torque` the way to `after` from one of `starts`, all (n,) Nm in this pose.

        Return for each joint the index of its start: of all, the one that leaves the smallest offset.
        """
        ways = []
        for now, new, *olds in zip(torque, after, *starts, strict=True):
            choices = []
            for index, old in enumerate(olds):
                part = (now - new) / (old - new) if abs(old - new) > GUIDANCE.small else 1.0
                offset = 0.0 if 0.0 <= part < 1.0 else now - old
                choices.append((abs(offset), index, part if 0.0 <= part <= 1.0 else 1.0, offset, old))
            ways.append(min(choices))
        _, chosen, shares, offsets, before = zip(*ways, strict=True)
        if max(abs(a - b) for a, b in zip((*torque, *before), (*after, *after), strict=True)) < GUIDANCE.small:
            self.stop()
        else:
            self._share, self._offset, self._done = shares, offsets, 0.0
        return list(chosen)

    def step(self, dt: float, velocity: Sequence[float] | None, before: Torque, after: Torque) -> Torque:
        """Return the torque (n,) in Nm after `dt` s more; velocity: (n,) rad/s, None if not known."""
        g, speeds = GUIDANCE, velocity or self._zeros
        shares, ways, remainder = [], [], []
        for share, offset, speed, old, new in zip(self._share, self._offset, speeds, before, after, strict=True):
            way = old - new + offset
            size = max(g.small, abs(way))
            driven = -math.copysign(speed, way * speed)  # > 0 where the change drives the joint
            if driven > GUIDE.speed:
                share = min(1.0, share + g.speed_gain / size * (driven - GUIDE.speed) * dt)
            else:
                fastest = max(g.max_rate / size, 1.0 / g.longest)
                pace = min(1.0 / g.fade_time, fastest) if velocity else 1.0 / g.longest
                share = max(0.0, share - pace * (1.0 - max(0.0, driven) / GUIDE.speed) * dt)
            shares.append(share)
            ways.append(abs(way))
            remainder.append(share * way)
        self._share, self.remainder = tuple(shares), tuple(remainder)
        self._largest = max(ways)
        self._done = 0.0 if any(shares) else self._done + dt
        return tuple([new + rest for new, rest in zip(after, remainder, strict=True)])


class CommandFade:
    """Effort commands for an effort controller of ros2_control, which keeps its last command for ever.

    So the sender lets the arm down: `timeout` s after the last sound effort, or when efforts are withdrawn, the torque
    fades linearly to zero in RAMP.last_fade. The fault is latched: zeros follow until an operator clears it, because
    an arm that was let down must not rise by itself. The next torque ramps in.
    """

    def __init__(self, timeout: float) -> None:
        self.state = "waiting"  #: nothing was sent yet; 'active', 'fading' towards zero, or 'zero', which is latched
        self.reason = ""  #: what began the fade
        self._timeout = timeout
        self._effort: tuple[float, ...] = ()
        self._time = -math.inf  # s, of the last effort; then of the begin of the fade
        self._held: tuple[float, ...] = ()  # what the joints applied before the first effort
        self._start = -math.inf  # s, of the first effort

    @property
    def problem(self) -> str:
        """Why efforts are not passed on; '' if they are."""
        is_open = self.state in ("waiting", "active")
        return "" if is_open else f"{self.reason}: {self.state}, call clear_fault"

    def take(self, now: float, effort: Sequence[float], applied: Sequence[float]) -> tuple[float, ...] | None:
        """Return the efforts to send for `effort` (n,) Nm, computed at `now` s; None if none may be sent.

        applied: (n,) Nm that the joints apply; only that before the first effort matters.
        """
        if self.problem:
            return None
        if self.state == "waiting":
            self.state, self._held, self._start = "active", tuple(applied), now
        left = max(0.0, 1.0 - (now - self._start) / RAMP.time)
        self._effort, self._time = tuple([tau + left * h for tau, h in zip(effort, self._held, strict=True)]), now
        return self._effort

    def withdraw(self, now: float, reason: str) -> None:
        """Begin the fade at `now` s, if efforts were sent."""
        if self.state == "active":
            self.state, self.reason, self._time = "fading", reason, now

    def tick(self, now: float) -> tuple[float, ...] | None:
        """Return the faded effort (n,) Nm to send at `now` s; None while sound efforts arrive, and before the first."""
        if self.state == "active" and now - self._time > self._timeout:
            self.withdraw(now, f"no joint_states younger than {1000.0 * self._timeout:.0f} ms")
        if not self.problem:
            return None
        left = 1.0 - (now - self._time) / RAMP.last_fade
        if left <= 0.0:
            self.state = "zero"
        return tuple(max(0.0, min(1.0, left)) * effort for effort in self._effort)

    def clear(self) -> bool:
        """Pass efforts on again. Return False, and do nothing, unless the torque has faded to zero."""
        if self.state != "zero":
            return False
        self.state, self.reason = "waiting", ""
        return True
