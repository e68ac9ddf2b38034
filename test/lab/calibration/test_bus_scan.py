# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Who answers on a bus, found without moving a motor; in virtual time."""

from __future__ import annotations

import os
from pathlib import Path

import can
import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.damiao import DAMIAO_MIT, LAST_ID, REFRESH, REGISTERS
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import DAMPED, ENTER, SET_ZERO, unpack_command
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.hardware import bus_lock
from exo_gravity.hardware.bus_lock import BusLock
from exo_gravity.lab.calibration.motors import BusScan
from exo_gravity.sim import Firmware, SimulatedArm, SimulatedDevice
from exo_gravity.sim.motors import simulated
from exo_gravity.sim.virtual_time import Wire

from ...hardware.arms import Responder
from ...support.simulated_device import SPECS, frame, make_device

ADDRESS = ("wire", f"of process {os.getpid()}", {})


@pytest.fixture(autouse=True)
def notes_of_buses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus_lock, "FOLDERS", (tmp_path,))


@pytest.fixture
def wire() -> Wire:
    return Wire()


def scan_of(wire: Wire) -> BusScan:
    return BusScan(ADDRESS, wire.clock, wire.open)


@pytest.mark.parametrize("firmware", [Firmware(), Firmware(reply_to_master=True, reply_length=6)])
def test_every_motor_is_found_with_its_reply_length_and_angle(wire: Wire, firmware: Firmware) -> None:
    device = make_device(firmware, ids=(1, 126, 7, 40))
    device.encoder_error = (0.5, -0.2, 1.0, 0.0)
    wire.play(device)
    with scan_of(wire) as bus:
        answers, problems = bus.scan((1, 2, 7, 39, 40, 41, 126))
    assert problems == ()
    assert [answer.can_id for answer in answers] == [1, 7, 40, 126]
    assert {answer.reply_length for answer in answers} == {firmware.reply_length}
    assert {answer.reply_id for answer in answers} == ({0} if firmware.reply_to_master else {1, 7, 40, 126})
    assert [answer.position for answer in answers] == pytest.approx([0.5, 1.0, 0.0, -0.2], abs=0.02)
    assert answers[0].temperature == (None if firmware.reply_length == 6 else 30)
    assert answers[0].error == (None if firmware.reply_length == 6 else 0)


def test_the_scan_sends_only_commands_of_damping_without_torque(wire: Wire) -> None:
    listener = Responder(wire)
    with scan_of(wire) as bus:
        bus.scan()
    asked = [message for message in listener.received if message.arbitration_id == REGISTERS]
    commands = [message for message in listener.received if message.arbitration_id != REGISTERS]
    assert {message.arbitration_id for message in commands} == set(range(1, 127))
    assert {bytes(message.data) for message in commands} == {DAMPED}
    assert {(message.data[0], message.data[2]) for message in asked} == {(i, REFRESH) for i in range(1, LAST_ID + 1)}
    assert DAMPED not in (ENTER, SET_ZERO)
    for spec in SPECS:
        command = unpack_command(spec, DAMPED)
        assert (command.kp, command.kd) == (0.0, 5.0)
        assert abs(command.torque) < 0.005


@pytest.mark.parametrize("is_fd", [False, True], ids=["classic", "fd"])
def test_the_motors_of_all_families_are_found_and_none_is_commanded(wire: Wire, is_fd: bool) -> None:
    joints = [
        *(JointMotor(MOTORS["DM-J4310"], can_id, wire_format=DAMIAO_MIT, timeout=0.2) for can_id in (1, 3)),
        JointMotor(MOTORS["DM-J8009"], 8, wire_format=DAMIAO_MIT, timeout=0.2, master_id=0x2A),
        JointMotor(MOTORS["AK80-64"], 2),
    ]
    device = SimulatedDevice(SimulatedArm(), [simulated(joint) for joint in joints])
    device.is_fd = (is_fd,) * len(joints)
    device.encoder_error = (0.5, -0.2, 1.0, 0.0)
    wire.play(device)
    with BusScan((*ADDRESS[:2], {"fd": is_fd}), wire.clock, wire.open) as bus:
        answers, problems = bus.scan(range(1, 20))
        polled = bus.poll((1, 2, 3, 8))
    assert problems == ()
    found = {answer.can_id: (answer.board.family, answer.board.name, answer.reply_id) for answer in answers}
    assert found == {
        1: ("damiao", "mit", 0x11),
        2: ("ak", "mit", 2),
        3: ("damiao", "mit", 0x13),
        8: ("damiao", "mit", 0x2A),
    }
    assert [polled[can_id].position for can_id in (1, 3, 8)] == pytest.approx([0.5, -0.2, 1.0], abs=0.02)
    assert not device.powered


