# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Motors of V1, V2 and V3 boards on one bus: who is sent what, which frame is a reply, and who may still be on.

In virtual time, or on the bus that EXO_TEST_CAN_INTERFACE and EXO_TEST_CAN_CHANNEL name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import can
import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.frames import ENTER, EXIT, EXTENDED, ID_BITS, WireFormat
from exo_gravity.core.safety.drive import Send, State
from exo_gravity.core.safety.limits import DAMPING
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.hardware.control_loop import ControlLoop, NoController
from exo_gravity.sim import ArmConfig, Firmware, SimulatedDevice
from exo_gravity.sim.virtual_time import Wire

from ..support.simulated_device import OFF, drive_of, joints_of, make_device, sending
from .rig import CYCLE, LIMITS
from .test_motor_bus import WEIGHTLESS, now
from .wires import motor_bus, wire_for_test

MIXED = (MIT, MIT_V3, MIT_V3, MIT)
V3 = (MIT_V3,) * 4
ON = drive_of((0.0, 0.5, 0.4, 0.0))


@pytest.fixture
def wire() -> Iterator[Wire]:
    with wire_for_test() as wire:
        yield wire


@pytest.fixture
def other(wire: Wire) -> can.BusABC:
    """The test's end of the bus."""
    return wire.open()


@pytest.fixture
def start(wire: Wire) -> Callable[..., SimulatedDevice]:
    """A function that runs a weightless arm with boards of the given formats on the bus."""

    def start(formats: tuple[WireFormat, ...]) -> SimulatedDevice:
        config = ArmConfig(links=WEIGHTLESS, coulomb_friction=(5.0,) * 4)
        device = make_device(Firmware(status_rate=100.0), config=config, formats=formats)
        device.arm.reset((0.1, 0.2, 0.3, 0.4))
        wire.play(device)
        return device

    return start


def sent(bus: can.BusABC) -> list[tuple[int, bytes]]:
    """Return the commands on the bus so far, V3 boards' with `EXTENDED` in their ID."""
    frames = []
    while (message := bus.recv(0.0)) is not None:
        frame_id = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
        is_status = message.is_extended_id and message.arbitration_id >> 8 == 0x29
        if not is_status and message.data[0] != message.arbitration_id:
            frames.append((frame_id, bytes(message.data)))
    return frames


@pytest.mark.parametrize("formats", [MIXED, V3], ids=["mixed", "v3"])
def test_every_motor_is_read_and_a_v3_board_that_is_off_is_sent_only_its_exit(wire, other, start, formats) -> None:
    start(formats)
    bus = motor_bus(wire, joints_of(formats))
    bus.listen()
    sent(other)
    for _ in range(3):
        assert bus.exchange(OFF, now(bus) + 1.0)
        bus.exchange(sending(Send.EXIT), now(bus) + 1.0)
    for sample, angle in zip(bus.samples, (0.1, 0.2, 0.3, 0.4), strict=True):
        assert sample.position == pytest.approx(angle, abs=0.01)
        assert (sample.temperature, sample.error) == (30, 0)
    frames, boards = sent(other), [joint for joint in joints_of(formats) if joint.wire_format is MIT_V3]
    for joint in boards:  # a command would switch it on
        received = [frame for frame in frames if frame[0] >= EXTENDED and frame[0] & 0xFF == joint.can_id]
        assert received == list(joint.exit) * len(received)
        assert len(received) > 1
    assert not bus.ignored


def test_motors_of_both_formats_apply_their_torque_and_are_switched_off(wire, other, start) -> None:
    device, joints = start(MIXED), joints_of(MIXED)
    bus = motor_bus(wire, joints_of(MIXED))
    bus.exchange(sending(Send.ENTER), now(bus) + 1.0)
    for _ in range(3):
        assert bus.exchange(ON, now(bus) + 1.0)
    assert [motor.entered for motor in device.motors] == [True] * 4
    assert [sample.effort for sample in bus.samples] == pytest.approx(ON.effort, abs=0.02)
    sent(other)
    bus.exchange(sending(Send.EXIT), now(bus) + 1.0)
    assert sent(other) == [frame for joint in joints for frame in joint.exit]
    assert not device.powered


