"""Frames that a foreign host sends on the arm's CAN bus."""

from __future__ import annotations

import time
from collections.abc import Iterable

import can

from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import MOTORS
from exo_gravity.core.motors.wire_formats import EXTENDED, ID_BITS

from ..support.load import start_frames
from .fault_case import Action
from .rig import Rig

RATE = 3000  # random frames per second; with our own 2,000, as many as five Python processes on two cores receive
MOTOR_2 = JointMotor(MOTORS["AK80-9"], 2, direction=-1)  # as in sim.yaml


def random_frames(count: int, ids: Iterable[int]) -> Action:
    """Send `count` frames of random content under random `ids`."""

    def inject(rig: Rig) -> None:
        sender = start_frames(rig.nodes[0].bus, count, RATE, ids)
        rig.probe.wait_until(lambda: sender.poll() is not None, 2 * count / RATE + 30.0)
        assert sender.returncode == 0

    return inject


def foreign_frames(data: bytes, rate: float = 1.0, seconds: float = 0.0, frame_id: int = MOTOR_2.command_id) -> Action:
    """Send `data` to motor 2 as another host would: once, or `rate` a second for `seconds` s."""

    def inject(rig: Rig) -> float:
        is_extended = bool(frame_id & EXTENDED)
        message = can.Message(arbitration_id=frame_id & ID_BITS, data=data, is_extended_id=is_extended)
        with can.Bus(**rig.nodes[0].bus) as bus:
            wall, start = time.time(), time.monotonic()
            for number in range(1 + int(rate * seconds)):
                time.sleep(max(0.0, start + number / rate - time.monotonic()))
                bus.send(message)
        return wall

    return inject
