"""Changes of load as guided motions, a load that leaves the hand, and a last fade; for any number of joints.

A change of law, mode, masses, gain, `max_effort` or terms, and the end of a weighing, is a guided motion
(core/safety/guidance.py) from what the loads before it would need in this pose to what the new one needs.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from exo_gravity.core.arm.gravity import Torque
from exo_gravity.core.safety.guidance import GUIDANCE, GuidedMotion

CAUSE_TIME = 5.0  # s within which a change of load may be the cause of a fault or a motion
LAST_FADE = 2.0  # s; a launcher kills a node 5 s after it asked it to end
# Nm between the old torque and the new one; less is slow enough without damping, which a wearer who moves would feel
LARGE = 1.0
MOST_LOADS = 4  # that a change remembers: a slider makes many, of which the oldest have little left


@dataclass(frozen=True)
class DropLimits:
    """By what a load that leaves the hand shows."""

    rise: float = 0.25  #: m/s that the hand gains over its own low-passed speed: 8 m/s^2 for a moment,
    low_pass: float = 0.03  #: s, time constant of that
    speed: float = 0.8  #: m/s upwards, however slowly it was gained: a light load
    readings: int = 2  #: in a row that must show it: one may be wrong
    least_mass: float = 0.1  #: kg; less throws no arm
    least_carried: float = 0.5  #: of the load's torque, that motors must apply to carry it


DROP = DropLimits()


class DropWatch:
    """Whether a load that the motors carry has left the hand: its torque then throws the arm upwards.

    A person who lifts as fast loses the support for the load, and nothing else.
    """

    def __init__(self) -> None:
        self._slow = 0.0  # m/s
        self._shown = 0  # readings in a row

    def step(self, dt: float, speed: float, mass: float) -> bool:
        """Return whether the load of `mass` kg was dropped; speed: m/s of the hand, upwards, `dt` s after the last."""
        self._slow += min(1.0, dt / DROP.low_pass) * (speed - self._slow)
        is_sudden = speed > 0.0 and speed - self._slow > DROP.rise
        is_shown = mass > DROP.least_mass and (speed > DROP.speed or is_sudden)
        self._shown = self._shown + 1 if is_shown else 0
        return self._shown >= DROP.readings


Load = TypeVar("Load")


class GuidedChange(Generic[Load]):
    """The way of `count` joints to the present load from those before it.

    What a joint has at the begin of a change is a weighted mean of what its last loads need, since a change may follow
    another before that is done. The weights stay, and the loads follow the arm into other poses. A constant, the
    offset, is only what they do not explain: the torque of a weighing, of a law that does not apply here, and of loads
    that are forgotten.

    remainder: (n,) Nm that the torque still has to go.
    """

    def __init__(self, count: int) -> None:
        self._zeros: Torque = (0.0,) * count
        self._motion = GuidedMotion(count)
        self.stop()

    def stop(self) -> None:
        """Forget the change: the next torque is the new load's."""
        self._loads: list[tuple[Load, Torque]] = []  # and their weights (n,)
        self._offset = self.remainder = self._zeros
        self._largest = 0.0  # Nm between the old torque and the new one in this pose
        self._motion.stop()

    @property
    def is_over(self) -> bool:
        """Whether no change is under way."""
        return self._motion.is_over

    @property
    def is_large(self) -> bool:
        """Whether the motors are to damp the joints meanwhile."""
        return not self.is_over and self._largest > LARGE

    def begin(self, carried: Load | None, torque: Torque, needs: Callable[[Load], Torque], after: Torque) -> None:
        """Begin at the present `torque` the way to `after`, both (n,) Nm in this pose.

        carried: what was the new load until now; None where it explains nothing.
        needs: returns the torque (n,) in Nm that a load needs in this pose.
        """
        shares = self._motion.shares
        loads = [(load, _product(weight, shares)) for load, weight in self._loads]
        if carried is not None:
            weights = [weight for _, weight in loads]
            loads.append((carried, tuple([1.0 - sum(each) for each in zip(self._zeros, *weights, strict=True)])))
        loads = sorted(loads, key=lambda each: max(each[1]))[-MOST_LOADS:]
        torques = [torque, *(needs(load) for load, weight in loads if any(weight))]
        if all(abs(old - new) < GUIDANCE.small for each in torques for old, new in zip(each, after, strict=True)):
            self.stop()
            return
        self._loads, self._offset = loads, self._zeros
        explained = self._before(needs, after)
        self._offset = tuple([now - old for now, old in zip(torque, explained, strict=True)])
        self._motion.begin()

    def step(
        self, dt: float, velocity: Sequence[float] | None, needs: Callable[[Load], Torque], after: Torque
    ) -> Torque:
        """Return the torque (n,) in Nm after `dt` s more.

        velocity: (n,) rad/s, None if not known.
        needs, after: as in `begin`, in the present pose.
        """
        before = self._before(needs, after)
        torque = self._motion.step(dt, velocity, before, after)
        self._largest = max([abs(old - new) for old, new in zip(before, after, strict=True)])
        self.remainder = tuple([now - new for now, new in zip(torque, after, strict=True)])
        return torque

    def _before(self, needs: Callable[[Load], Torque], after: Torque) -> Torque:
        """Return the torque (n,) in Nm that the loads before would have here; where they weigh nothing, `after`."""
        before = [new + offset for new, offset in zip(after, self._offset, strict=True)]
        for load, weight in self._loads:
            columns = zip(before, weight, needs(load), after, strict=True)
            before = [torque + share * (old - new) for torque, share, old, new in columns]
        return tuple(before)


