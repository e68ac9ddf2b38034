# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The motor bus with simulated motors: the order of its frames, which frames are replies, and who may still be on.

Motors of V1, V2 and V3 boards, and warm ones. In virtual time, or on the bus that EXO_TEST_CAN_INTERFACE and
EXO_TEST_CAN_CHANNEL name.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import can
import numpy as np
import pytest
from can.interfaces.socketcan import SocketcanBus

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.ak import MIT, MIT_V3, pack_reply
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import (
    ENTER,
    EXIT,
    EXTENDED,
    ID_BITS,
    SET_ZERO,
    MotorCommand,
    unpack_command,
)
from exo_gravity.core.motors.joint_motor import LARGEST_WARMING, JointMotor, JointSample
from exo_gravity.core.safety.drive import Send, State
from exo_gravity.core.safety.limits import DAMPING, Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.core.safety.trust import Readings
from exo_gravity.hardware.can.can_port import CanPort, open_bus
from exo_gravity.hardware.can.motor_bus import CONTEST_TIME, HOLD_STIFFNESS, WARMING, MotorBus
from exo_gravity.hardware.control_loop import ControlLoop, NoController
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.virtual_time import VirtualBus, Wire

from ..support.simulated_device import OFF, drive_of, frame, joints_of, sending
from ..support.thorough import quick
from .rig import CYCLE, LIMITS
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
    return play(wire, MOTORS_OF_ARM, Firmware(*request.param))


def play(wire, motors, firmware):
    """Play an arm that stays in its pose on the bus; return its device."""
    arm = SimulatedArm(ArmConfig(links=WEIGHTLESS, coulomb_friction=(10.0,) * 4))
    arm.reset((0.1, 0.2, 0.3, 0.4))
    device = SimulatedDevice(arm, [SimulatedMotor(joint, firmware) for joint in motors])
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


# Motors of V1, V2 and V3 boards on one bus.

MIXED = (MIT, MIT_V3, MIT_V3, MIT)
V3 = (MIT_V3,) * 4
CARRYING = drive_of((0.0, 0.5, 0.4, 0.0))


@pytest.fixture
def start(wire) -> Callable[..., SimulatedDevice]:
    """A function that runs an arm with boards of the given formats on the bus."""
    return lambda formats: play(wire, joints_of(formats), Firmware(status_rate=100.0))


@pytest.fixture
def mixed(wire) -> MotorBus:
    """The bridge's end of a bus with both kinds of boards."""
    return motor_bus(wire, joints_of(MIXED))


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


def test_motors_of_both_formats_apply_their_torque_and_are_switched_off(mixed, other, start) -> None:
    device, joints, bus = start(MIXED), joints_of(MIXED), mixed
    bus.exchange(sending(Send.ENTER), now(bus) + 1.0)
    for _ in range(3):
        assert bus.exchange(CARRYING, now(bus) + 1.0)
    assert [motor.entered for motor in device.motors] == [True] * 4
    assert [sample.effort for sample in bus.samples] == pytest.approx(CARRYING.effort, abs=0.02)
    sent(other)
    bus.exchange(sending(Send.EXIT), now(bus) + 1.0)
    assert sent(other) == [frame for joint in joints for frame in joint.exit]
    assert not device.powered


@pytest.mark.parametrize("mode", [0, 1, 5, 8])
def test_a_foreign_command_to_a_v3_board_is_counted_and_opposed(mixed, other, mode) -> None:
    joints, bus = joints_of(MIXED), mixed
    bus.exchange(CARRYING, now(bus))
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


def test_status_frames_are_not_taken_for_another_host_but_its_commands_are(wire, mixed, start) -> None:
    bus = mixed
    start(MIXED)
    bus.listen()
    message = can.Message(arbitration_id=0x803, data=bytes(8), is_extended_id=True)
    wire.repeat(message, 0.01)
    with pytest.raises(BusError, match="is in use: another sender commands motor 3"):
        bus.listen()


def test_a_broadcast_that_v3_boards_obey_is_opposed_at_each_of_them(mixed, other) -> None:
    bus = mixed
    bus.exchange(CARRYING, now(bus))
    sent(other)
    other.send(can.Message(arbitration_id=0x8FF, data=bytes(8), is_extended_id=True))
    bus.receive_until(now(bus) + CYCLE)
    reporting = [joint.command_id for joint in joints_of(MIXED) if not joint.wire_format.replies]
    assert sorted(frame_id for frame_id, _ in sent(other)) == sorted(reporting)
    assert bus.foreign_commands == len(reporting) == 2


