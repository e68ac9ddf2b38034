# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a board says that is set up otherwise than its parameters say, told from its frames."""

from __future__ import annotations

import pytest

from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.boards import Boards
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import MALFORMED, SERVO
from exo_gravity.core.motors.joint_motor import JointMotor, JointSample

RATE = 400.0  # Hz of the control loop


def motors_of(board):
    return tuple(JointMotor(board.ranged(MOTORS["AK60-6"]), can_id, wire_format=board) for can_id in (1, 2, 3, 4))


def sample(time, temperature=25):
    return JointSample(0.0, 0.0, 0.0, temperature, 0, time)


def report(boards, rates, seconds):
    """Let each motor send `rates` (Hz) frames a second; return what hinders a start then."""
    times = [(count / rate, joint) for joint, rate in enumerate(rates) if rate for count in range(int(seconds * rate))]
    boards.hindrance(0.0, RATE)
    for time, joint in sorted(times):
        boards.take(joint, sample(time))
    return boards.hindrance(seconds, RATE)


def test_v3_boards_that_report_often_enough_hinder_no_start():
    assert report(Boards(motors_of(MIT_V3)), (500.0, 480.0, 420.0, 500.0), 2.0) == ""


@pytest.mark.parametrize("seconds", [0.7, 1.0, 3.0])
def test_a_v3_board_as_its_files_ship_it_reports_too_seldom(seconds):
    sentence = report(Boards(motors_of(MIT_V3)), (500.0, 500.0, 50.0, 500.0), seconds)
    assert sentence == (
        "motor 3 sends 50 status frames a second, rate = 400 needs at least that many: set 500 on its board"
    )


def test_a_v3_board_that_reports_only_when_asked_is_named_with_what_to_set():
    boards = Boards(motors_of(MIT_V3))
    assert report(boards, (500.0, 0.0, 500.0, 500.0), 1.0) == ""  # it may report once a second
    assert report(boards, (500.0, 0.0, 500.0, 500.0), 1.5).startswith(
        "motor 2 sends no status frame: switch its supply"
    )


def test_a_v1_board_that_does_not_reply_is_left_to_the_state_machine():
    assert report(Boards(motors_of(MIT)), (250.0, 0.0, 0.0, 0.0), 3.0) == ""


def test_a_malformed_reply_is_shown_until_the_motor_replies_or_falls_silent():
    boards = Boards(motors_of(MIT))
    boards.heard(2, MALFORMED, (3, bytes.fromhex("0380017ff8")), 1.0)
    expected = "motor 3 sent 5 bytes [03 80 01 7f f8] as its reply: must be 6, 7 or 8 bytes"
    assert boards.hindrance(1.5, RATE) == expected
    assert boards.hindrance(2.1, RATE) == ""
    boards.heard(2, MALFORMED, (3, b"\x03"), 3.0)
    boards.take(2, sample(3.1))
    assert boards.hindrance(3.2, RATE) == ""


def test_a_motor_that_sends_status_frames_in_place_of_replies_is_told_what_to_set():
    boards = Boards(motors_of(MIT))
    boards.heard(0, SERVO, (0x2901, bytes(8)), 1.0)
    assert boards.hindrance(1.1, RATE).startswith("motor 1 does not reply, but sends status frames: set it to MIT mode")


@pytest.mark.parametrize(
    ("temperatures", "odd"),
    [
        ((24, 25, 26, 27), ""),
        ((-15, 25, 26, 27), "motor 1 read -15 degC when it was switched on, the others 25 to 27"),
        ((-15, -15, -16, -14), "motor 1 read -15 degC when it was switched on, the others -16 to -14"),
        ((25, 25, 66, 27), "motor 3 read 66 degC when it was switched on, the others 25 to 27"),
        ((64, 70, 30, 30), ""),  # they have worked before
        ((None, None, None, None), ""),  # of 6 bytes
        ((None, -15, None, None), "motor 2 read -15 degC when it was switched on: a cold motor"),
    ],
)
def test_a_motor_that_is_switched_on_must_read_room_temperature(temperatures, odd):
    boards = Boards(motors_of(MIT))
    for joint, temperature in enumerate(temperatures):
        boards.take(joint, sample(1.0, temperature))
        boards.take(joint, sample(1.1, 80))  # later ones do not matter
    assert boards.odd_temperature.startswith(odd) and bool(boards.odd_temperature) is bool(odd)


def test_a_motor_that_was_switched_off_and_on_is_read_again():
    boards = Boards(motors_of(MIT))
    boards.take(0, sample(1.0))
    assert boards.odd_temperature == ""
    boards.take(0, sample(9.0, -15))
    assert "motor 1 read -15 degC" in boards.odd_temperature
