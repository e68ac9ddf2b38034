"""A SocketCAN link that goes down, on vcan0: `make socketcan`."""

from __future__ import annotations

import subprocess
import time

import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import EXIT, MOTORS
from exo_gravity.core.safety.drive import NOTHING, OFF, Drive
from exo_gravity.hardware.can.can_port import open_bus
from exo_gravity.hardware.can.motor_bus import MotorBus

VCAN = ("socketcan", "vcan0")
AK60 = MOTORS["AK60-6"]
IDS = (1, 2, 3, 4)


def set_link(state: str) -> None:
    subprocess.run(["ip", "link", "set", "vcan0", state], check=True)


def test_a_link_that_is_down_is_a_bus_error_and_the_motors_are_switched_off_once_it_is_up():
    ours, other = (open_bus(*VCAN, {}) for _ in range(2))
    bus = MotorBus(ours, [JointMotor(AK60, can_id) for can_id in IDS])
    bus.exchange(Drive(NOTHING, NOTHING, True), time.monotonic())
    set_link("down")
    try:
        for _ in range(3):
            with pytest.raises(BusError, match=r"vcan0.*Network is down"):
                bus.exchange(OFF, time.monotonic())
    finally:
        set_link("up")
    other.shutdown()
    with open_bus(*VCAN, {}) as other:
        bus.exchange(OFF, time.monotonic())
        sent = [bytes(frame.data) for frame in iter(lambda: other.recv(0.0), None)]
    assert sent.count(EXIT) == 4
    bus.stop()


def test_stop_raises_nothing_on_a_link_that_is_down():
    bus = MotorBus(open_bus(*VCAN, {}), [JointMotor(AK60, can_id) for can_id in IDS])
    set_link("down")
    try:
        bus.stop()
    finally:
        set_link("up")
    assert bus.ignored["unsent"] == 16
