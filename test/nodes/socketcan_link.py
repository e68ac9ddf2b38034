# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A SocketCAN link that goes down, on vcan0: `make study NAME=socketcan`."""

from __future__ import annotations

import subprocess
import time
from functools import partial

import can
import pytest

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import pack_reply
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.can.can_port import ArmOnBus, CanPort, open_bus
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK

from ..support.simulated_device import OFF, drive_of

VCAN = ("socketcan", "vcan0")
AK60 = MOTORS["AK60-6"]
IDS = (1, 2, 3, 4)
AK60_REPLY = pack_reply(AK60, 3, 0.0, 0.0, 0.0)


def set_link(state: str, name: str = "vcan0") -> None:
    subprocess.run(["ip", "link", "set", name, state], check=True)


def bus_on(bus: can.BusABC) -> MotorBus:
    return MotorBus([CanPort(bus, COMPUTER_CLOCK)] * len(IDS), [JointMotor(AK60, can_id) for can_id in IDS])


def test_a_link_that_is_down_is_a_bus_error_and_the_motors_are_switched_off_once_it_is_up():
    ours, other = (open_bus(*VCAN, {}) for _ in range(2))
    bus = bus_on(ours)
    bus.exchange(drive_of(NO_TORQUE), time.monotonic())
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
    bus = bus_on(open_bus(*VCAN, {}))
    set_link("down")
    try:
        bus.stop()
    finally:
        set_link("up")


def test_one_of_two_links_that_is_down_is_named_and_the_other_gets_its_commands():
    listeners = [open_bus("socketcan", name, {}) for name in ("vcan0", "vcan1")]
    motors = tuple(JointMotor(AK60, can_id) for can_id in IDS)
    limits = Limits(("a", "b", "c", "d"), max_effort=(0.0,) * 4)
    arm = ArmOnBus(("socketcan", "vcan0,vcan0,vcan1,vcan1", {}), motors, limits, 0.01)
    bus = MotorBus(arm.ports(COMPUTER_CLOCK), motors)
    bus.exchange(OFF, time.monotonic())
    heard = [{frame.arbitration_id for frame in iter(partial(other.recv, 0.0), None)} for other in listeners]
    assert heard == [{1, 2}, {3, 4}]
    reply = can.Message(arbitration_id=3, data=AK60_REPLY, is_extended_id=False)
    listeners[1].send(reply)
    bus.receive_until(time.monotonic() + 1.0, lambda: bus.samples[2].time > 0.0)
    assert bus.samples[2].time > 0.0
    set_link("down", "vcan1")
    try:
        with pytest.raises(BusError, match=r"vcan1.*Network is down"):
            bus.exchange(drive_of(NO_TORQUE), time.monotonic())
    finally:
        set_link("up", "vcan1")
    sent = [bytes(frame.data) for frame in iter(lambda: listeners[0].recv(0.0), None)]
    assert sent.count(ENTER) == 2
    bus.stop()
    for other in listeners:
        other.shutdown()
