"""The virtual wearer: carries out a script on the simulated arm, as a person would who reads it from a screen.

Move: a hand leads the joints along minimum-jerk paths (Flash and Hogan 1985) to the pose, holds them there for the last
quarter of the time, and lets go at once. It is a spring and damper, with an integral that takes over whatever weight
the arm has, and no more torque than a hand gives. Hold: nothing. Push: half a sine of the torques asked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.arm import JOINT_COUNT, four_floats, one_float
from exo_gravity.core.trial_script import TrialScript

Torque = tuple[float, ...]
_NOTHING: Torque = (0.0,) * JOINT_COUNT
_MOVING = 0.75  # share of a move's time under way; the rest the hand holds still


@dataclass(frozen=True)
class Hand:
    """The hand's compliance, (4,) each, and its strength.

    stiffness Nm/rad, damping Nm s/rad: of the order of a human arm's own; least damping where the arm is lightest.
    integral Nm/(rad s). max_torque: Nm on any joint; an adult's arm and the robot, stretched out, weigh 15 to 20.
    """

    stiffness: Sequence[float] = (60.0, 80.0, 60.0, 30.0)
    damping: Sequence[float] = (3.0, 6.0, 5.0, 2.0)
    integral: Sequence[float] = (120.0, 160.0, 150.0, 80.0)
    max_torque: float = 25.0

    def __post_init__(self):
        for name, high, unit in (("stiffness", 500.0, "Nm/rad"), ("damping", 20.0, "Nm s/rad"), ("integral", 1e3, "")):
            object.__setattr__(self, name, tuple(four_floats(name, getattr(self, name), 0.0, high, unit).tolist()))
        one_float("max_torque", self.max_torque, 0.0, 100.0, "Nm")


class VirtualWearer:
    """Carries out `script` once. `step` is the index of the step under way: None before, len(steps) after."""

    def __init__(self, script: TrialScript, hand: Hand | None = None):
        self.script = script
        self.hand = hand or Hand()
        self.step: int | None = None
        self._elapsed = 0.0
        self._start: Sequence[float] = _NOTHING
        self._carried = [0.0] * JOINT_COUNT

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm on the joints, `elapsed` s after the start of the script.

        theta, velocity: (4,) rad and rad/s. Call it with time going on: the hand remembers where it took hold and how
        much weight it has taken over. Before the start (elapsed < 0) and after the end the wearer does nothing.
        """
        if elapsed < 0:
            return _NOTHING
        index, since = self.script.at(elapsed)
        if index != self.step:
            self.step = index
            self._start = theta
            self._carried = [0.0] * JOINT_COUNT
        period, self._elapsed = elapsed - self._elapsed, elapsed
        if index == len(self.script.steps):
            return _NOTHING
        step = self.script.steps[index]
        if step.action == "move":
            path = _minimum_jerk(self._start, step.value, since, _MOVING * step.duration)
            return self._lead(path, theta, velocity, period)
        if step.action == "push":
            share = math.sin(math.pi * since / step.duration)
            return tuple(share * torque for torque in step.value)
        return _NOTHING

    def idle(self, elapsed: float, duration: float) -> bool:
        """Return whether the wearer does nothing from `elapsed` s after the start for `duration` s."""
        index, since = self.script.at(elapsed)
        if elapsed < 0.0 or index == len(self.script.steps):
            return elapsed + duration <= 0.0 or elapsed >= 0.0
        step = self.script.steps[index]
        return index == self.step and step.action == "hold" and since + duration <= step.duration

    def _lead(self, path, theta, velocity, period: float) -> Torque:
        """Return the torque of a hand that holds the joints on `path`: (position, velocity) for each."""
        hand, limit = self.hand, self.hand.max_torque
        torque = []
        for n, (position, speed) in enumerate(path):
            error = position - theta[n]
            self._carried[n] = _within(self._carried[n] + hand.integral[n] * error * period, limit)
            pull = hand.stiffness[n] * error + hand.damping[n] * (speed - velocity[n]) + self._carried[n]
            torque.append(_within(pull, limit))
        return tuple(torque)


def _minimum_jerk(start, end, since: float, duration: float) -> list[tuple[float, float]]:
    """Return position and velocity of each joint on its way from `start` to `end`, at rest at both."""
    s = min(1.0, since / duration)
    way = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    pace = 30.0 * s * s * (1.0 - s) ** 2 / duration
    return [(a + way * (b - a), pace * (b - a)) for a, b in zip(start, end, strict=True)]


def _within(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
