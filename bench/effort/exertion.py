# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A wearer's exertion: a virtual wearer moves the simulated arm along paths, and the wearer's torque is measured.

The hand is that of the virtual wearer, and stronger; the wearer's passive arm is in the exoskeleton. Without help they
carry both, and overcome their friction and inertia. The controller exchanges one CAN frame with each motor a cycle;
there is no safety machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.gravity import NO_TORQUE, Torque
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.frames import ENTER
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.sim import STEP, SimulatedDevice, VirtualWearer
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_wearer import Path, path_between

STRENGTH = 60.0  # Nm on any joint, an adult's shoulder
SETTLING = 3.0  # s at the start of a task, not measured: the torque ramps in, the wearer takes over the rest
SMOOTHING = 0.02  # s
STANDING = 0.005  # rad/s, below which a joint stands
RATE = 250.0  # Hz
MIDDLE = (0.1, 0.6, 0.6, 0.7)  # rad

# time in s, angles (4,) in rad, velocities (4,) in rad/s -> torque (4,) in Nm
Controller = Callable[[float, Sequence[float], Sequence[float]], Sequence[float]]


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

    def at(self, elapsed: float) -> Path:
        """Return the wanted angle in rad and velocity in rad/s of each joint `elapsed` s after the start."""
        index, since = divmod(max(0.0, elapsed - SETTLING), self.move + self.hold)
        n = min(int(index), len(self.poses) - 1)
        return path_between(self.poses[max(0, n - 1)], self.poses[n], since, self.move)

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
    length: float = 12.0

    @property
    def duration(self) -> float:
        """Length in s, with the settling."""
        return SETTLING + self.length

    def at(self, elapsed: float) -> Path:
        """Return the wanted angle in rad and velocity in rad/s of each joint `elapsed` s after the start."""
        since = max(0.0, elapsed - SETTLING)
        rate = math.log(self.high / self.low) / self.length
        frequency = self.low * math.exp(rate * since)
        phase = 2.0 * math.pi * (frequency - self.low) / rate
        path = [(position, 0.0) for position in self.pose]
        speed = 2.0 * math.pi * frequency * self.amplitude * math.cos(phase) if since else 0.0
        path[self.joint] = self.pose[self.joint] + self.amplitude * math.sin(phase), speed
        return path


POSES = Task(
    "poses",
    (
        (0.0, 0.3, 0.2, 0.3), (0.0, 0.3, 0.8, 1.2), (0.0, 0.3, 1.5, 0.4), (-0.6, 0.5, 1.1, 1.6), (0.6, 0.5, 1.1, 0.6),
        (0.0, 0.9, -0.3, 0.5), (0.0, 0.9, 0.5, 1.0), (-0.8, 0.9, 0.9, 0.4), (0.8, 0.9, 0.3, 1.8), (0.0, 1.4, 0.0, 0.3),
        (0.4, 1.4, 0.5, 1.4), (-0.4, 1.8, 0.3, 0.8), (0.0, 0.6, 2.0, 0.5),
    ),
    move=1.5,
    hold=1.0,
)  # fmt: skip
REACH = Task("reach", ((0.0, 0.4, 0.3, 0.5), (0.3, 0.7, 0.7, 0.9)) * 4, move=1.0, hold=0.5)
TASKS: tuple[Task | Sweep, ...] = (POSES, REACH, *(Sweep(f"sweep {n + 1}", MIDDLE, n) for n in range(4)))


class Exertion(NamedTuple):
    """A wearer's exertion in one task, after the settling."""

    #: RMS of the torque, (4,) Nm.
    rms: np.ndarray
    #: Largest torque, (4,) Nm.
    peak: np.ndarray
    #: Work that the wearer put in, J per s.
    work: float
    #: RMS jerk of the motion over all joints, rad/s^3.
    jerk: float
    #: Reflected inertia in kg m^2, Coulomb friction in Nm and viscous friction in Nm s/rad of a sweep's joint, or None.
    felt: tuple[float, float, float] | None
    #: RMS of the torque over all joints in Nm while the arm is held still, NaN for a task without holds.
    held: float = math.nan

    @property
    def total(self) -> float:
        """RMS of the torque over all joints in Nm: the root of the sum of squares."""
        return float(np.linalg.norm(self.rms))


def exertion_of(
    torque: np.ndarray, speed: np.ndarray, rate: float, swept: int | None = None, holding: np.ndarray | None = None
) -> Exertion:
    """Return the exertion of a wearer who gave `torque` (n, 4) in Nm at the joints' `speed` (n, 4) in rad/s.

    rate: samples per s. swept: the joint that made a sweep, None for another task. holding: (n,) whether the arm is
    held still, None for a task without holds.
    """
    smooth = _smoothed(speed, rate)
    acceleration = np.gradient(smooth, 1.0 / rate, axis=0)
    jerk = np.gradient(acceleration, 1.0 / rate, axis=0)[1:-1]
    return Exertion(
        np.sqrt(np.mean(torque**2, axis=0)),
        np.abs(torque).max(axis=0),
        float(np.maximum((torque * speed).sum(axis=1), 0.0).mean()),
        float(np.sqrt(np.mean((jerk**2).sum(axis=1)))),
        None if swept is None else _felt(_smoothed(torque, rate), smooth, acceleration, swept),
        math.nan if holding is None else float(np.sqrt(np.mean((torque[holding] ** 2).sum(axis=1)))),
    )


