# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Controllers in place of the compensator, and what they cost the wearer: exertion, and sag after letting go.

A PID has no input for the wearer's intention: it holds the pose in which it was switched on, and the wearer moves the
arm against it. A law alone has no ramp: the wearer holds the arm while it is switched on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from bench.effort.exertion import POSES, RATE, REACH, SETTLING, LettingGo, Task, measure, perform
from exo_gravity.core.arm.gravity import NO_TORQUE, Torque
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.sim import STEP, SimulatedDevice

# Nm/rad, Nm/(rad s), Nm s/rad: as stiff as these arms bear without oscillation at RATE.
STIFFNESS, INTEGRAL, DAMPING = (20.0, 40.0, 15.0, 8.0), (20.0, 40.0, 15.0, 8.0), (0.5, 1.0, 0.4, 0.2)
RELEASED = 5.0  # s for which the arm is watched after the wearer lets go
HELD = POSES.poses[::2]
BOWED = math.radians(30.0)  # pitch of the trunk in the second hold of each pose

Law = Callable[[Sequence[float], float], Sequence[float]]  # angles (4,) in rad, the trunk's pitch in rad -> Nm (4,)


class Burden(NamedTuple):
    """What a controller costs the wearer."""

    #: RMS torque over all joints in Nm in the reach task.
    exertion: float
    #: Largest motion of a joint in rad after letting go, with an upright trunk.
    sag: float
    #: The same with a trunk that is bowed by `BOWED`.
    sag_bowed: float


class Feedforward(NamedTuple):
    """What a controller consists of."""

    law: Law | None
    #: With a PID on each joint.
    feedback: bool
    #: s that the law takes for one pose; until then the torque of an earlier pose stays.
    pose_time: float = 0.0


class Controlled:
    """Runs `feedforward` with motors that give at most `most` (4,) Nm. pitch: of the trunk in rad."""

    def __init__(self, feedforward: Feedforward, most: Sequence[float], pitch: float = 0.0) -> None:
        self._parts, self._most, self._pitch = feedforward, most, pitch
        self._start: Sequence[float] | None = None
        self._sum = [0.0] * JOINT_COUNT
        self._time = self._due = -math.inf
        self._carried: Sequence[float] = NO_TORQUE

    def torque(self, now: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the torque (4,) in Nm, limited to what the motors can give."""
        if self._start is None:
            self._start, self._time = list(theta), now
        dt, self._time = now - self._time, now
        if self._parts.law and now >= self._due:
            self._carried = self._parts.law(theta, self._pitch)
            self._due = now + self._parts.pose_time - 0.5 * STEP
        torque = list(self._carried)
        if self._parts.feedback:
            for n, (start, angle, speed) in enumerate(zip(self._start, theta, velocity, strict=True)):
                most = self._most[n] / INTEGRAL[n]  # the integral alone never asks for more than the motor has
                self._sum[n] = max(-most, min(most, self._sum[n] + (start - angle) * dt))
                torque[n] += STIFFNESS[n] * (start - angle) + INTEGRAL[n] * self._sum[n] - DAMPING[n] * speed
        return tuple(max(-most, min(most, tau)) for tau, most in zip(torque, self._most, strict=True))


def burden(
    device: Callable[[], SimulatedDevice],
    motors: Sequence[JointMotor],
    feedforward: Feedforward,
    held: Sequence[tuple[float, ...]] = HELD,
    task: Task = REACH,
) -> Burden:
    """Return what a controller costs the wearer. device(): a new one for each task, with an upright trunk."""
    most = tuple(motor.peak_effort for motor in motors)

    def sag(pose: tuple[float, ...], pitch: float) -> float:
        bowed = device()
        bowed.pitch = pitch
        angle, _ = perform(bowed, motors, Controlled(feedforward, most, pitch).torque, LettingGo(pose, RELEASED))
        free = angle[round(SETTLING * RATE) :]
        return float(np.abs(free - free[0]).max())

    exertion = measure(device(), motors, Controlled(feedforward, most).torque, task).total
    upright, bowed = (max(sag(pose, pitch) for pose in held) for pitch in (0.0, BOWED))
    return Burden(exertion, upright, bowed)
