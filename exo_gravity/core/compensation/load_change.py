# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Changes of load as guided motions, a load that leaves the hand, and a last fade; for any number of joints.

A change of law, mode, masses, gain, `max_effort` or terms, and the end of a weighing, is a guided motion
(core/safety/guidance.py) from what the loads before it would need in this pose to what the new one needs.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from exo_gravity.core.numbers import Torque
from exo_gravity.core.safety.guidance import GUIDANCE, GuidedMotion

CAUSE_TIME = 5.0  # s within which a change of load may be the cause of a fault or a motion
# s without an answer, after which nothing is left to change from. This is longer than any command_timeout: the arm is
# already being let down.
PAUSE = 0.2
LAST_FADE = 2.0  # s; a launcher kills a node 5 s after it asked it to end
# Nm between the old torque and the new one; less is slow enough without damping, which a wearer who moves would feel
LARGE = 1.0


@dataclass(frozen=True)
class DropLimits:
    """By what a load that leaves the hand shows."""

    rise: float = 0.25  #: m/s that the hand gains over its own low-passed speed: 8 m/s^2 for a moment,
    low_pass: float = 0.03  #: s, time constant of that
    speed: float = 0.8  #: m/s upwards, however slowly it was gained: a light load
    least_mass: float = 0.1  #: kg; less throws no arm
    least_carried: float = 0.5  #: of the load's torque, that motors must apply to carry it


DROP = DropLimits()


class DropWatch:
    """Whether a load that the motors carry has left the hand: its torque then throws the arm upwards.

    Two readings in a row must show it, since one may be wrong. A person who lifts as fast loses the support for the
    load, and nothing else.
    """

    def __init__(self) -> None:
        self._last = self._slow = 0.0  # m/s

    def step(self, dt: float, speed: float, mass: float) -> bool:
        """Return whether the load of `mass` kg was dropped; speed: m/s of the hand, upwards, `dt` s after the last."""
        self._last, speed = speed, min(self._last, speed)
        self._slow += min(1.0, dt / DROP.low_pass) * (speed - self._slow)
        is_sudden = speed > 0.0 and speed - self._slow > DROP.rise
        return mass > DROP.least_mass and (speed > DROP.speed or is_sudden)


@dataclass(frozen=True)
class TouchLimits:
    """When nothing counts as touching the robot."""

    bandwidth: float = 80.0  #: rad/s, of the momentum observer
    period: float = 0.0075  #: s from one look to the next, at least: a look takes 0.1 ms
    heavy: float = 0.8  #: Nm beyond the robot's weight, from which on a joint tells,
    joints: int = 2  #: and so many must: one alone is free where a wearer begins to lift the arm
    share: float = 0.3  #: of that,
    least: float = 0.2  #: and Nm, which friction and model errors may amount to
    time: float = 0.1  #: s for which no joint is touched; 0.05 is the longest of 500 reaches and other motions
    slow: float = 1.0  #: rad/s, below which no brake acts, so that the motors should apply what is asked of them
    #: s, the same where the motors did not when the arm was last slower: the brake may cancel the torque for a moment
    #: while a hand lifts the arm
    fast: float = 0.25


TOUCH = TouchLimits()


class TouchWatch:
    """Whether nothing touches the robot although its motors carry more than itself: the arm has left the cuff.

    A person's arm presses on the robot by what the motors carry of it, less what moves it. A momentum observer (De Luca
    et al., IROS 2006) tells from the motors' torque and the motion what presses on each joint. People who reach, wave
    or push free all joints at once for a moment at most; an empty robot is free for ever.

    time: s, of the last look.
    """

    def __init__(self) -> None:
        self.time = -math.inf
        self._is_applied = False  # whether the motors apply what is asked of them, but for the brake
        self._free_for = 0.0  # s
        # (n,): what touches the robot, and what else changes its momentum, in Nm; and that momentum, kg m^2/s
        self._touch = self._known = self._momentum = np.zeros(0)

    def step(
        self,
        now: float,
        speed: float,
        momentum: np.ndarray,
        known: np.ndarray,
        carried: np.ndarray,
        lacking: np.ndarray,
    ) -> bool:
        """Return whether nothing touches the robot at `now` s.

        speed: rad/s of the fastest joint. momentum: of the robot, (n,) kg m^2/s.
        known: (n,) Nm, by which the motors, the robot's weight and its motion change the momentum.
        carried: (n,) Nm, what is asked of the motors beyond the robot's weight.
        lacking: (n,) Nm, what is asked of them and not applied.
        """
        dt = now - self.time
        if dt <= PAUSE:
            pressing = (momentum - self._momentum) / dt - self._known
            self._touch = self._touch + min(1.0, TOUCH.bandwidth * dt) * (pressing - self._touch)
        else:
            dt, self._touch, self._is_applied, self._free_for = 0.0, -carried, False, 0.0
        self.time, self._known, self._momentum = now, known, momentum
        allowed = TOUCH.share * np.abs(carried) + TOUCH.least
        is_loaded = np.sum(np.abs(carried) >= TOUCH.heavy) >= TOUCH.joints
        is_applied = bool(is_loaded and np.all(np.abs(lacking) <= allowed))
        if speed <= (TOUCH.slow if is_applied else GUIDANCE.calm):
            self._is_applied = is_applied
        is_free = is_loaded and (self._is_applied or speed > TOUCH.slow) and np.all(np.abs(self._touch) <= allowed)
        dt = min(dt, TOUCH.time / 3.0)  # three looks at least
        self._free_for = max(0.0, self._free_for + (dt if is_free else -0.5 * dt))  # noise is no touch
        return self._free_for >= (TOUCH.time if self._is_applied else TOUCH.fast)


