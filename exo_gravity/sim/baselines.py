"""Controllers in place of the compensator, and what they cost the wearer: effort to move, and sag after letting go.

A PID knows no intention: it holds the pose in which it was switched on, and the wearer moves the arm against it. A law
alone has no ramp: the wearer holds the arm while it is switched on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm import JOINT_COUNT
from exo_gravity.core.compensator import Answer
from exo_gravity.core.gravity import NO_TORQUE, Torque
from exo_gravity.core.joint_motor import JointMotor, peaks_of
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.effort import SETTLING, Controller, EffortWearer, Task, measure, run
from exo_gravity.sim.effort_study import POSES, RATE, REACH

# Nm/rad, Nm/(rad s), Nm s/rad: as stiff as these arms bear without oscillation at RATE.
STIFFNESS, INTEGRAL, DAMPING = (20.0, 40.0, 15.0, 8.0), (20.0, 40.0, 15.0, 8.0), (0.5, 1.0, 0.4, 0.2)
RELEASED = 5.0  # s for which the arm is watched after the wearer lets go
HELD = POSES.poses[::3]

Law = Callable[[Sequence[float]], Sequence[float]]  # angles (4,) rad -> Nm (4,)


class Burden(NamedTuple):
    """effort: RMS over all joints in Nm in the reach task. sag: largest motion in rad of a joint after letting go."""

    effort: float
    sag: float


class Feedforward:
    """The torque of `law`, None for none; with `feedback` a PID on each joint too."""

    def __init__(self, law: Law | None, feedback: bool, most: Sequence[float]) -> None:
        self._law, self._feedback, self._most = law, feedback, most
        self._start: Sequence[float] | None = None
        self._sum = [0.0] * JOINT_COUNT
        self._time = 0.0

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Answer:
        """Return the torque, limited to what the motors can give."""
        if self._start is None:
            self._start, self._time = list(theta), now
        dt, self._time = now - self._time, now
        torque = list(self._law(theta)) if self._law else [0.0] * JOINT_COUNT
        if self._feedback:
            speeds = velocity or NO_TORQUE
            for n, (start, angle, speed) in enumerate(zip(self._start, theta, speeds, strict=True)):
                most = self._most[n] / INTEGRAL[n]  # the integral alone never asks for more than the motor has
                self._sum[n] = max(-most, min(most, self._sum[n] + (start - angle) * dt))
                torque[n] += STIFFNESS[n] * (start - angle) + INTEGRAL[n] * self._sum[n] - DAMPING[n] * speed
        return Answer(tuple(max(-most, min(most, tau)) for tau, most in zip(torque, self._most, strict=True)))


class LettingGo(EffortWearer):
    """Holds a pose until the settling is over."""

    def __init__(self, pose: tuple[float, ...]) -> None:
        super().__init__(Task("let go", (pose,), move=RELEASED, hold=0.0))

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm."""
        return super().torque(elapsed, theta, velocity) if elapsed < SETTLING else NO_TORQUE


def burden(
    device: Callable[[], SimulatedDevice],
    motors: Sequence[JointMotor],
    law: Law | None,
    feedback: bool,
    held: Sequence[tuple[float, ...]] = HELD,
) -> Burden:
    """Return what a controller costs the wearer. device(): a new one for each task."""
    most = peaks_of(motors)[0]

    def controller() -> Controller:
        return Feedforward(law, feedback, most)

    sags = []
    for pose in held:
        angle, _ = run(device(), motors, controller(), LettingGo(pose), RATE)
        free = angle[round(SETTLING * RATE) :]
        sags.append(float(np.abs(free - free[0]).max()))
    return Burden(measure(device(), motors, controller(), REACH, RATE).total, max(sags))
