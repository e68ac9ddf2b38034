"""The virtual wearer: performs a trial script on the simulated arm, as a person would who reads it from a screen.

Move: a hand leads the joints along minimum-jerk paths (Flash and Hogan 1985) to the pose, holds them there for the last
quarter of the time, and lets go. The hand is a spring, a damper and an integrator that takes over the arm's weight, all
limited to the strength of a hand. Hold: no torque. Push: half a sine wave of the scripted torques.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.model.gravity import NO_TORQUE, Torque
from exo_gravity.core.numbers import JOINT_COUNT, four_floats, one_float
from exo_gravity.core.trial.script import TrialScript

Path = list[tuple[float, float]]  # of each joint: position in rad, velocity in rad/s
_MOVING = 0.75  # share of a move's duration in which the hand moves; then it holds the arm still


@dataclass(frozen=True)
class Hand:
    """The hand's compliance per joint (4,), and its strength.

    stiffness Nm/rad, damping Nm s/rad: of the order of a human arm's; least damping where the arm is lightest.
    integral: Nm/(rad s). max_torque: Nm on any joint; an adult's arm and the robot, stretched out, need 15 to 20 Nm.
    """

    stiffness: Sequence[float] = (60.0, 80.0, 60.0, 30.0)
    damping: Sequence[float] = (3.0, 6.0, 5.0, 2.0)
    integral: Sequence[float] = (120.0, 160.0, 150.0, 80.0)
    max_torque: float = 25.0

    def __post_init__(self) -> None:
        for name, high, unit in (("stiffness", 500.0, "Nm/rad"), ("damping", 20.0, "Nm s/rad"), ("integral", 1e3, "")):
            object.__setattr__(self, name, tuple(four_floats(name, getattr(self, name), 0.0, high, unit).tolist()))
        one_float("max_torque", self.max_torque, 0.0, 100.0, "Nm")


class VirtualWearer:
    """Performs `script` once. step: index of the current step, None before the first, len(steps) after the last."""

    def __init__(self, script: TrialScript, hand: Hand | None = None) -> None:
        self.script = script
        self.hand = hand or Hand()
        self.step: int | None = None
        self._elapsed = 0.0
        self._start: Sequence[float] = (0.0,) * JOINT_COUNT
        self._weight = [0.0] * JOINT_COUNT

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm on the joints, `elapsed` s after the start of the script.

        theta, velocity: (4,) rad and rad/s. Call it with increasing times: the hand remembers where it took hold and
        how much weight it has taken over. The torque is zero before the start (elapsed < 0) and after the end.
        """
        if elapsed < 0:
            return NO_TORQUE
        index, since = self.script.at(elapsed)
        if index != self.step:
            self.step = index
            self._start = theta
            self._weight = [0.0] * JOINT_COUNT
        period, self._elapsed = elapsed - self._elapsed, elapsed
        if index == len(self.script.steps):
            return NO_TORQUE
        step = self.script.steps[index]
        if step.action == "move":
            path = minimum_jerk(self._start, step.value, since, _MOVING * step.duration)
            return self._lead(path, theta, velocity, period)
        if step.action == "push":
            share = math.sin(math.pi * since / step.duration)
            return tuple(share * torque for torque in step.value)
        return NO_TORQUE

    def idle(self, elapsed: float, duration: float) -> bool:
        """Return whether the wearer applies no torque for `duration` s from `elapsed` s after the start."""
        index, since = self.script.at(elapsed)
        if elapsed < 0.0 or index == len(self.script.steps):
            return elapsed + duration <= 0.0 or elapsed >= 0.0
        step = self.script.steps[index]
        return index == self.step and step.action == "hold" and since + duration <= step.duration

    def _lead(self, path: Path, theta: Sequence[float], velocity: Sequence[float], period: float) -> Torque:
        """Return the torque of a hand that leads the joints along `path`; period: s since the last call."""
        hand, limit = self.hand, self.hand.max_torque
        torque = []
        for n, (position, speed) in enumerate(path):
            error = position - theta[n]
            self._weight[n] = _clamp(self._weight[n] + hand.integral[n] * error * period, limit)
            pull = hand.stiffness[n] * error + hand.damping[n] * (speed - velocity[n]) + self._weight[n]
            torque.append(_clamp(pull, limit))
        return tuple(torque)


def minimum_jerk(start: Sequence[float], end: Sequence[float], since: float, duration: float) -> Path:
    """Return position and velocity of each joint `since` s into a minimum-jerk move from `start` to `end`."""
    s = min(1.0, since / duration)
    way = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    pace = 30.0 * s * s * (1.0 - s) ** 2 / duration
    return [(a + way * (b - a), pace * (b - a)) for a, b in zip(start, end, strict=True)]


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
