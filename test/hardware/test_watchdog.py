"""The watchdog: after the bridge has died, an arm with its motors on is let down; motors that are off stay off."""

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path

import can
import pytest

from exo_gravity.core.joint_motor import JointMotor
from exo_gravity.core.limits import Limits
from exo_gravity.core.motors import ENTER, EXIT, MOTORS, unpack_command
from exo_gravity.hardware.watchdog import Charge, let_down
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor

MOTORS_OF_ARM = tuple(JointMotor(MOTORS[name], n) for n, name in enumerate(("AK60-6", "AK80-9", "AK60-6", "AK60-6"), 1))
LIMITS = Limits(("a", "b", "c", "d"), (-1.6,) * 4, (3.1,) * 4, (6.0,) * 4, (3.0, 9.0, 3.0, 3.0))
QUICKLY = replace(LIMITS, fade_time=0.5, damping=1.5)
CHANNELS = (f"test_watchdog_{n}" for n in count())
EFFORT = (0.0, 3.0, 1.0, 0.5)
PERIOD = 0.004
# A process that its watchdog takes for a bridge that carries an arm.
CARRIER = """
import sys, time
from exo_gravity.core.drive import OFF, Drive
from exo_gravity.hardware.watchdog import Watchdog
watchdog = Watchdog()
while True:
    watchdog.note(Drive((0.0,) * 4, 0.0, {powered}))
    print("carrying", flush=True)
    time.sleep(0.01)
"""


@pytest.fixture
def wire():
    channel = next(CHANNELS)
    device = SimulatedDevice(SimulatedArm(), [SimulatedMotor(joint) for joint in MOTORS_OF_ARM])
    device.arm.reset((0.0, 0.9, 0.3, 0.3))
    for joint, effort in zip(MOTORS_OF_ARM, EFFORT, strict=True):
        device.exchange(joint.can_id, ENTER)
        device.exchange(joint.can_id, joint.command(effort, 0.0))
    bus, stop = can.Bus(interface="virtual", channel=channel), threading.Event()
    thread = threading.Thread(target=device.run, args=(bus, stop.is_set))
    thread.start()
    with can.Bus(interface="virtual", channel=channel) as listener:
        yield channel, device, listener
        stop.set()
        thread.join()
    bus.shutdown()


def test_the_let_down_starts_from_the_last_torques_and_ends_with_the_motors_off(wire):
    channel, device, listener = wire
    log = []
    let_down(Charge(("virtual", channel, {}), MOTORS_OF_ARM, QUICKLY, PERIOD), EFFORT, log.append)
    assert log == ["the arm is down, its motors are off"]
    frames = [(m.arbitration_id, bytes(m.data)) for m in iter(lambda: listener.recv(0.0), None)]
    torques = [unpack_command(MOTORS["AK80-9"], data).torque for to, data in frames if to == 2 and data[0] == 0x80]
    assert torques[0] == pytest.approx(EFFORT[1], abs=0.25)
    steps = [abs(after - before) for before, after in pairwise(torques)]
    assert max(steps) <= LIMITS.max_effort_rate * PERIOD + 2 * 36.0 / 4095
    assert ENTER not in [data for _, data in frames]
    assert not any(motor.entered for motor in device.motors)
    assert [data for to, data in frames if to == 2 and data[0] == 0xFF][-1] == EXIT


def test_a_bus_that_cannot_be_opened_is_logged():
    log = []
    let_down(Charge(("no_such_interface", "x", {}), MOTORS_OF_ARM, QUICKLY, PERIOD), EFFORT, log.append)
    assert len(log) == 1
    assert "CAN bus no_such_interface x" in log[0]


@pytest.fixture
def carry():
    processes = []

    def carry(powered):
        command = [sys.executable, "-c", CARRIER.format(powered=powered)]
        processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        assert processes[-1].stdout.readline() == "carrying\n"
        return processes[-1]

    yield carry
    for process in processes:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.parametrize(("powered", "number"), [(True, signal.SIGSTOP), (False, signal.SIGKILL)])
def test_a_frozen_bridge_is_killed_and_nothing_is_let_down_while_the_motors_are_off(carry, powered, number):
    process = carry(powered)
    os.kill(process.pid, number)
    assert process.wait(30) == -signal.SIGKILL
    for line in process.stdout:  # ends once the watchdog, which shares this output, has ended too
        assert line == "carrying\n"


def test_a_stall_of_the_whole_machine_does_not_kill_the_bridge(carry):
    process = carry(powered=True)
    (children,) = Path(f"/proc/{process.pid}/task").glob(f"{process.pid}/children")
    both = [process.pid, int(children.read_text().split()[0])]
    for number in (signal.SIGSTOP, signal.SIGCONT):
        for pid in both:
            os.kill(pid, number)
        time.sleep(0.3)  # more than three times the watchdog's `FROZEN`, both stopped and running
    assert process.poll() is None