def test_two_motors_with_one_id_are_reported(wire: Wire) -> None:
    other = make_device(ids=(4, 5, 6, 7))
    other.encoder_error = (1.0, 0.0, 0.0, 0.0)
    wire.play(make_device())
    wire.play(other)
    with scan_of(wire) as bus:
        answers, problems = bus.scan(range(1, 9))
    assert [answer.can_id for answer in answers] == [1, 2, 3, 4, 5, 6, 7]
    (problem,) = problems
    assert problem.startswith("ID 4: several replies to one command: two motors share it")
    assert "1.00 rad" in problem


@pytest.mark.parametrize(
    ("reply", "period", "problem"),
    [
        *(
            (
                frame(can_id, bytes(data)),
                0.0,
                f"ID 3: a frame with ID {can_id} [{bytes(data).hex(' ')}] follows a command",
            )
            for can_id, data in (
                (3, (3, 1, 2, 3, 4)),
                (3, (9, 0x80, 0, 0x80, 8, 0)),
                (77, (3, 0x80, 0, 0x80, 8, 0)),
            )
        ),
        # As a V1 or V2 board is delivered.
        (
            frame(0x2903, bytes(8), is_extended_id=True),
            0.02,
            "ID 3: about 50 status frames a second: a V1 or V2 board in servo mode",
        ),
        (frame(0x29C8, bytes(8), is_extended_id=True), 0.01, "ID 200: a V3 board; its ID must be from 1 to 126"),
    ],
)
def test_a_reply_that_fits_no_motor_and_a_board_that_cannot_be_used_are_reported(
    wire: Wire, reply: can.Message, period: float, problem: str
) -> None:
    if period:
        wire.clock.every(period, lambda: wire.carry(None, reply))
    else:
        Responder(wire, lambda message: [reply] if message.arbitration_id == 3 else [])
    with scan_of(wire) as bus:
        answers, (said,) = bus.scan(range(1, 6))
    assert (answers == () or period) and said.startswith(problem)
    assert said.endswith((", and is no motor's reply", "or a V3 board, to be set to 500 a second", "from 1 to 126"))


def test_a_late_reply_is_not_taken_for_a_second_motor(wire: Wire) -> None:
    reply = frame(3, bytes((3, 0x80, 0, 0x80, 8, 0)))
    asked: list[can.Message] = []

    def late(message: can.Message) -> list[can.Message]:
        if message.arbitration_id != 3:
            return []
        asked.append(message)
        return [reply, reply] if len(asked) == 2 else []

    Responder(wire, late)
    with scan_of(wire) as bus:
        answers, problems = bus.scan(range(1, 6))
    assert [answer.can_id for answer in answers] == [3]
    assert problems == ()


def test_a_bus_that_a_bridge_holds_or_has_left_with_motors_on_is_refused_and_free_after_a_scan(wire: Wire) -> None:
    lock = BusLock(ADDRESS, "/right/can_bridge (PID 4711)")
    with pytest.raises(BusError, match=r"is held by /right/can_bridge \(PID 4711\)"):
        scan_of(wire)
    lock.release()
    for _ in range(2):
        scan_of(wire).close()
    lock = BusLock(ADDRESS, "a bridge")
    lock.notes.note(lock.notes.command._replace(powered=True))
    lock.release()
    with pytest.raises(BusError, match="may have left the motors on: start can_bridge"):
        scan_of(wire)
    BusLock(ADDRESS, "a bridge").release()


@pytest.mark.parametrize(
    ("command", "can_id"), [(frame(2, DAMPED), 2), (frame(0x0803, bytes(8), is_extended_id=True), 2051)]
)
def test_a_bus_on_which_another_host_commands_a_motor_is_refused(wire: Wire, command: can.Message, can_id: int) -> None:
    wire.clock.every(0.01, lambda: wire.carry(None, command))
    with pytest.raises(BusError, match=f"a frame with ID {can_id} was heard"):
        scan_of(wire)


def test_motors_of_both_formats_are_found_on_one_bus_and_the_v3_boards_are_sent_nothing(wire: Wire) -> None:
    device = make_device(Firmware(status_rate=100.0), formats=(MIT, MIT_V3, MIT, MIT_V3))
    device.encoder_error = (0.5, -0.2, 1.0, 0.3)
    wire.play(device)
    listener = Responder(wire)
    with scan_of(wire) as bus:
        answers, problems = bus.scan(range(1, 7))
        polled = bus.poll((1, 2, 3, 4))
    assert problems == ()
    assert [(answer.can_id, answer.board.name) for answer in answers] == [
        (1, "mit"), (2, "mit_v3"), (3, "mit"), (4, "mit_v3"),
    ]  # fmt: skip
    assert [answer.position for answer in answers] == pytest.approx([0.5, -0.2, 1.0, 0.3], abs=0.02)
    assert (answers[1].temperature, answers[1].error, answers[1].reply_id) == (30, 0, 0x2902)
    assert sorted(polled) == [1, 2, 3, 4]
    sent = {message.arbitration_id for message in listener.received if bytes(message.data) == DAMPED}
    assert sent == {1, 3, 5, 6}
    assert not device.powered
