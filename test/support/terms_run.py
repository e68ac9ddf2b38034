# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Terms on the simulated arm, through CAN frames and a delay: who gave which energy, and does the arm come to rest."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from exo_gravity.core import ArmModel, Tilt
from exo_gravity.core.arm.gravity import exact_torque
from exo_gravity.core.compensation.terms.terms import Terms, TermSettings
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.frames import ENTER
from exo_gravity.core.numbers import Vector
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS

from .active_wearer import Joints, attach
from .simulated_device import joints_of, make_device

NAMES = ("rotation", "abduction", "flexion", "elbow")
MOTORS_OF_ARM = joints_of((MIT,) * 4)
UPRIGHT = Tilt.of("right")
COULOMB = (0.2, 0.4, 0.2, 0.2)  # Nm of the simulated arm, by default

Push = Callable[[float, Joints, Joints], Vector]  # time, angles, velocities -> (4,) Nm


POSE = (0.2, 0.7, 0.6, 0.7)  # rad


def no_push(_time: float, _theta: Joints, _velocity: Joints) -> Joints:
    return (0.0,) * 4


def sines(seed: int, until: float, strength: float = 2.0, stiffness: float = 2.0) -> Push:
    """Return random pushes on all joints, 0.2 to 3 Hz, that end at `until` s; a spring of `stiffness` Nm/rad stays."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.2, 3.0, (3, 4)), rng.uniform(0.0, 6.0, (3, 4))
    size = strength * rng.uniform(0.1, 0.5, (3, 4)) * (1.0, 2.0, 1.0, 0.5)

    def push(time: float, theta: Joints, _velocity: Joints) -> Vector:
        elastic = stiffness * np.subtract(POSE, theta)
        if time > until:
            return elastic
        return (size * np.sin(2.0 * math.pi * frequency * time + phase)).sum(axis=0) + elastic

    return push


@dataclass
class TermsRun:
    """An arm under exact gravity compensation and `settings`, in cycles of `period` s.

    The torques act `delay` s after the reading, one period at least. config: the true arm; links: what the controller
    takes for it. given: J that the terms gave to the arm so far; its largest value so far is `most_given`. rubbed: J
    that the joints' friction took. worst_balance: the largest difference of the two so far.
    """

    settings: TermSettings
    config: ArmConfig = field(default_factory=ArmConfig)
    links: ArmModel = DEFAULT_LINKS
    pose: Sequence[float] = POSE
    period: float = 0.002
    delay: float = 0.0

    def __post_init__(self) -> None:
        self.device = make_device(config=self.config)
        self.device.arm.reset(self.pose)
        self.terms = Terms(NAMES, self.settings, self.links)
        self.given = self.most_given = self.rubbed = self.worst_balance = 0.0
        self.positions: list[list[float]] = []
        self.applied: list[np.ndarray] = []
        self._gravity: deque[Sequence[float]] = deque([exact_torque(self.links, self.pose, UPRIGHT)])
        self._extra: deque[Sequence[float]] = deque([(0.0,) * 4])
        self._late = max(1, round(self.delay / self.period))
        self._push: Push = no_push
        attach(self.device, lambda *state: np.asarray(self._push(*state)).tolist())
        for motor in MOTORS_OF_ARM:
            self.device.exchange(motor.can_id, motor.command(0.0, 0.0))
            self.device.exchange(motor.can_id, ENTER)

    def run(self, seconds: float, push: Push = no_push) -> None:
        """Advance; `push` is another torque on the joints, that of a wearer."""
        self._push = push
        for _ in range(round(seconds / self.period)):
            self._cycle()

    def _cycle(self) -> None:
        device, theta, velocity = self.device, [], []
        extra = np.array(self._extra[0])
        for joint, motor in enumerate(MOTORS_OF_ARM):
            answer = device.exchange(motor.can_id, motor.command(self._gravity[0][joint] + float(extra[joint]), 0.0))
            assert answer
            reply = motor.sample(answer[1], device.time)
            theta.append(reply.position)
            velocity.append(reply.velocity)
        self._gravity.append(exact_torque(self.links, theta, UPRIGHT))
        self._extra.append(self.terms.torque(100.0 + device.time, theta, velocity))
        while len(self._extra) > self._late:
            self._extra.popleft()
            self._gravity.popleft()
        before = np.array(device.arm.positions)
        device.advance(self.period)
        moved = np.array(device.arm.positions) - before
        self.given += float(extra @ moved)
        viscous = np.abs(moved) / self.period * self.config.viscous_friction
        self.rubbed += float(np.abs(moved) @ (viscous + self.config.coulomb_friction))
        self.most_given = max(self.most_given, self.given)
        self.worst_balance = max(self.worst_balance, self.given - self.rubbed)
        self.positions.append(device.arm.positions)
        self.applied.append(extra)

    def comes_to_rest(self, push: Push, seconds: float = 15.0) -> bool:
        """Return whether no joint moves by 0.05 degrees in half a second, at some time in the next `seconds`."""
        for _ in range(round(2.0 * seconds)):
            self.run(0.5, push)
            if self.travel(0.5) < 0.05:
                return True
        return False

    def travel(self, seconds: float) -> float:
        """Return how far a joint moved to and fro in the last `seconds`, in degrees."""
        last = np.array(self.positions[-round(seconds / self.period) :])
        return float(np.degrees(np.ptp(last, axis=0).max()))
