# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The simulated V3 board: what it obeys, what it reports, and when."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import can
import numpy as np
import pytest

from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT, ID_BITS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.sim import Firmware, SimulatedMotor
from exo_gravity.sim import device as device_module

from ..support.simulated_device import make_device

SPEC = MIT_V3.ranged(MOTORS["AK60-6"])
JOINT = JointMotor(SPEC, 3, direction=-1, zero=0.2, torque_scale=0.8, wire_format=MIT_V3)
COMMAND_ID, CURRENT_ID = JOINT.command_id, JOINT.exit[0][0]


def reported(motor: SimulatedMotor, position: float = 0.5, velocity: float = 0.0):
    """Return what the joint reads from the status frame; None without one."""
    frame = motor.status(position, velocity)
    assert frame is None or frame[0] == MIT_V3.reply_id(3)
    return frame and JOINT.sample(frame[1], 0.0)


def test_the_first_command_switches_it_on_and_its_status_shows_angle_speed_and_torque():
    motor = SimulatedMotor(JOINT)
    assert not motor.entered
    assert motor.receive(JOINT.command(1.5, 0.0), 0.5, 0.0, 0.0, COMMAND_ID) is None
    assert motor.entered and motor.torque(0.5, 0.0) == pytest.approx(1.5, abs=0.01)
    reply = reported(motor, 0.5, 1.0)
    assert reply[:3] == (pytest.approx(0.5, abs=0.001), pytest.approx(1.0, abs=0.01), pytest.approx(1.5, abs=0.01))
    assert (reply.temperature, reply.error) == (30, 0)


def test_its_exit_frame_switches_it_off_and_a_current_drives_it():
    motor = SimulatedMotor(JOINT)
    motor.receive(JOINT.command(1.5, 5.0), 0.5, 0.0, 0.0, COMMAND_ID)
    for frame_id, data in JOINT.exit:
        motor.receive(data, 0.5, 0.0, 0.0, frame_id)
    assert not motor.entered and motor.torque(0.5, 3.0) == 0.0
    assert reported(motor).effort == 0.0
    motor.receive((2000).to_bytes(4, "big", signed=True), 0.5, 0.0, 0.0, CURRENT_ID)
    assert motor.torque(0.5, 0.0) == pytest.approx(-0.8 * 2.0 * 0.2997)


def test_without_power_it_reports_nothing_and_forgets_its_command():
    motor = SimulatedMotor(JOINT)
    motor.receive(JOINT.command(1.5, 0.0), 0.5, 0.0, 0.0, COMMAND_ID)
    motor.unplugged = True
    assert reported(motor) is None and motor.torque(0.5, 0.0) == 0.0
    motor.receive(JOINT.command(1.5, 0.0), 0.5, 0.0, 0.0, COMMAND_ID)
    motor.unplugged = False
    assert reported(motor).effort == 0.0 and not motor.entered


def test_on_a_device_it_ignores_frames_of_v1_boards_and_sends_no_reply():
    device = make_device(formats=(MIT, MIT_V3, MIT_V3, MIT))
    assert device.exchange(2, ENTER) is None and device.exchange(2, EXIT) is None
    assert not device.powered
    assert device.exchange(1, ENTER) is not None
    motor = replace(JOINT, can_id=2)
    assert device.exchange(motor.command_id, motor.command(0.0, 0.0)) is None
    assert [each.entered for each in device.motors] == [True, True, False, False]
    assert device.status(0) is None and device.status(1) is not None
    device.bus_silent = True
    assert device.status(1) is None


class StatusBus:
    """A bus without commands, whose waits take as long as they may, and 1 s once. sent: times and IDs of frames."""

    channel_info = "a test"

    def __init__(self) -> None:
        self.now, self.sent = 0.0, []

    def recv(self, timeout: float) -> None:
        self.now += 1.0 if 5.0 < self.now < 6.0 else max(timeout, 1e-4)

    def send(self, message: can.Message) -> None:
        self.sent.append((self.now, message.arbitration_id))


def test_status_frames_come_at_their_rate_and_missed_ones_are_not_made_up(monkeypatch):
    bus = StatusBus()
    monkeypatch.setattr(device_module, "time", SimpleNamespace(monotonic=lambda: bus.now))
    device = make_device(Firmware(status_rate=100.0), formats=(MIT, MIT_V3, MIT, MIT))
    device.run(bus, lambda: bus.now > 10.0)
    times = [now for now, frame_id in bus.sent]
    assert {frame_id for _, frame_id in bus.sent} == {MIT_V3.reply_id(2) & ID_BITS}
    assert len(times) == pytest.approx(900, abs=5)
    assert np.diff(times).min() > 0.009 and np.diff(times).max() == pytest.approx(1.0, abs=0.02)
