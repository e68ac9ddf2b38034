# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The motor bus with simulated motors: the order of its frames, which frames are replies, and who may still be on.

Motors of V1, V2 and V3 boards, and warm ones.
"""

from dataclasses import replace

import can
import numpy as np
import pytest
from can.interfaces.socketcan import SocketcanBus

from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import MIT, MIT_V3, pack_reply
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import (
    ENTER,
    EXIT,
    EXTENDED,
    SET_ZERO,
    MotorCommand,
    unpack_command,
)
from exo_gravity.core.motors.joint_motor import LARGEST_WARMING, JointMotor
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.safety.command import Command, Send, State
from exo_gravity.core.safety.limits import DAMPING
from exo_gravity.hardware.can_port import CanPort
from exo_gravity.hardware.motor_bus import CONTEST_TIME, HOLD_STIFFNESS, WARMING, MotorBus
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.virtual_time import VirtualBus, Wire

from ..support.simulated_device import OFF, command_of, frame, joints_of, sending
from .arms import CarriedArm, motor_bus

AK60 = MOTORS["AK60-6"]
MOUNTED = (("AK60-6", 1, 0.0), ("AK80-9", -1, 0.4), ("AK60-6", 1, -0.2), ("AK60-6", 1, 0.0))
MOTORS_OF_ARM = tuple(JointMotor(MOTORS[name], n, *mounted) for n, (name, *mounted) in enumerate(MOUNTED, 1))
LINKS = ArmConfig().links
WEIGHTLESS = ArmModel(LINKS.length, LINKS.cog, LINKS.mass, gravity=0.0)  # stays in place, however slow the machine is
ON = command_of(NO_TORQUE)
POSE = (0.1, 0.2, 0.3, 0.4)  # rad


@pytest.fixture
def wire():
    return Wire()


@pytest.fixture
def other(wire):
    """The test's end of the bus."""
    return wire.open()


@pytest.fixture
def bus(wire):
    return motor_bus(wire, MOTORS_OF_ARM)


def now(bus: MotorBus) -> float:
    return bus.clock.monotonic()


@pytest.fixture
def device(wire):
    return play(wire, MOTORS_OF_ARM, Firmware())


def play(wire, motors, firmware):
    """Play an arm that stays in its pose on the bus; return its device."""
    arm = SimulatedArm(ArmConfig(links=WEIGHTLESS, coulomb_friction=(10.0,) * 4))
    arm.reset(POSE)
    device = SimulatedDevice(arm, [SimulatedMotor(joint, firmware) for joint in motors])
    wire.play(device)
    return device


def sent(bus: can.BusABC) -> list[tuple[int, bytes]]:
    """Return the commands on the bus so far, V3 boards' with `EXTENDED` in their ID."""
    frames = []
    while (message := bus.recv(0.0)) is not None:
        frame_id = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
        is_status = message.is_extended_id and message.arbitration_id >> 8 == 0x29
        if not is_status and message.data[0] != message.arbitration_id:
            frames.append((frame_id, bytes(message.data)))
    return frames


def test_each_motor_gets_the_frames_that_it_is_to_be_sent(bus, other):
    idle = (1, MOTORS_OF_ARM[0].command(0.0, 0.0))
    frames = {Send.ENTER: [(1, ENTER)], Send.EXIT: [(1, EXIT)], Send.CLEAR: [(1, ENTER), idle], Send.POLL: [idle]}
    frames |= {Send.NOTHING: [], Send.CLEAR_ERROR: [idle]}  # an AK motor has no frame for it
    for send, expected in frames.items():
        bus.exchange(sending(send), now(bus))
        assert [frame for frame in sent(other) if frame[0] == 1] == expected


def test_stop_sends_an_exit_twice_to_motors_that_were_to_be_off_and_nothing_to_others(bus, other):
    bus.exchange(ON._replace(send=(Send.COMMAND, Send.EXIT, Send.POLL, Send.NOTHING)), now(bus))
    sent(other)
    bus.stop()
    assert [can_id for can_id, data in sent(other) if data == EXIT] == [2, 3, 2, 3]


