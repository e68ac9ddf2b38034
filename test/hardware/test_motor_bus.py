# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The motor bus with simulated motors: the order of its frames, and which frames are replies.

In virtual time, or on the bus that EXO_TEST_CAN_INTERFACE and EXO_TEST_CAN_CHANNEL name.
"""

import can
import numpy as np
import pytest
from can.interfaces.socketcan import SocketcanBus

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.ak import pack_reply
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT, SET_ZERO, MotorCommand, unpack_command
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import Send
from exo_gravity.core.safety.limits import DAMPING
from exo_gravity.hardware.can.can_port import CanPort, open_bus
from exo_gravity.hardware.can.motor_bus import CONTEST_TIME, HOLD_STIFFNESS, MotorBus
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.virtual_time import VirtualBus, Wire

from ..support.simulated_device import OFF, drive_of, frame, sending
from .wires import motor_bus, wire_for_test

AK60 = MOTORS["AK60-6"]
MOUNTED = (("AK60-6", 1, 0.0), ("AK80-9", -1, 0.4), ("AK60-6", 1, -0.2), ("AK60-6", 1, 0.0))
MOTORS_OF_ARM = tuple(JointMotor(MOTORS[name], n, *mounted) for n, (name, *mounted) in enumerate(MOUNTED, 1))
LINKS = ArmConfig().links
WEIGHTLESS = ArmModel(LINKS.length, LINKS.cog, LINKS.mass, gravity=0.0)  # stays in place, however slow the machine is
ON = drive_of(NO_TORQUE)


@pytest.fixture
def wire():
    with wire_for_test() as wire:
        yield wire


@pytest.fixture
def other(wire):
    """The test's end of the bus."""
    return wire.open()


@pytest.fixture
def bus(wire):
    return motor_bus(wire, MOTORS_OF_ARM)


def now(bus: MotorBus) -> float:
    return bus.clock.monotonic()


@pytest.fixture(params=[(False, 8), (False, 6), (True, 8), (True, 6)], ids=["own-8", "own-6", "master-8", "master-6"])
def device(request, wire):
    arm = SimulatedArm(ArmConfig(links=WEIGHTLESS))
    arm.reset((0.1, 0.2, 0.3, 0.4))
    device = SimulatedDevice(arm, [SimulatedMotor(joint, Firmware(*request.param)) for joint in MOTORS_OF_ARM])
    wire.play(device)
    return device


def received(bus: can.BusABC) -> list[tuple[int, bytes]]:
    frames = []
    while (message := bus.recv(0.0)) is not None:
        frames.append((message.arbitration_id, bytes(message.data)))
    return frames


def test_every_motor_is_read_in_joint_coordinates(bus, device):
    assert bus.exchange(OFF, now(bus) + 1.0)
    for sample, angle in zip(bus.samples, (0.1, 0.2, 0.3, 0.4), strict=True):
        assert sample.position == pytest.approx(angle, abs=0.01)


def test_a_bus_in_place_of_the_motors_ports_is_refused_at_once(other):
    with pytest.raises(ParameterError, match=r"ports = .*must be the port or None for each of 4 motors"):
        MotorBus(other, MOTORS_OF_ARM)
    with pytest.raises(ParameterError, match="ports"):
        MotorBus([None], MOTORS_OF_ARM)


def test_each_motor_gets_the_frames_that_it_is_to_be_sent(bus, other):
    idle = (1, MOTORS_OF_ARM[0].command(0.0, 0.0))
    frames = {Send.ENTER: [(1, ENTER)], Send.EXIT: [(1, EXIT)], Send.CLEAR: [(1, ENTER), idle], Send.POLL: [idle]}
    frames |= {Send.NOTHING: [], Send.CLEAR_ERROR: [idle]}  # an AK motor has no frame for it
    for send, expected in frames.items():
        bus.exchange(sending(send), now(bus))
        assert [frame for frame in received(other) if frame[0] == 1] == expected


def test_stop_sends_an_exit_twice_to_motors_that_were_to_be_off_and_nothing_to_others(bus, other):
    bus.exchange(ON._replace(send=(Send.COMMAND, Send.EXIT, Send.POLL, Send.NOTHING)), now(bus))
    received(other)
    bus.stop()
    assert [can_id for can_id, data in received(other) if data == EXIT] == [2, 3, 2, 3]


def commands(bus: can.BusABC, motor: JointMotor) -> list[MotorCommand]:
    """Return the commands to `motor` that were received."""
    sent = [data for can_id, data in received(bus) if can_id == motor.can_id and data[0] != motor.can_id]
    return [unpack_command(motor.spec, data) for data in sent if data != SET_ZERO]


