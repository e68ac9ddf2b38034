"""A change of load as a guided motion: the torque moves to its new value only as fast as the joint stays calm.

A change of law, mode, masses, gain, `max_effort` or terms makes each joint's torque move from what the settings before
it would give in this pose to what the new ones give:

    torque = after + share * (before - after + offset)

The share falls from 1 to 0 within FADE_TIME or longer, more slowly the faster the joint moves where the change drives
it. Beyond GUIDE_SPEED it rises again, at SPEED_GAIN: so an arm that becomes heavy sinks at about that speed until it
hangs, and a spring that is switched on pulls no faster. The torque always lies between the old load's and the new
one's in this pose, wherever the arm has moved meanwhile: it cannot wind up, and never works on the arm more than those
two would. A wearer who holds still gets the new load within FADE_TIME; one who moves gets it when he pauses.

What the two settings do not explain, because a change follows another or a law does not apply in this pose, is the
constant offset of the start.

If a load falls out of the hand, the torque that carried it throws the arm upwards. `DropWatch` detects this from the
hand's motion. The compensator then withdraws that torque at its rate limit, and the motors brake. A person who lifts
as fast loses the support for the load, and nothing else.
"""

import math
from collections.abc import Sequence

from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.safety.limits import GUIDE_SPEED

FADE_TIME = 2.0  # s from the old load to the new one where the joint does not move,
MAX_FADE_RATE = 4.0  # Nm/s, but no faster than this,
LONGEST_FADE = 10.0  # s, of larger arms; and always where the velocity is not known
SPEED_GAIN = 20.0  # Nm/rad
WATCH = 1.0  # s after the last fade in which a joint that begins to move is still guided
LARGE = 1.0  # Nm between old and new load; less is slow enough without damping, which a wearer who moves would feel
SMALL = 0.05  # Nm; a smaller difference is nothing to guide
CAUSE_TIME = 5.0  # s within which a change of load may be the cause of a fault or a motion
DROP_RISE = 0.25  # m/s that the hand gains over its own low-passed speed: 8 m/s^2 for a moment,
DROP_TIME = 0.03  # s, time constant of that
DROP_SPEED = 0.8  # m/s upwards, however slowly it was gained: a light load
LEAST_DROP = 0.1  # kg; less throws no arm


class DropWatch:
    """Whether a load that the motors carry has left the hand."""

    def __init__(self) -> None:
        self._slow = 0.0  # m/s

    def step(self, dt: float, speed: float, mass: float) -> bool:
        """Return whether the load of `mass` kg was dropped; speed: m/s of the hand, upwards, `dt` s after the last."""
        self._slow += min(1.0, dt / DROP_TIME) * (speed - self._slow)
        return mass > LEAST_DROP and (speed > DROP_SPEED or (speed > 0.0 and speed - self._slow > DROP_RISE))


class GuidedChange:
    """The way of `count` joints from one load to another. remainder: (n,) Nm that the torque still has to go."""

    def __init__(self, count: int) -> None:
        self._nothing: Torque = (0.0,) * count
        self.stop()

    def stop(self) -> None:
        """Forget the change: the next torque is the new load's."""
        self._share, self._offset, self.remainder = self._nothing, self._nothing, self._nothing
        self._largest = 0.0  # Nm between old and new load in this pose
        self._done = WATCH  # s for which every share has been zero

    @property
    def is_over(self) -> bool:
        """Whether no change is under way."""
        return self._done >= WATCH

    @property
    def is_large(self) -> bool:
        """Whether the change is large enough for the motors to damp the joints meanwhile."""
        return not self.is_over and self._largest > LARGE

    def begin(self, torque: Torque, starts: Sequence[Torque], after: Torque) -> list[int]:
        """Begin at the present `torque` the way to `after` from one of `starts`, all (n,) Nm in this pose.

        Return for each joint the index of its start: of all, the one that leaves the smallest offset.
        """
        ways = []
        for now, new, *olds in zip(torque, after, *starts, strict=True):
            choices = []
            for index, old in enumerate(olds):
                part = (now - new) / (old - new) if abs(old - new) > SMALL else 1.0
                offset = 0.0 if 0.0 <= part < 1.0 else now - old
                choices.append((abs(offset), index, part if 0.0 <= part <= 1.0 else 1.0, offset, old))
            ways.append(min(choices))
        _, chosen, shares, offsets, before = zip(*ways, strict=True)
        if max(abs(a - b) for a, b in zip((*torque, *before), (*after, *after), strict=True)) < SMALL:
            self.stop()
        else:
            self._share, self._offset, self._done = shares, offsets, 0.0
        return list(chosen)

    def step(self, dt: float, velocity: Sequence[float] | None, before: Torque, after: Torque) -> Torque:
        """Return the torque (n,) in Nm after `dt` s more; velocity: (n,) rad/s, None if not known."""
        speeds = velocity or self._nothing
        shares, ways, remainder = [], [], []
        for share, offset, speed, old, new in zip(self._share, self._offset, speeds, before, after, strict=True):
            way = old - new + offset
            size = max(SMALL, abs(way))
            driven = -math.copysign(speed, way * speed)  # > 0 where the change drives the joint
            if driven > GUIDE_SPEED:
                share = min(1.0, share + SPEED_GAIN / size * (driven - GUIDE_SPEED) * dt)
            else:
                fastest = max(MAX_FADE_RATE / size, 1.0 / LONGEST_FADE)
                pace = min(1.0 / FADE_TIME, fastest) if velocity else 1.0 / LONGEST_FADE
                share = max(0.0, share - pace * (1.0 - max(0.0, driven) / GUIDE_SPEED) * dt)
            shares.append(share)
            ways.append(abs(way))
            remainder.append(share * way)
        self._share, self.remainder = tuple(shares), tuple(remainder)
        self._largest = max(ways)
        self._done = 0.0 if any(shares) else self._done + dt
        return tuple([new + rest for new, rest in zip(after, remainder, strict=True)])