def commands(bus: can.BusABC, motor: JointMotor) -> list[MotorCommand]:
    """Return the commands to `motor` that were received."""
    commanded = [data for can_id, data in sent(bus) if can_id == motor.can_id and data != SET_ZERO]
    return [unpack_command(motor.spec, data) for data in commanded]


def answer(bus: MotorBus, other: can.BusABC, motor: JointMotor) -> MotorCommand:
    """Return the command to `motor` of one more cycle."""
    sent(other)
    bus.exchange(ON, now(bus) + 1.0)
    return commands(other, motor)[-1]


def test_a_motor_that_another_sender_commands_holds_its_joint_for_a_while(bus, device, other):
    contested, end = MOTORS_OF_ARM[1], now(bus) + CONTEST_TIME
    bus.exchange(ON, now(bus) + 1.0)
    other.send(frame(2, contested.command(1.0, 0.0)))
    bus.receive_until(end, lambda: bus.foreign_commands > 0)
    command = answer(bus, other, contested)
    held = contested.motor_position(0.2), HOLD_STIFFNESS, DAMPING
    assert (command.position, command.kp, command.kd) == pytest.approx(held, rel=0.02, abs=0.01)
    assert answer(bus, other, MOTORS_OF_ARM[2]).kp == 0.0
    stiffness = [command.kp]
    while bus.is_contested:
        stiffness.append(answer(bus, other, contested).kp)
        bus.receive_until(now(bus) + 0.002)
    assert max(-np.diff(stiffness)) < 0.02 * HOLD_STIFFNESS  # ended at once, it would be a torque step
    assert answer(bus, other, contested).kp == 0.0


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


def test_a_late_reply_does_not_count_for_the_next_cycle(bus, other):
    for can_id in (1, 2, 3, 4):
        other.send(frame(can_id, bytes((can_id,)) + REPLY[1:]))
    assert not bus.exchange(OFF, now(bus))


def test_an_arm_that_answers_another_host_is_noticed_while_listening(wire, bus):
    wire.clock.every(0.01, lambda: wire.carry(None, frame(1, REPLY)))
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


# Motors of V1, V2 and V3 boards on one bus.

MIXED = (MIT, MIT_V3, MIT_V3, MIT)
V3 = (MIT_V3,) * 4
CARRYING = command_of((0.0, 0.5, 0.4, 0.0))


REPLYING = [(reply, length) for reply in (False, True) for length in (8, 7, 6)]
BOARDS = [(MIXED, Firmware(status_rate=100.0)), (V3, Firmware(status_rate=100.0))]
BOARDS += [((MIT,) * 4, Firmware(*of_master)) for of_master in REPLYING]


@pytest.mark.parametrize(("formats", "firmware"), BOARDS)
def test_every_motor_is_read_and_a_v3_board_that_is_off_is_sent_only_its_exit(wire, other, formats, firmware) -> None:
    mounted = zip(joints_of(formats), MOUNTED, strict=True)
    joints = [replace(joint, direction=direction, zero=zero) for joint, (_, direction, zero) in mounted]
    play(wire, joints, firmware)
    bus = motor_bus(wire, joints)
    bus.listen()
    sent(other)
    for _ in range(3):
        assert bus.exchange(OFF, now(bus) + 1.0)
        bus.exchange(sending(Send.EXIT), now(bus) + 1.0)
    assert [sample.position for sample in bus.samples] == pytest.approx(POSE, abs=0.01)
    assert {sample.error for sample in bus.samples} <= {0, None}
    frames, boards = sent(other), [joint for joint in joints if joint.wire_format is MIT_V3]
    for joint in boards:  # a command would switch it on
        own = [frame for frame in frames if frame[0] >= EXTENDED and frame[0] & 0xFF == joint.can_id]
        assert len(own) > 1 and own == list(joint.exit) * len(own)
    assert not bus.ignored


