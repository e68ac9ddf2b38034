"""A simulated motor with a V3 board: MIT mode with 29-bit IDs, and status frames on its own timer.

What the board does (CubeMars driver manual V3.0.0; frames in core/motors/wire_formats/mit_v3.py):
- A command in MIT mode switches the motor on and stays in force until the next one. A current is a command too; 0 A
  switches the motor off. Other control modes are ignored here.
- It replies to nothing. It sends its state `status_rate` times a second, on or off.
"""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Iterator, Sequence

from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import MotorCommand, MotorReply
from exo_gravity.core.motors.wire_formats import EXTENDED, MIT_V3, MODE_CURRENT, Frame
from exo_gravity.sim.motor import Firmware, SimulatedMotor, clamp


class SimulatedV3Motor(SimulatedMotor):
    """One motor with a V3 board; attributes and faults like `SimulatedMotor`."""

    def __init__(self, joint: JointMotor, firmware: Firmware | None = None) -> None:
        super().__init__(joint, firmware)
        self._current_id = EXTENDED | MODE_CURRENT << 8 | joint.can_id

    @property
    def received_ids(self) -> tuple[int, ...]:
        """Arbitration IDs of the frames that the board obeys."""
        return self.joint.command_id, self._current_id

    def receive(
        self, data: bytes, position: float, velocity: float, now: float, frame_id: int | None = None
    ) -> bytes | None:
        """Execute the frame; frame_id: by default that of a command in MIT mode. Returns None: there is no reply."""
        if self.unplugged:
            return None
        if frame_id == self._current_id:
            if len(data) == 4:
                current = int.from_bytes(data, "big", signed=True) / 1000.0
                self._command = MotorCommand(0.0, 0.0, 0.0, 0.0, current * self.joint.spec.torque_per_ampere)
                self._entered = current != 0.0
        elif len(data) == 8:
            self._command = MIT_V3.unpack_command(self.joint.spec, data)
            self._entered = True
        return None

    def status(self, position: float, velocity: float) -> Frame | None:
        """Return the status frame of the joint at `position` rad and `velocity` rad/s; None without power."""
        if self.unplugged:
            return None
        values = self._readings(position, velocity)
        temperature = round(clamp(self.temperature, 127.0))
        reply = MotorReply(self.joint.can_id, *values, temperature, self.error)
        return MIT_V3.status_id(self.joint.can_id), MIT_V3.pack_reply(self.joint.spec, reply)


class StatusTimer:
    """When each V3 board among `motors` sends its next status frame, from `now` (s) on."""

    def __init__(self, motors: Sequence[SimulatedMotor], now: float, rng: random.Random) -> None:
        self._periods = {
            joint: 1.0 / motor.firmware.status_rate
            for joint, motor in enumerate(motors)
            if isinstance(motor, SimulatedV3Motor)
        }
        self._due = [(now + rng.uniform(0.0, period), joint) for joint, period in self._periods.items()]
        heapq.heapify(self._due)

    @property
    def next(self) -> float:
        """The time in s of the next status frame; infinity for none."""
        return self._due[0][0] if self._due else math.inf

    def due(self, now: float) -> Iterator[int]:
        """Yield each joint whose status frame is due at `now` (s), once; frames that were missed are not made up."""
        while self.next <= now:
            due, joint = self._due[0]
            period = self._periods[joint]
            heapq.heapreplace(self._due, (max(due, now - period) + period, joint))
            yield joint


def simulated_motor(joint: JointMotor, firmware: Firmware | None = None) -> SimulatedMotor:
    """Return the motor with the board that speaks the wire format of `joint`."""
    return (SimulatedMotor if joint.wire_format.replies else SimulatedV3Motor)(joint, firmware)
