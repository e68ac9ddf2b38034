# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The virtual wearer: performs a trial script on the simulated arm, as a person would who reads it from a screen.

Move: a hand leads the joints along minimum-jerk paths (Flash and Hogan 1985) to the pose, holds them there for the last
quarter of the time, and lets go. The hand is a spring, a damper and an integrator that takes over the arm's weight, all
limited to the strength of a hand. Hold: no torque. Push: half a sine wave of the scripted torques.
"""

import math
from collections.abc import Sequence

from exo_gravity.core.numbers import Torque, clamp, for_joints
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.trunk_motion import minimum_jerk

# The hand's compliance in Nm/rad, Nm s/rad and Nm/(rad s): of the order of a human arm's; least damping where the arm
# is lightest. Of the paper's arm; the least of each for another one.
STIFFNESS, DAMPING, INTEGRAL = (60.0, 80.0, 60.0, 30.0), (3.0, 6.0, 5.0, 2.0), (120.0, 160.0, 150.0, 80.0)
STRENGTH = 25.0  # Nm on any joint; an adult's arm and the robot, stretched out, need 15 to 20 Nm
MOVING = 0.75  # share of a move's duration in which the hand moves; then it holds the arm still

Path = list[tuple[float, float]]  # of each joint: position in rad, velocity in rad/s


class VirtualWearer:
    """Performs `script` once, with at most `strength` Nm on any joint.

    step: index of the current step, None before the first, len(steps) after the last.
    """

    def __init__(self, script: TrialScript, strength: float = STRENGTH) -> None:
        self.script = script
        self.strength = strength
        self.step: int | None = None
        self._elapsed = 0.0
        self._start: Sequence[float] = ()
        self._weight: list[float] = []

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (n,) in Nm on the joints, `elapsed` s after the start of the script.

        theta, velocity: (n,) rad and rad/s. Call it with increasing times: the hand remembers where it took hold and
        how much weight it has taken over. The torque is zero before the start (elapsed < 0) and after the end.
        """
        nothing = (0.0,) * len(theta)
        if elapsed < 0:
            return nothing
        index, since = self.script.at(elapsed)
        if index != self.step:
            self.step = index
            self._start = theta
            self._weight = [0.0] * len(theta)
        period, self._elapsed = elapsed - self._elapsed, elapsed
        if index == len(self.script.steps):
            return nothing
        step = self.script.steps[index]
        if step.action == "move":
            path = path_between(self._start, step.value, since, MOVING * step.duration)
            return self.lead(path, theta, velocity, period)
        if step.action == "push":
            share = math.sin(math.pi * since / step.duration)
            return tuple(share * torque for torque in step.value)
        return nothing

    def idle(self, elapsed: float, duration: float) -> bool:
        """Return whether the wearer applies no torque for `duration` s from `elapsed` s after the start."""
        index, since = self.script.at(elapsed)
        if elapsed < 0.0 or index == len(self.script.steps):
            return elapsed + duration <= 0.0 or elapsed >= 0.0
        step = self.script.steps[index]
        return index == self.step and step.action == "hold" and since + duration <= step.duration

    def lead(self, path: Path, theta: Sequence[float], velocity: Sequence[float], period: float) -> Torque:
        """Return the torque (n,) in Nm of a hand that leads the joints along `path`; period: s since the last call."""
        torque, limit = [], self.strength
        self._weight = self._weight or [0.0] * len(path)
        compliance = (for_joints(tuning, len(path)) for tuning in (STIFFNESS, DAMPING, INTEGRAL))
        for n, ((position, speed), *hand) in enumerate(zip(path, *compliance, strict=True)):
            stiffness, damping, integral = hand
            error = position - theta[n]
            self._weight[n] = clamp(self._weight[n] + integral * error * period, limit)
            pull = stiffness * error + damping * (speed - velocity[n]) + self._weight[n]
            torque.append(clamp(pull, limit))
        return tuple(torque)


def path_between(start: Sequence[float], end: Sequence[float], since: float, duration: float) -> Path:
    """Return where the joints are `since` s into a minimum-jerk move from `start` to `end`, (n,) rad, in `duration`."""
    way, pace, _ = minimum_jerk(since / duration)
    return [(a + way * (b - a), pace / duration * (b - a)) for a, b in zip(start, end, strict=True)]
