# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Ends of a wire that tests need."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import can

from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.hardware.can_port import CanPort
from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.sim.virtual_time import Wire


class Responder:
    """Answers each frame on `wire` with those that `answer` returns, at once. received: all frames."""

    def __init__(self, wire: Wire, answer: Callable[[can.Message], list[can.Message]] = lambda message: []) -> None:
        self.received: list[can.Message] = []
        self._wire, self._answer = wire, answer
        wire.ends.append(self)

    def deliver(self, message: can.Message) -> None:
        """Receive a frame, and answer it."""
        self.received.append(message)
        for reply in self._answer(message):
            self._wire.carry(self, reply)


def motor_bus(wire: Wire, joints: Sequence[JointMotor]) -> MotorBus:
    """Return the bridge's end of a bus with all these motors."""
    return MotorBus([CanPort(wire.open(), wire.clock)] * len(joints), joints, clock=wire.clock)
