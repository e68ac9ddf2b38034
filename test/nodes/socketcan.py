# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""SocketCAN links that go down, and nodes as processes on vcan0 and vcan1: `make study NAME=socketcan`.

An emulated machine is 10 to 20 times slower than a real one, so the nodes' clock is slowed down in proportion: the
limits stay those of a worn arm.
"""

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager

import can
import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import pack_reply
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.can_port import ArmOnBus, open_bus
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.lab import processes

from ..support.launched_nodes import CALM, NO_IMU, LaunchedNodes
from ..support.simulated_device import OFF, Send, command_of, sending
from ..support.waiting import wait_until

ONE, TWO = "vcan0", "vcan0,vcan0,vcan1,vcan1"
IDS = (1, 2, 3, 4)
AK60 = MOTORS["AK60-6"]
SLOWER = 10
# Python imports it at the start of every process that has its folder in PYTHONPATH.
SITECUSTOMIZE = f"""
import os, select, time
def refuse(*_): raise PermissionError  # on two slow cores a higher priority would starve the other processes
os.setpriority = refuse
monotonic, sleep, wait = time.monotonic, time.sleep, select.select
time.monotonic = lambda: monotonic() / {SLOWER}
time.sleep = lambda duration: sleep(duration * {SLOWER})
select.select = lambda r, w, x, timeout=None: wait(r, w, x, timeout and timeout * {SLOWER})
"""


def bus_on(channels: str) -> MotorBus:
    motors = tuple(JointMotor(AK60, can_id) for can_id in IDS)
    limits = Limits(("a", "b", "c", "d"), max_effort=(0.0,) * 4)
    arm = ArmOnBus(("socketcan", channels, {}), motors, limits, 0.01)
    return MotorBus(arm.ports(COMPUTER_CLOCK), motors)


@contextmanager
def down(name: str) -> Iterator[None]:
    subprocess.run(["ip", "link", "set", name, "down"], check=True)
    try:
        yield
    finally:
        subprocess.run(["ip", "link", "set", name, "up"], check=True)


def heard(bus: can.BusABC) -> list[can.Message]:
    return list(iter(lambda: bus.recv(0.0), None))


def test_a_link_that_is_down_is_a_bus_error_and_the_motors_are_switched_off_once_it_is_up():
    bus = bus_on(ONE)
    bus.exchange(command_of(NO_TORQUE), time.monotonic())
    with down("vcan0"):
        for _ in range(3):
            with pytest.raises(BusError, match=r"vcan0.*Network is down"):
                [bus.exchange(OFF, time.monotonic()) for _ in range(100)]  # one lost command alone is no error
    with open_bus("socketcan", "vcan0", {}) as other:
        bus.exchange(sending(Send.EXIT), time.monotonic())
        assert [bytes(frame.data) for frame in heard(other)].count(EXIT) == 4
    with down("vcan0"):
        bus.stop()


def test_one_of_two_links_that_is_down_is_named_and_the_other_gets_its_commands():
    listeners = [open_bus("socketcan", name, {}) for name in ("vcan0", "vcan1")]
    bus = bus_on(TWO)
    bus.exchange(OFF, time.monotonic())
    assert [{frame.arbitration_id for frame in heard(other)} for other in listeners] == [{1, 2}, {3, 4}]
    reply = pack_reply(AK60, 3, 0.0, 0.0, 0.0)
    listeners[1].send(can.Message(arbitration_id=3, data=reply, is_extended_id=False))
    bus.receive_until(time.monotonic() + 1.0, lambda: bus.samples[2].time > 0.0)
    assert bus.samples[2].time > 0.0
    with down("vcan1"), pytest.raises(BusError, match=r"vcan1.*Network is down"):
        bus.exchange(sending(Send.ENTER), time.monotonic())
    assert [bytes(frame.data) for frame in heard(listeners[0])].count(ENTER) == 2
    bus.stop()
    for other in listeners:
        other.shutdown()


@pytest.mark.parametrize("channels", [ONE, TWO])
def test_the_nodes_carry_the_arm_and_switch_the_motors_off(channels, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(SITECUSTOMIZE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    for name in ("DESCENT_TIMEOUT", "RECOVERY_TIMEOUT"):
        monkeypatch.setattr(processes, name, getattr(processes, name) * SLOWER)
    wired = {"can": {"interface": "socketcan", "channel": channels}}
    device = {**wired, "imu.rate": 10.0, "trunk": {"pitch": 0.0, "roll": 0.0}}
    nodes = LaunchedNodes(
        tmp_path, without=("imu",), timing=CALM, can_bridge=wired, simulator=device, compensator=NO_IMU
    )
    frames: list[can.Message] = []
    with (
        open_bus("socketcan", "vcan0", {}) as bus,
        open_bus("socketcan", "vcan1", {}) as other,
        can.Notifier([bus, other], [frames.append]),
    ):
        nodes.start()
        is_carried = lambda: any("can_bridge: INFO active" in line for line in nodes.log)  # noqa: E731
        wait_until(lambda: nodes.have_ended or is_carried(), timeout=120.0, seen=lambda: nodes.log)
        nodes.stop()
    for can_id in IDS:
        special = [bytes(f.data) for f in frames if f.arbitration_id == can_id and bytes(f.data) in (ENTER, EXIT)]
        assert ENTER in special
        assert special[-1] == EXIT
    assert is_carried() and not any("Traceback" in line for line in nodes.log)