def test_an_exit_that_was_not_ours_is_undone_on_both_kinds_of_board(mixed, other) -> None:
    joints, bus = joints_of(MIXED), mixed
    bus.exchange(CARRYING, now(bus))
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


# A bus full of foreign frames: only the motors' replies are read.
#
# A reply has 6, 7 or 8 bytes, of which only the first, the motor's ID, is known in advance. A foreign frame of that
# length, with that first byte and the arbitration ID of that motor or of the master, looks like a reply. Of random
# frames with random IDs these are 3/9 x 4/256 x 2/2048, five in a million; of random 8-byte frames with ID 0, one in
# 64. The last of these tests shows how the safety limits treat them.

IDS = {joint.can_id for joint in MOTORS_OF_ARM}
MASTER = 0
POSE = (0.1, 0.2, 0.3, 0.4)
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
FRAMES, BURST = 5_000, 10  # in total, and in a cycle: half of them wait for it
WORN_LIMITS = Limits(
    tuple("1234"), (-1.65, -0.17, -0.78, -0.17), (1.65, 3.14, 2.53, 3.14), (5.0,) * 4, (3.0, 9.0, 3.0, 3.0)
)


def foreign_frame(rng: random.Random) -> can.Message:
    """Return a frame of any kind; half of them resemble what a motor sends or receives."""
    near = rng.random() < 0.5
    can_id = rng.choice((MASTER, *IDS, 5, 127)) if near else rng.randrange(2048)
    data = rng.randbytes(rng.choice((5, 6, 7, 8)) if near else rng.randrange(9))
    if near and rng.random() < 0.3:
        data = bytes((rng.choice((*IDS, 5)),)) + data[1:]
    kind = rng.choice(("classic", "classic", "command", "extended", "remote", "error", "fd"))
    if kind == "command":
        joint = rng.choice(MOTORS_OF_ARM)
        special = rng.choice((ENTER, EXIT, SET_ZERO, joint.command(rng.uniform(-3, 3), rng.uniform(0, 5))))
        return can.Message(arbitration_id=joint.can_id, data=special, is_extended_id=False)
    if kind == "remote":
        return can.Message(arbitration_id=can_id, dlc=rng.randrange(9), is_remote_frame=True, is_extended_id=False)
    if kind == "fd":
        data = rng.randbytes(rng.choice(FD_LENGTHS))
        return can.Message(arbitration_id=can_id, data=data, is_fd=True, is_extended_id=False)
    if kind == "extended":
        can_id |= rng.getrandbits(18) << 11
    return can.Message(
        arbitration_id=can_id, data=data, is_extended_id=kind == "extended", is_error_frame=kind == "error"
    )


def looks_like_reply(message: can.Message) -> bool:
    """Return whether the frame has the layout of a motor's reply in the manual."""
    if message.is_extended_id or message.is_remote_frame or message.is_error_frame or message.is_fd:
        return False
    data = bytes(message.data)
    return len(data) in (6, 7, 8) and data[0] in IDS and message.arbitration_id in (MASTER, data[0])