def _product(a: Sequence[float], b: Sequence[float]) -> Torque:
    return tuple([x * y for x, y in zip(a, b, strict=True)])


def limited(wanted: float, last: float, step: float) -> float:
    """Return `wanted` within `step` of `last`."""
    return max(last - step, min(last + step, wanted))


class CommandFade:
    """Effort commands for an effort controller of ros2_control, which keeps its last command for ever.

    So the sender lets the arm down: `timeout` s after the last sound effort, or when efforts are withdrawn, the torque
    fades linearly to zero in LAST_FADE. The fault is latched: zeros follow until an operator clears it, because an arm
    that was let down must not rise by itself. The next torque begins as a guided motion.
    """

    def __init__(self, timeout: float) -> None:
        self.state = "waiting"  #: nothing was sent yet; 'active', 'fading' towards zero, or 'zero', which is latched
        self.reason = ""  #: what began the fade
        self._timeout = timeout
        self._effort: tuple[float, ...] = ()
        self._time = -math.inf  # s, of the last effort; then of the begin of the fade
        self._held: tuple[float, ...] = ()  # what the joints applied before the first effort
        self._motion = GuidedMotion(0)  # from there

    @property
    def problem(self) -> str:
        """Why efforts are not passed on; '' if they are."""
        is_open = self.state in ("waiting", "active")
        return "" if is_open else f"{self.reason}: {self.state}, call clear_fault"

    def take(
        self, now: float, effort: Sequence[float], applied: Sequence[float], velocity: Sequence[float] | None
    ) -> tuple[float, ...] | None:
        """Return the efforts to send for `effort` (n,) Nm, computed at `now` s; None if none may be sent.

        applied: (n,) Nm that the joints apply; only that before the first effort matters.
        velocity: (n,) rad/s, None if not known.
        """
        if self.problem:
            return None
        if self.state == "waiting":
            self.state, self._held, self._time = "active", tuple(applied), now
            self._motion = GuidedMotion(len(effort))
            self._motion.begin()
        dt, self._time = now - self._time, now
        self._effort = self._motion.step(dt, velocity, self._held, effort)
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
        left = 1.0 - (now - self._time) / LAST_FADE
        if left <= 0.0:
            self.state = "zero"
        return tuple(max(0.0, min(1.0, left)) * effort for effort in self._effort)

    def clear(self) -> bool:
        """Pass efforts on again. Return False, and do nothing, unless the torque has faded to zero."""
        if self.state != "zero":
            return False
        self.state, self.reason = "waiting", ""
        return True