def _felt(torque: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, n: int) -> tuple[float, float, float]:
    """Return inertia, Coulomb and viscous friction of joint `n`; the other joints, which move a little, act on it."""
    others = [joint for joint in range(speed.shape[1]) if joint != n]
    own = acceleration[:, n], np.tanh(speed[:, n] / STANDING), speed[:, n], np.ones(len(speed))
    columns = np.column_stack((*own, acceleration[:, others]))
    inertia, coulomb, viscous = np.linalg.lstsq(columns, torque[:, n], rcond=None)[0][:3].tolist()
    return inertia, coulomb, viscous


def _smoothed(values: np.ndarray, rate: float) -> np.ndarray:
    """Return the moving average over SMOOTHING, without the ends."""
    width = max(1, round(SMOOTHING * rate))
    return np.stack([np.convolve(column, np.ones(width) / width, mode="valid") for column in values.T], axis=1)


class TaskWearer(VirtualWearer):
    """Follows a task. torques: (n, 4) Nm of the wearer, one for each millisecond."""

    def __init__(self, task: Task | Sweep) -> None:
        super().__init__(TrialScript.parse({"name": task.name, "steps": [{"hold": task.duration}]}), STRENGTH)
        self.task = task
        self.torques: list[Torque] = []

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm `elapsed` s after the start of the task."""
        self.torques.append(self.lead(self.task.at(elapsed), theta, velocity, STEP))
        return self.torques[-1]

    def idle(self, elapsed: float, duration: float) -> bool:
        """Return False: the wearer always holds the arm."""
        return False


class LettingGo(TaskWearer):
    """Holds a pose until the settling is over, then lets go for `length` s."""

    def __init__(self, pose: tuple[float, ...], length: float) -> None:
        super().__init__(Task("let go", (pose,), move=length, hold=0.0))

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm."""
        return super().torque(elapsed, theta, velocity) if elapsed < SETTLING else NO_TORQUE

    def idle(self, elapsed: float, duration: float) -> bool:
        """Return whether the wearer has let go."""
        return elapsed >= SETTLING


def measure(
    device: SimulatedDevice,
    motors: Sequence[JointMotor],
    controller: Settings | Controller | None,
    task: Task | Sweep,
    rate: float = RATE,
) -> Exertion:
    """Return what `task` costs the wearer on `device`, under a compensator's settings, another controller, or None.

    rate: Hz of the control cycles.
    """
    wearer = TaskWearer(task)
    _, velocity = perform(device, motors, controller, wearer, rate)
    torque = np.array(wearer.torques)[:: round(1.0 / (rate * STEP))]
    first, count = round(SETTLING * rate), min(len(torque), len(velocity))
    holding = task.holding(np.arange(first, count) / rate) if isinstance(task, Task) else None
    joint = task.joint if isinstance(task, Sweep) else None
    return exertion_of(torque[first:count], velocity[first:count], rate, joint, holding)


def perform(
    device: SimulatedDevice,
    motors: Sequence[JointMotor],
    controller: Settings | Controller | None,
    wearer: TaskWearer,
    rate: float = RATE,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the true angles (n, 4) in rad and velocities (n, 4) in rad/s, one for each control cycle; as `measure`."""
    compute = _compensator(controller) if isinstance(controller, Settings) else controller
    device.arm.reset([position for position, _ in wearer.task.at(0.0)])
    device.start(wearer)
    for motor in motors:
        device.exchange(motor.can_id, motor.command(0.0, 0.0))
        device.exchange(motor.can_id, ENTER)
    torque: Sequence[float] = NO_TORQUE
    angles, speeds = [], []
    for _ in range(round(wearer.task.duration * rate)):
        frames = [device.exchange(m.can_id, m.command(tau, 0.0)) for m, tau in zip(motors, torque, strict=True)]
        replies = [motor.sample(frame[1], device.time) for motor, frame in zip(motors, frames, strict=True) if frame]
        if compute:
            torque = compute(device.time, [reply.position for reply in replies], [reply.velocity for reply in replies])
        angles.append(device.arm.positions)
        speeds.append(device.arm.velocities)
        device.advance(1.0 / rate)
    return np.array(angles), np.array(speeds)


def _compensator(settings: Settings) -> Controller:
    compensator = Compensator(settings)
    return lambda now, theta, velocity: compensator.step(now, theta, velocity).effort or NO_TORQUE