# Foreign frames, and the IDs of the frames that oppose them.
@pytest.mark.parametrize("wire_format", [MIT, MIT_V3], ids=["v2", "v3"])
def test_another_host_that_drives_motors_which_are_off_is_a_fault_until_it_stops(wire_format) -> None:
    arm = CarriedArm(joints_of((wire_format,) * 4))
    joint = arm.on_bus.motors[1]
    arm.run(0.5)
    assert arm.state is State.DISABLED and not arm.device.powered
    for foreign in (*joint.enter, (joint.command_id, joint.command(2.0, 0.0))):
        arm.send(foreign)
    arm.run(0.1)
    assert arm.fault == "foreign_command" and "another sender commands motor 2" in arm.safety.fault.reason
    assert not arm.safety.enable(arm.now)
    arm.run(1.0)
    assert not arm.device.powered and arm.safety.clear(arm.now)
    arm.run(1.0)
    assert not arm.fault and arm.safety.enable(arm.now)


# Motors whose torque depends on their temperature, judged by what the motors give.

SLOPE, EFFORT = -0.0015, (1.0, -4.0, 1.5, -0.8)
WARM = command_of(EFFORT)
WARM_MOTORS = tuple(replace(motor, torque_scale=0.9, scale_slope=SLOPE) for motor in MOTORS_OF_ARM)
HALF_A_CODE = np.array([motor.spec.torque_range / 4095 * motor.torque_scale for motor in WARM_MOTORS])


class WarmBus(MotorBus):
    """The bus of a device that is locked in place."""

    def __init__(self, firmware: Firmware | None = None) -> None:
        wire = Wire()
        self.device, self.heard = play(wire, WARM_MOTORS, firmware), wire.open()
        super().__init__([CanPort(wire.open(), wire.clock)] * len(WARM_MOTORS), WARM_MOTORS, clock=wire.clock)

    def cycle(self, temperature: float, command: Command = WARM) -> np.ndarray:
        """Send a command for a cycle of 10 ms at a temperature in degC; return the true torque (4,) in Nm."""
        for motor in self.device.motors:
            motor.temperature = motor.ambient = temperature
        end = self.clock.monotonic() + 0.01
        self.exchange(command, end)
        self.receive_until(end)
        return np.array([motor.torque(0.0, 0.0) for motor in self.device.motors])


@pytest.mark.parametrize("temperature", [5.0, 25.0, 70.0])
def test_a_motor_of_any_temperature_gives_and_reports_the_torque_asked_for_within_half_a_code(temperature):
    bus = WarmBus()
    for command in (sending(Send.ENTER), WARM):
        bus.cycle(temperature, command)
    true = bus.cycle(temperature)
    reported = np.array([sample.effort for sample in bus.samples])
    assert np.all(np.abs((true - EFFORT, reported - true)) <= 1.1 * HALF_A_CODE)
    bus = WarmBus(Firmware(reply_length=6))  # which reports none: as at 25 degC
    bus.cycle(temperature, sending(Send.ENTER))
    np.testing.assert_allclose(bus.cycle(temperature) / EFFORT, 1.0 + SLOPE * (temperature - 25.0), atol=0.01)


def test_a_reading_that_jumps_moves_the_torque_no_faster_than_a_motor_warms():
    bus = WarmBus()
    for command in (sending(Send.ENTER), WARM):
        bus.cycle(30.0, command)
    for _ in range(100):
        bus.cycle(215.0)  # as a sensor reads whose wire is broken
    last = [data for can_id, data in sent(bus.heard) if can_id == 2][-1]
    assert last in [WARM_MOTORS[1].command(EFFORT[1], 0.0, temperature=t) for t in (30.0, 31.0)] and WARMING == 1.0
    ratio = WARM_MOTORS[0].scale_at(215.0) / WARM_MOTORS[0].torque_scale
    assert ratio == pytest.approx(1.0 + SLOPE * LARGEST_WARMING)