@pytest.mark.parametrize("mode", [0, 1, 5, 8])
def test_a_foreign_command_to_a_v3_board_is_counted_and_opposed(wire, other, mode) -> None:
    joints = joints_of(MIXED)
    bus = motor_bus(wire, joints_of(MIXED))
    bus.exchange(ON, now(bus))
    sent(other)
    other.send(can.Message(arbitration_id=mode << 8 | 2, data=bytes(8), is_extended_id=True))
    bus.receive_until(now(bus) + 1.0, lambda: bus.foreign_commands > 0)
    assert bus.foreign_commands == 1 and "commands motor 2" in bus.foreign_command
    [(command_id, data)] = sent(other)
    answer = joints[1].wire_format.unpack_command(joints[1].spec, data)
    assert command_id == joints[1].command_id
    assert answer.torque == pytest.approx(0.5, abs=0.2)
    assert answer.kd == pytest.approx(DAMPING, abs=0.01)
    assert bus.is_contested


def test_status_frames_are_not_taken_for_another_host_but_its_commands_are(wire, other, start) -> None:
    start(MIXED)
    bus = motor_bus(wire, joints_of(MIXED))
    bus.listen()
    message = can.Message(arbitration_id=0x803, data=bytes(8), is_extended_id=True)
    wire.repeat(message, 0.01)
    with pytest.raises(BusError, match="is in use: another sender commands motor 3"):
        bus.listen()


def test_a_broadcast_that_v3_boards_obey_is_opposed_at_each_of_them(wire, other) -> None:
    bus = motor_bus(wire, joints_of(MIXED))
    bus.exchange(ON, now(bus))
    sent(other)
    other.send(can.Message(arbitration_id=0x8FF, data=bytes(8), is_extended_id=True))
    bus.receive_until(now(bus) + CYCLE)
    reporting = [joint.command_id for joint in joints_of(MIXED) if not joint.wire_format.replies]
    assert sorted(frame_id for frame_id, _ in sent(other)) == sorted(reporting)
    assert bus.foreign_commands == len(reporting) == 2


def test_an_exit_that_was_not_ours_is_undone_on_both_kinds_of_board(wire, other) -> None:
    joints = joints_of(MIXED)
    bus = motor_bus(wire, joints_of(MIXED))
    bus.exchange(ON, now(bus))
    sent(other)
    other.send(can.Message(arbitration_id=1, data=EXIT, is_extended_id=False))
    other.send(can.Message(arbitration_id=0x102, data=bytes(4), is_extended_id=True))
    bus.receive_until(now(bus) + 1.0, lambda: bus.foreign_commands == 2)
    answers = sent(other)
    v3 = joints[1].command_id
    assert [frame_id for frame_id, _ in answers] == [1, 1, v3]
    assert answers[0] == (1, ENTER)  # then our commands, under damping


@pytest.mark.parametrize("formats", [(MIT,) * 4, V3], ids=["v2", "v3"])
def test_another_host_that_drives_motors_which_are_off_is_a_fault_until_it_stops(wire, other, start, formats) -> None:
    device, joint = start(formats), joints_of(formats)[1]
    bus = motor_bus(wire, joints_of(formats))
    loop = ControlLoop(bus, SafetyMachine(LIMITS, CYCLE), CYCLE, NoController())

    def run(seconds: float) -> None:
        end = now(bus) + seconds
        while now(bus) < end:
            loop.cycle()

    run(0.5)
    assert loop.safety.state is State.DISABLED and not device.powered
    for frame_id, data in (*joint.enter, (joint.command_id, joint.command(2.0, 0.0))):
        other.send(can.Message(arbitration_id=frame_id & ID_BITS, data=data, is_extended_id=frame_id >= EXTENDED))
    run(0.1)
    assert loop.safety.fault is not None and loop.safety.fault.code == "foreign_command"
    assert "another sender commands motor 2" in loop.safety.fault.reason
    assert not loop.safety.enable(now(bus))
    run(1.0)
    assert not device.powered
    assert loop.safety.clear(now(bus))
    run(1.0)
    assert loop.safety.fault is None and loop.safety.enable(now(bus))