def test_among_frames_of_every_kind_exactly_those_with_the_layout_of_a_reply_are_read() -> None:
    """The manual's layout is the independent reference."""
    wire, rng, found = Wire(), random.Random(3), Counter()
    bus = motor_bus(wire, MOTORS_OF_ARM)
    for _ in range(FRAMES // BURST):
        burst = [foreign_frame(rng) for _ in range(BURST)]
        before = list(bus.samples)
        for message in burst[: BURST // 2]:
            wire.carry(None, message)
        bus.exchange(OFF, wire.clock.monotonic())
        for message in burst[BURST // 2 :]:
            wire.carry(None, message)
        bus.receive_until(wire.clock.monotonic() + 0.001)
        replies = [message for message in burst if looks_like_reply(message)]
        changed = {joint + 1 for joint in range(4) if bus.samples[joint] is not before[joint]}
        assert changed == {message.data[0] for message in replies}
        found.update(reply=len(replies), foreign=BURST - len(replies))
        assert sum(bus.ignored.values()) == found["foreign"]
    assert found["reply"] > 20
    assert set(bus.ignored) == {"foreign command", "error frame", "FD frame", "foreign frame", "malformed reply"}


@pytest.mark.parametrize(("length", "most"), quick([(8, 0.0001)], [(8, 0.0001), (6, 0.005)]))
def test_a_forged_reply_with_random_values_is_nearly_always_a_fault(length, most):
    """At 250 cycles a second, with the arm at rest in `POSE`."""
    rng, count, unseen = random.Random(5), 20_000, 0
    before = [JointSample(angle, 0.0, 0.0, 30, 0, 1.0) for angle in POSE]
    for _ in range(count):
        joint = rng.randrange(4)
        sample = MOTORS_OF_ARM[joint].sample(bytes((joint + 1,)) + rng.randbytes(length - 1), 1.004)
        readings = Readings(WORN_LIMITS)
        for time in (0.996, 1.0):
            readings.step(time, [known._replace(time=time) for known in before], (False,) * 4)
        readings.step(1.004, [sample if n == joint else known for n, known in enumerate(before)], (False,) * 4)
        unseen += readings.joints[joint] is sample
    assert unseen / count <= most


# Motors whose torque depends on their temperature, judged by what the motors give.

SLOPE, EFFORT = -0.0015, (1.0, -4.0, 1.5, -0.8)
WARM_MOTORS = tuple(replace(motor, torque_scale=0.9, scale_slope=SLOPE) for motor in MOTORS_OF_ARM)
HALF_A_CODE = np.array([motor.spec.torque_range / 4095 * motor.torque_scale for motor in WARM_MOTORS])


class WarmBus(MotorBus):
    """The bus of a device that is locked in place, whose motors have `temperature` degC."""

    def __init__(self, temperature: float, firmware: Firmware | None = None) -> None:
        wire = Wire()
        self.device = play(wire, WARM_MOTORS, firmware)
        self.warm(temperature)
        super().__init__([CanPort(wire.open(), wire.clock)] * len(WARM_MOTORS), WARM_MOTORS, clock=wire.clock)
        self.exchange(sending(Send.ENTER), self.clock.monotonic() + 0.01)

    def warm(self, temperature: float) -> None:
        for motor in self.device.motors:
            motor.temperature = motor.ambient = temperature

    def cycle(self) -> np.ndarray:
        """Command EFFORT for a cycle of 10 ms; return the true torque (4,) in Nm."""
        end = self.clock.monotonic() + 0.01
        self.exchange(drive_of(EFFORT), end)
        self.receive_until(end)
        return np.array([motor.torque(0.0, 0.0) for motor in self.device.motors])


@pytest.mark.parametrize("temperature", [5.0, 25.0, 70.0])
def test_a_motor_of_any_temperature_gives_and_reports_the_torque_asked_for_within_half_a_code(temperature):
    bus = WarmBus(temperature)
    bus.cycle()
    true = bus.cycle()
    assert np.all(np.abs(true - EFFORT) <= 1.1 * HALF_A_CODE)
    reported = [sample.effort for sample in bus.samples]
    assert np.all(np.abs(np.subtract(reported, true)) <= 1.1 * HALF_A_CODE)


def test_a_motor_that_reports_no_temperature_gives_its_torque_at_25_degrees():
    bus = WarmBus(25.0, Firmware(reply_length=6))
    assert np.all(np.abs(bus.cycle() - EFFORT) <= 1.1 * HALF_A_CODE)
    bus.warm(65.0)
    np.testing.assert_allclose(bus.cycle() / EFFORT, 1.0 + SLOPE * 40.0, atol=0.01)


def test_a_reading_that_jumps_moves_the_torque_no_faster_than_a_motor_warms():
    bus = WarmBus(30.0)
    bus.cycle()
    commanded = [bus._motors[1].command(EFFORT[1], 0.0, temperature=t) for t in (30.0, 31.0)]
    bus.warm(215.0)  # as a sensor reads whose wire is broken
    for _ in range(100):
        bus.cycle()
    sent = bus._command(1, bus.clock.monotonic())[1]
    assert sent in commanded and WARMING == 1.0
    ratio = WARM_MOTORS[0].scale_at(215.0) / WARM_MOTORS[0].torque_scale
    assert ratio == pytest.approx(1.0 + SLOPE * LARGEST_WARMING)


@pytest.mark.parametrize(("name", "value"), [("scale_slope", 0.1), ("scale_temperature", 300.0)])
def test_a_slope_in_percent_or_a_temperature_in_kelvin_is_refused(name, value):
    with pytest.raises(ParameterError, match=f"torque_{name}"):
        JointMotor(WARM_MOTORS[0].spec, 1, **{name: value})