Load = TypeVar("Load")
Needs = Callable[[Load], Torque]  # returns the torque (n,) in Nm that a load needs in the present pose


class GuidedChange(GuidedMotion, Generic[Load]):
    """The way of each of `count` joints to the new load from one before it.

    A change may follow another before that is done. What a joint has then lies between two loads, so it is on the way
    to the new one from at least one of them, and follows the arm into other poses with both. Of several, it takes the
    longest way, which leaves most to go back. A constant, the offset, is only what no load explains: the torque of a
    weighing, or of a law that does not apply here.

    remainder: (n,) Nm that the torque still has to go.
    """

    def stop(self) -> None:
        """Forget the change: the next torque is the new load's."""
        super().stop()
        self._origins: list[Load | None] = [None] * len(self.shares)  # None where the new load is the origin, too
        self._offset = self.remainder = self._zeros = (0.0,) * len(self.shares)
        self._largest = 0.0  # Nm between the old torque and the new one in this pose

    @property
    def is_large(self) -> bool:
        """Whether the motors are to damp the joints meanwhile."""
        return not self.is_over and self._largest > LARGE

    def set_out(self, carried: Sequence[Load | None], torque: Torque, needs: Needs[Load], after: Torque) -> None:
        """Begin at the present `torque` the way to `after`, both (n,) Nm in this pose.

        carried: what may have been the new load until now; None where it explains nothing.
        """
        starts = [([load] * len(after), self._zeros) for load in carried]
        if not self.is_over:
            starts.append((self._origins, self._offset))
        ways = [zip(*start, _torques(*start, needs, after), strict=True) for start in starts]
        joints = [_longest(now, new, each) for now, new, *each in zip(torque, after, *ways, strict=True)]
        befores = (torque, *(_torques(*start, needs, after) for start in starts))
        if all(abs(old - new) < GUIDANCE.small for each in befores for old, new in zip(each, after, strict=True)):
            self.stop()
            return
        origins, self._offset, shares = zip(*joints, strict=True)
        self._origins = list(origins)
        self.begin(shares)

    def held(self, load: Load, needs: Needs[Load]) -> Torque:
        """Return the torque (n,) in Nm at the present shares of the way to `load`, in the pose of `needs`."""
        after = needs(load)
        return self.between(_torques(self._origins, self._offset, needs, after), after)

    def follow(self, dt: float, velocity: Sequence[float] | None, needs: Needs[Load], after: Torque) -> Torque:
        """Return the torque (n,) in Nm after `dt` s more.

        velocity: (n,) rad/s, None if not known.
        needs, after: as in `set_out`, in the present pose.
        """
        before = _torques(self._origins, self._offset, needs, after)
        torque = self.step(dt, velocity, before, after)
        self._largest = max([abs(old - new) for old, new in zip(before, after, strict=True)])
        self.remainder = tuple([now - new for now, new in zip(torque, after, strict=True)])
        return torque


def _torques(loads: Sequence[Load | None], offset: Torque, needs: Needs[Load], after: Torque) -> Torque:
    """Return the torque (n,) in Nm that each joint's load would need here, `after` for None, and its offset."""
    needed = {id(load): needs(load) if load else after for load in loads}
    return tuple([needed[id(load)][n] + more for n, (load, more) in enumerate(zip(loads, offset, strict=True))])


def _longest(now: float, new: float, ways: Iterable[tuple[Load, float, float]]) -> tuple[Load, float, float]:
    """Return origin, offset in Nm and share of the longest way from one of `ways` to `new` on which `now` lies.

    If it lies on none, the share is 1 and the offset makes up for what is missing.

    ways: origin, offset and torque of each, in Nm.
    """
    found = []
    for origin, offset, old in ways:
        length = abs(old - new)
        share = (now - new) / (old - new) if length > GUIDANCE.small else math.inf
        if 0.0 <= share <= 1.0:
            found.append((length, origin, offset, share))
        else:
            found.append((-abs(now - old), origin, offset + now - old, 1.0))
    return max(found, key=lambda each: each[0])[1:]


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
            self._motion.begin((1.0,) * len(effort))
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
