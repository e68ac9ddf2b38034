"""Controllers in place of the compensator, and what they cost the wearer: effort to move, and sag after letting go.

A PID has no input for the wearer's intention: it holds the pose in which it was switched on, and the wearer moves the
arm against it. A law alone has no ramp: the wearer holds the arm while it is switched on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.compensation.compensator import Answer
from exo_gravity.core.model.gravity import NO_TORQUE, Torque
from exo_gravity.core.motors.joint_motor import JointMotor, peaks_of
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.sim.arm import STEP
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.effort import SETTLING, EffortWearer, Task, measure, run
from exo_gravity.sim.effort_study import POSES, RATE, REACH

# Nm/rad, Nm/(rad s), Nm s/rad: as stiff as these arms bear without oscillation at RATE.
STIFFNESS, INTEGRAL, DAMPING = (20.0, 40.0, 15.0, 8.0), (20.0, 40.0, 15.0, 8.0), (0.5, 1.0, 0.4, 0.2)
RELEASED = 5.0  # s for which the arm is watched after the wearer lets go
HELD = POSES.poses[::2]
BOWED = math.radians(30.0)  # pitch of the trunk in the second hold of each pose

Law = Callable[[Sequence[float], float], Sequence[float]]  # angles (4,) in rad, the trunk's pitch in rad -> Nm (4,)


class Burden(NamedTuple):
    """effort: RMS over all joints in Nm in the reach task. sag, sag_bowed: largest motion of a joint after letting go.

    Both sags are in rad: with an upright trunk, and with one that is bowed by `BOWED`.
    """

    effort: float
    sag: float
    sag_bowed: float


@dataclass(frozen=True)
class Feedforward:
    """What a controller consists of.

    law: None for none. feedback: with a PID on each joint. pose_time: s that the law takes for one pose; until then the
    torque of an earlier pose stays.
    """

    law: Law | None
    feedback: bool
    pose_time: float = 0.0


class Controlled:
    """Runs `feedforward` with motors that give at most `most` (4,) Nm. pitch: of the trunk in rad."""

    def __init__(self, feedforward: Feedforward, most: Sequence[float], pitch: float = 0.0) -> None:
        self._parts, self._most, self._pitch = feedforward, most, pitch
        self._start: Sequence[float] | None = None
        self._sum = [0.0] * JOINT_COUNT
        self._time = self._due = -math.inf
        self._carried: Sequence[float] = NO_TORQUE

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Answer:
        """Return the torque, limited to what the motors can give."""
        if self._start is None:
            self._start, self._time = list(theta), now
        dt, self._time = now - self._time, now
        torque = list(self._feedforward(now, theta))
        if self._parts.feedback:
            speeds = velocity or NO_TORQUE
            for n, (start, angle, speed) in enumerate(zip(self._start, theta, speeds, strict=True)):
                most = self._most[n] / INTEGRAL[n]  # the integral alone never asks for more than the motor has
                self._sum[n] = max(-most, min(most, self._sum[n] + (start - angle) * dt))
                torque[n] += STIFFNESS[n] * (start - angle) + INTEGRAL[n] * self._sum[n] - DAMPING[n] * speed
        return Answer(tuple(max(-most, min(most, tau)) for tau, most in zip(torque, self._most, strict=True)))

    def _feedforward(self, now: float, theta: Sequence[float]) -> Sequence[float]:
        if self._parts.law and now >= self._due:
            self._carried = self._parts.law(theta, self._pitch)
            self._due = now + self._parts.pose_time - 0.5 * STEP
        return self._carried


class LettingGo(EffortWearer):
    """Holds a pose until the settling is over."""

    def __init__(self, pose: tuple[float, ...], length: float = RELEASED) -> None:
        super().__init__(Task("let go", (pose,), move=length, hold=0.0))

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm."""
        return super().torque(elapsed, theta, velocity) if elapsed < SETTLING else NO_TORQUE

    def idle(self, elapsed: float, duration: float) -> bool:
        """Return whether the wearer has let go."""
        return elapsed >= SETTLING


def burden(
    device: Callable[[], SimulatedDevice],
    motors: Sequence[JointMotor],
    feedforward: Feedforward,
    held: Sequence[tuple[float, ...]] = HELD,
) -> Burden:
    """Return what a controller costs the wearer. device(): a new one for each task, with an upright trunk."""
    most = peaks_of(motors)[0]

    def sag(pose: tuple[float, ...], pitch: float) -> float:
        bowed = device()
        bowed.pitch = pitch
        angle, _ = run(bowed, motors, Controlled(feedforward, most, pitch), LettingGo(pose), RATE)
        free = angle[round(SETTLING * RATE) :]
        return float(np.abs(free - free[0]).max())

    effort = measure(device(), motors, Controlled(feedforward, most), REACH, RATE).total
    upright, bowed = (max(sag(pose, pitch) for pose in held) for pitch in (0.0, BOWED))
    return Burden(effort, upright, bowed)
