"""How hard an arm is to move: a virtual wearer moves it along paths with an impedance controller, whose torque counts.

The wearer's passive arm is in the exoskeleton. Without help he carries both and overcomes their friction and inertia.
Stiffness and damping are of the order of a human arm's; an integrator takes over what weight is left, as a person does.
The controller is `core.compensation.compensator` with one exchange of CAN frames a cycle; there is no safety machine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from exo_gravity.core.compensation.compensator import Answer, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.effort import Effort, effort_of
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import ENTER
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.sim.arm import STEP
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.virtual_wearer import Torque, VirtualWearer, minimum_jerk

STIFFNESS = (60.0, 80.0, 60.0, 30.0)  # Nm/rad
DAMPING = (3.0, 6.0, 5.0, 2.0)  # Nm s/rad
INTEGRAL = (120.0, 160.0, 150.0, 80.0)  # Nm/(rad s)
STRENGTH = 60.0  # Nm on any joint, an adult's shoulder
SETTLING = 3.0  # s at the start of a task that do not count: the torque ramps in, the wearer takes over the rest

Pose = Sequence[float]


class Controller(Protocol):
    """A compensator, or what is used in its place."""

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Answer:
        """Return the torque for joint angles `theta` (4,) rad and `velocity` (4,) rad/s at `now` s."""
        ...


@dataclass(frozen=True)
class Task:
    """Poses (n, 4) in rad that are visited in turn: each is reached in `move` s and held for `hold` s."""

    name: str
    poses: tuple[tuple[float, ...], ...]
    move: float
    hold: float

    @property
    def duration(self) -> float:
        """Length in s, with the settling at the first pose."""
        return SETTLING + len(self.poses) * (self.move + self.hold)

    def at(self, elapsed: float) -> tuple[list[float], list[float]]:
        """Return the wanted angles (4,) in rad and velocities (4,) in rad/s `elapsed` s after the start."""
        index, since = divmod(max(0.0, elapsed - SETTLING), self.move + self.hold)
        n = min(int(index), len(self.poses) - 1)
        path = minimum_jerk(self.poses[n - 1] if n else self.poses[0], self.poses[n], since, self.move)
        return [position for position, _ in path], [speed for _, speed in path]

    def holding(self, elapsed: np.ndarray) -> np.ndarray:
        """Return for each time (n,) in s since the start whether a pose is held."""
        return (elapsed - SETTLING) % (self.move + self.hold) > self.move


@dataclass(frozen=True)
class Sweep:
    """A sine of `amplitude` rad on one joint around `pose`, from `low` to `high` Hz in equal times per octave."""

    name: str
    pose: tuple[float, ...]
    joint: int
    amplitude: float = 0.1
    low: float = 0.1
    high: float = 2.0
    length: float = 20.0

    @property
    def duration(self) -> float:
        """Length in s, with the settling."""
        return SETTLING + self.length

    def at(self, elapsed: float) -> tuple[list[float], list[float]]:
        """Return the wanted angles (4,) in rad and velocities (4,) in rad/s `elapsed` s after the start."""
        since = max(0.0, elapsed - SETTLING)
        rate = math.log(self.high / self.low) / self.length
        frequency = self.low * math.exp(rate * since)
        phase = 2.0 * math.pi * (frequency - self.low) / rate
        position, speed = list(self.pose), [0.0] * JOINT_COUNT
        position[self.joint] += self.amplitude * math.sin(phase)
        speed[self.joint] = 2.0 * math.pi * frequency * self.amplitude * math.cos(phase) if since else 0.0
        return position, speed


class EffortWearer(VirtualWearer):
    """Follows a task with at most `strength` (4,) Nm. efforts: (n, 4) Nm of the wearer, one for each millisecond."""

    def __init__(self, task: Task | Sweep, strength: Sequence[float] = (STRENGTH,) * JOINT_COUNT) -> None:
        super().__init__(TrialScript.parse({"name": task.name, "steps": [{"hold": task.duration}]}))
        self.task = task
        self.strength = strength
        self.efforts: list[Torque] = []
        self._carried = [0.0] * JOINT_COUNT

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm `elapsed` s after the start of the task."""
        position, speed = self.task.at(elapsed)
        torque = []
        for n in range(JOINT_COUNT):
            error, most = position[n] - theta[n], self.strength[n]
            self._carried[n] = max(-most, min(most, self._carried[n] + INTEGRAL[n] * error * STEP))
            pull = STIFFNESS[n] * error + DAMPING[n] * (speed[n] - velocity[n]) + self._carried[n]
            torque.append(max(-most, min(most, pull)))
        self.efforts.append(tuple(torque))
        return self.efforts[-1]

    def idle(self, elapsed: float, duration: float) -> bool:
        """Return False: the wearer always holds the arm."""
        return False


def measure(
    device: SimulatedDevice,
    motors: Sequence[JointMotor],
    controller: Settings | Controller | None,
    task: Task | Sweep,
    rate: float,
) -> Effort:
    """Let the wearer perform `task` on `device`, under a compensator of these settings, another controller, or none.

    rate: Hz of the control cycles.
    """
    wearer = EffortWearer(task)
    _, velocity = run(device, motors, controller, wearer, rate)
    per = round(1.0 / (rate * STEP))
    return task_effort(task, np.array(wearer.efforts)[::per], velocity, rate)


def task_effort(task: Task | Sweep, torque: np.ndarray, velocity: np.ndarray, rate: float) -> Effort:
    """Return the effort of a task from the wearer's torque and the true velocity, (n, 4) each, from its start on."""
    first, count = round(SETTLING * rate), min(len(torque), len(velocity))
    holding = task.holding(np.arange(first, count) / rate) if isinstance(task, Task) else None
    joint = task.joint if isinstance(task, Sweep) else None
    return effort_of(torque[first:count], velocity[first:count], rate, joint, holding)


def run(
    device: SimulatedDevice,
    motors: Sequence[JointMotor],
    controller: Settings | Controller | None,
    wearer: EffortWearer,
    rate: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the true angles (n, 4) in rad and velocities (n, 4) in rad/s, one for each control cycle; as `measure`."""
    compensator = Compensator(controller) if isinstance(controller, Settings) else controller
    device.arm.reset(wearer.task.at(0.0)[0])
    device.start(wearer)
    for motor in motors:
        device.exchange(motor.can_id, motor.command(0.0, 0.0))
        device.exchange(motor.can_id, ENTER)
    torque: Sequence[float] = (0.0,) * JOINT_COUNT
    angles, speeds = [], []
    for _ in range(round(wearer.task.duration * rate)):
        position, velocity = _exchange(device, motors, torque)
        if compensator:
            torque = compensator.step(device.time, position, velocity).effort or (0.0,) * JOINT_COUNT
        angles.append(device.arm.positions)
        speeds.append(device.arm.velocities)
        device.advance(1.0 / rate)
    return np.array(angles), np.array(speeds)


def _exchange(
    device: SimulatedDevice, motors: Sequence[JointMotor], torque: Sequence[float]
) -> tuple[list[float], list[float]]:
    position, velocity = [], []
    for motor, effort in zip(motors, torque, strict=True):
        frame = device.exchange(motor.can_id, motor.command(effort, 0.0))
        reply = motor.joint_reply(frame[1]) if frame else None
        position.append(reply.position if reply else math.nan)
        velocity.append(reply.velocity if reply else math.nan)
    return position, velocity