def test_a_motor_that_another_sender_commands_holds_its_joint_for_a_while(bus, device, other):
    contested = MOTORS_OF_ARM[1]
    bus.exchange(ON, now(bus) + 1.0)
    end = now(bus) + CONTEST_TIME
    other.send(frame(2, contested.command(1.0, 0.0)))
    bus.receive_until(end, lambda: bus.foreign_commands > 0)
    received(other)
    bus.exchange(ON, now(bus) + 1.0)
    command = commands(other, contested)[-1]
    assert command.kp == pytest.approx(HOLD_STIFFNESS, rel=0.02)
    assert command.kd == pytest.approx(DAMPING, abs=0.01)
    assert command.position == pytest.approx(contested.motor_position(0.2), abs=0.01)
    bus.exchange(ON, now(bus) + 1.0)
    assert commands(other, MOTORS_OF_ARM[2])[-1].kp == 0.0
    stiffness = [command.kp]
    while bus.is_contested:
        received(other)
        bus.exchange(ON, now(bus) + 1.0)
        stiffness.append(commands(other, contested)[-1].kp)
        bus.receive_until(now(bus) + 0.002)
    assert max(-np.diff(stiffness)) < 0.02 * HOLD_STIFFNESS  # ended at once, it would be a torque step
    received(other)
    bus.exchange(ON, now(bus) + 1.0)
    assert commands(other, contested)[-1].kp == 0.0


def test_after_a_foreign_set_zero_the_motor_damps_and_does_not_hold(bus, device, other):
    bus.exchange(ON, now(bus) + 1.0)
    received(other)
    other.send(frame(2, SET_ZERO))
    bus.receive_until(now(bus) + 1.0, lambda: bus.foreign_commands > 0)
    for _ in range(3):
        bus.exchange(ON, now(bus) + 0.1)
    answers = commands(other, MOTORS_OF_ARM[1])
    assert {command.kp for command in answers} == {0.0}
    assert {command.kd for command in answers} == {DAMPING}


REPLY = pack_reply(AK60, 1, 0.25, 0.0, 0.0, 30, 0)


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        (frame(1, MOTORS_OF_ARM[0].command(1.0, 0.0)), "foreign command"),
        (frame(1, ENTER), "foreign command"),
        (frame(1, b""), "foreign command"),
        (frame(1, ENTER[:6]), "foreign command"),
        (frame(0x83, ENTER), "foreign frame"),
        (frame(2, REPLY), "foreign command"),
        (frame(9, REPLY), "foreign frame"),
        (frame(1, REPLY[:5]), "malformed reply"),
        (frame(0x2901, REPLY, is_extended_id=True), "servo mode"),
        (frame(0, b"\x09" + REPLY[1:]), "foreign frame"),
        (frame(1, REPLY, is_extended_id=True), "foreign frame"),
        (frame(1, REPLY, is_fd=True), "FD frame"),
        (can.Message(arbitration_id=1, dlc=8, is_remote_frame=True, is_extended_id=False), "foreign command"),
        (can.Message(arbitration_id=9, dlc=8, is_remote_frame=True, is_extended_id=False), "foreign frame"),
        (frame(1, REPLY, is_error_frame=True), "error frame"),
    ],
)
def test_a_frame_that_is_not_a_reply_is_counted_and_ignored(bus, other, message, kind):
    other.send(message)
    bus.exchange(OFF, now(bus))
    assert bus.samples[0].time == float("-inf")
    assert bus.ignored == {kind: 1}


@pytest.mark.parametrize(("length", "kind"), [(7, "foreign command"), (8, "foreign frame")])
def test_another_id_with_the_same_lowest_7_bits_commands_an_open_drive_alone(bus, other, length, kind):
    for message in (frame(1, REPLY[:length]), frame(0x81, ENTER), frame(0x701, b"\x05")):
        other.send(message)
    bus.exchange(OFF, now(bus))
    assert bus.ignored == {kind: 2}


@pytest.mark.parametrize("can_id", [0, 1])
@pytest.mark.parametrize("length", [6, 7, 8])
def test_a_reply_may_have_the_motors_id_or_the_masters(bus, other, can_id, length):
    other.send(frame(can_id, REPLY[:length]))
    bus.exchange(OFF, now(bus))
    assert bus.samples[0].position == pytest.approx(0.25, abs=0.0004)
    assert not bus.ignored


def test_a_late_reply_does_not_count_for_the_next_cycle(bus, other):
    for can_id in (1, 2, 3, 4):
        other.send(frame(can_id, bytes((can_id,)) + REPLY[1:]))
    assert not bus.exchange(OFF, now(bus))


def test_the_error_for_a_bus_that_cannot_be_opened_names_it():
    with pytest.raises(BusError, match="CAN bus nonsense can9"):
        open_bus("nonsense", "can9", {})


def test_an_arm_that_answers_another_host_is_noticed_while_listening(wire, bus):
    wire.repeat(frame(1, REPLY), 0.01)
    with pytest.raises(BusError, match="is in use: motor 1 replies to another host"):
        bus.listen()


COMMAND = MOTORS_OF_ARM[0].command(1.0, 0.0)
MARKED = frame(1, COMMAND, is_rx=False)  # as some buses mark an echo, and SocketCAN each frame from this computer


class MarkingBus(VirtualBus, SocketcanBus):
    """One end of a `Wire`, known by its type as SocketCAN is."""


def test_a_marked_command_is_an_echo_only_on_a_bus_that_marks_nothing_else() -> None:
    wire = Wire()
    assert CanPort(VirtualBus(wire), wire.clock).is_echo(MARKED)
    assert not CanPort(MarkingBus(wire), wire.clock).is_echo(MARKED)


def test_a_command_that_we_sent_is_an_echo_when_it_comes_back_once() -> None:
    wire = Wire(echoes=True)
    port = CanPort(wire.open(), wire.clock)
    port.send((1, COMMAND))
    (echo,) = port.waiting()
    assert port.is_echo(echo) and not port.is_echo(echo)
