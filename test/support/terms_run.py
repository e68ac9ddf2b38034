# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Terms on the simulated arm, through CAN frames and a delay: who gave which energy, and does the arm come to rest."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from exo_gravity.core import ArmModel, Tilt
from exo_gravity.core.arm.gravity import NO_TORQUE, exact_torque
from exo_gravity.core.compensation.compensator import JOINTS
from exo_gravity.core.compensation.terms.terms import Terms, TermSettings
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.frames import ENTER
from exo_gravity.sim import ArmConfig

from .active_wearer import Joints, attach
from .simulated_device import joints_of, make_device

MOTORS_OF_ARM = joints_of((MIT,) * 4)
UPRIGHT = Tilt.of("right")
COULOMB = (0.2, 0.4, 0.2, 0.2)  # Nm of the simulated arm, by default
POSE = (0.2, 0.7, 0.6, 0.7)  # rad

Push = Callable[[float, Joints, Joints], Joints]  # time, angles, velocities -> (4,) Nm


def sines(seed: int, until: float, strength: float) -> Push:
    """Return random pushes on all joints, 0.2 to 3 Hz, that end at `until` s; a spring of 2 Nm/rad stays."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.2, 3.0, (3, 4)), rng.uniform(0.0, 6.0, (3, 4))
    size = strength * rng.uniform(0.1, 0.5, (3, 4)) * (1.0, 2.0, 1.0, 0.5)

    def push(time: float, theta: Joints, _velocity: Joints) -> Joints:
        wave = (size * np.sin(2.0 * math.pi * frequency * time + phase)).sum(axis=0) * (time <= until)
        return (2.0 * np.subtract(POSE, theta) + wave).tolist()

    return push


class TermsRun:
    """An arm under exact gravity compensation and `settings`, in cycles of `period` s.

    The torques act `delay` s after the reading, one period at least. config: the true arm; links: what the controller
    takes for it. given: J that the terms gave to the arm so far; its largest value so far is `most_given`. rubbed: J
    that the joints' friction took. worst_balance: the largest difference of the two so far.
    """

    def __init__(
        self,
        settings: TermSettings,
        config: ArmConfig,
        links: ArmModel,
        period: float,
        delay: float,
        pose: Sequence[float] = POSE,
    ) -> None:
        self.device = make_device(config=config)
        self.device.arm.reset(pose)
        self.terms, self.config, self.links, self.period = Terms(JOINTS, settings, links), config, links, period
        self.given = self.most_given = self.rubbed = self.worst_balance = 0.0
        self.positions: list[list[float]] = []
        self._sent = deque([(exact_torque(links, pose, UPRIGHT), NO_TORQUE)])
        self._late = max(1, round(delay / period))
        for motor in MOTORS_OF_ARM:
            self.device.exchange(motor.can_id, motor.command(0.0, 0.0))
            self.device.exchange(motor.can_id, ENTER)

    def push(self, push: Push) -> None:
        """Let a wearer push from now on."""
        attach(self.device, push)

    def run(self, seconds: float) -> None:
        """Advance."""
        for _ in range(round(seconds / self.period)):
            self._cycle()

    def _cycle(self) -> None:
        device, theta, velocity = self.device, [], []
        gravity, extra = self._sent[0]
        for motor, carried, added in zip(MOTORS_OF_ARM, gravity, extra, strict=True):
            answer = device.exchange(motor.can_id, motor.command(carried + added, 0.0))
            assert answer
            reply = motor.sample(answer[1], device.time)
            theta.append(reply.position)
            velocity.append(reply.velocity)
        added_next = self.terms.torque(100.0 + device.time, theta, velocity)
        self._sent.append((exact_torque(self.links, theta, UPRIGHT), tuple(added_next)))
        while len(self._sent) > self._late:
            self._sent.popleft()
        before = np.array(device.arm.positions)
        device.advance(self.period)
        moved = np.array(device.arm.positions) - before
        viscous = np.abs(moved) / self.period * self.config.viscous_friction
        self.given += float(np.array(extra) @ moved)
        self.rubbed += float(np.abs(moved) @ (viscous + self.config.coulomb_friction))
        self.most_given = max(self.most_given, self.given)
        self.worst_balance = max(self.worst_balance, self.given - self.rubbed)
        self.positions.append(device.arm.positions)

    def comes_to_rest(self) -> bool:
        """Return whether no joint moves by 0.05 degrees in half a second, at some time in the next 15 s."""
        for _ in range(30):
            self.run(0.5)
            if self.travel(0.5) < 0.05:
                return True
        return False

    def travel(self, seconds: float) -> float:
        """Return how far a joint moved to and fro in the last `seconds`, in degrees."""
        last = np.array(self.positions[-round(seconds / self.period) :])
        return float(np.degrees(np.ptp(last, axis=0).max()))
