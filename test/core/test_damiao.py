# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Damiao motors' frames and registers, and the parameters of a motor of any family.

Bytes are worked out by hand from the documents that core/motors/damiao.py names, or come from public drivers.
"""

from __future__ import annotations

import json
import re
import struct
from dataclasses import replace
from pathlib import Path

import pytest

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.motors.ak import unpack_reply
from exo_gravity.core.motors.boards import CHECK, Boards
from exo_gravity.core.motors.damiao import DAMIAO_MIT, PMAX, TIMEOUT, TMAX
from exo_gravity.core.motors.families import FAMILIES, MOTORS, format_of
from exo_gravity.core.motors.frames import COMMAND, ELSEWHERE, MALFORMED, OTHER, REPLY, SETTING, pack_command
from exo_gravity.core.motors.joint_motor import JointMotor, JointSample, Traffic, motors_of, traffic_of
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, limits_of

PUBLIC = json.loads((Path(__file__).parents[1] / "data" / "motor_frames.json").read_text())
DRIVERS_OWN = {"AK60-6": {"velocity_range": 50.0}}  # ranges that the public driver has otherwise
DM4310, DM8009 = MOTORS["DM-J4310"], MOTORS["DM-J8009"]
REPLY_IDS = {1: 0x11, 2: 0x12, 8: 0x18}


def motor(spec=DM4310, can_id=1, timeout=0.2, **changes):
    return JointMotor(spec, can_id, wire_format=DAMIAO_MIT, timeout=timeout, **changes)


@pytest.mark.parametrize("name", PUBLIC["ak"])
def test_a_public_driver_reads_the_same_in_the_replies_of_every_ak_motor(name):
    spec = replace(MOTORS[name], **DRIVERS_OWN.get(name, {}))
    for data, *state, temperature, error in PUBLIC["ak"][name]:
        reply = unpack_reply(spec, bytes.fromhex(data))
        assert reply[1:4] == pytest.approx(state, abs=1e-6)
        assert (reply.temperature, reply.error) == (temperature - 40, error)


@pytest.mark.parametrize("name", PUBLIC["damiao"]["replies"])
def test_a_public_driver_reads_the_same_in_the_replies_of_every_damiao_motor(name):
    for data, can_id, state, *readings, mosfet, coil in PUBLIC["damiao"]["replies"][name]:
        reply = DAMIAO_MIT.unpack_reply(MOTORS[name], can_id, bytes.fromhex(data))
        assert reply[1:4] == pytest.approx(readings, abs=1e-6)
        assert reply.motor_id == can_id and reply.temperature == max(mosfet, coil)
        assert reply.error == (state if state > 1 else 0)
        assert DAMIAO_MIT.says_on(bytes.fromhex(data)) == (state == 1)


@pytest.mark.parametrize("name", PUBLIC["damiao"]["commands"])
def test_a_public_driver_sends_the_same_commands_but_for_its_truncation(name):
    for *values, expected in PUBLIC["damiao"]["commands"][name]:
        ours, theirs = pack_command(MOTORS[name], *values), bytes.fromhex(expected)
        for shift, bits in ((48, 16), (36, 12), (24, 12), (12, 12), (0, 12)):
            codes = [int.from_bytes(data, "big") >> shift & (1 << bits) - 1 for data in (ours, theirs)]
            assert codes[0] - codes[1] in (0, 1)


def test_a_command_and_a_reply_have_the_bytes_worked_out_by_hand():
    # position 0 -> 32768, velocity 0 -> 2048, kp 0, kd 4095, torque 3 of +-10: 13 / 20 x 4095 = 2661.75 -> 2662
    assert DAMIAO_MIT.pack_command(DM4310, 0.0, 0.0, 0.0, 5.0, 3.0) == bytes.fromhex("8000800000fffa66")
    # on (1), motor 3, position 0xffff -> 12.5, velocity 0 -> -30, torque 4095 -> 10, MOSFET 40, coil 55 degC
    reply = DAMIAO_MIT.unpack_reply(DM4310, 3, bytes.fromhex("13 ffff 000fff 28 37"))
    assert reply == (3, *(pytest.approx(value) for value in (12.5, -30.0, 10.0)), 55, 0)


@pytest.mark.parametrize(("state", "on", "error"), [(0, False, 0), (1, True, 0), (0xD, False, 0), (0xE, False, 0xE)])
def test_a_reply_says_whether_the_motor_is_on_and_a_lost_command_is_no_defect(state, on, error):
    sample = motor(can_id=2, direction=-1).sample(bytes((state << 4 | 2, 0x80, 0, 0x80, 0x08, 0, 30, 31)), 1.0)
    assert (sample.on, sample.error, sample.temperature, sample.time) == (on, error, 31, 1.0)
    assert bool(sample.trouble) == (state > 1)


def test_a_reply_of_another_length_is_refused_with_its_bytes():
    with pytest.raises(FrameError, match=r"frame \[01 02\]: must be a reply of 8 bytes"):
        DAMIAO_MIT.unpack_reply(DM4310, 1, b"\x01\x02")


STATE = bytes((0x11, 0x80, 0, 0x80, 0x08, 0, 30, 30))
ANSWER = bytes((1, 0, 0x33, 21)) + struct.pack("<f", 12.5)


@pytest.mark.parametrize(
    ("frame_id", "data", "expected"),
    [
        (0x11, STATE, (REPLY, 1)),
        (0x11, ANSWER, (SETTING, 1)),
        (0x11, STATE[:7], (MALFORMED, 1)),
        (0x21, STATE, (ELSEWHERE, 1)),
        (0x18, bytes((0x18, *STATE[1:])), (REPLY, 8)),
        (0x19, bytes((0x19, *STATE[1:])), (OTHER, 0)),  # another device's motor 9
        (0x01, STATE, (COMMAND, 1)),
        (0x101, bytes(8), (COMMAND, 1)),  # another control mode
        (0x702, b"", (COMMAND, 2)),
        (0x7FF, bytes((1, 0, 0x33, 21, 0, 0, 0, 0)), (OTHER, 0)),  # a question
        (0x7FF, bytes((1, 0, 0x55, 23, 0, 0, 0, 0)), (COMMAND, 1)),  # changes what a torque means
        (0x7FF, bytes((9, 0, 0x55, 23, 0, 0, 0, 0)), (OTHER, 0)),
        (1 << 31 | 1, STATE, (OTHER, 0)),
    ],
)
def test_a_frame_is_what_a_motor_would_take_it_for(frame_id, data, expected):
    assert DAMIAO_MIT.classify(frame_id, data, REPLY_IDS) == expected


def parameters(**given):
    usual = {"motor": ["DM-J8009", "DM-J8009", "DM-J4340", "DM-J4310"], "motor_timeout": [0.2] * 4}
    return values_of(CAN_BRIDGE, {"can.interface": "socketcan", "can.channel": "can0", **usual, **given})


def test_damiao_motors_need_no_more_than_their_names_and_time_outs():
    motors = motors_of(parameters())
    assert [motor.reply_id for motor in motors] == [0x11, 0x12, 0x13, 0x14]
    assert [motor.spec.torque_range for motor in motors] == [54.0, 54.0, 28.0, 10.0]
    assert limits_of(parameters()).home_tolerance == (0.5,) * 4  # an encoder at the output: no ambiguity


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"motor_timeout": [0.0] * 4}, r"motor_timeout = 0\.0: must be from 0\.15 to 0\.5 s"),
        ({"can_id": [1, 2, 3, 16]}, "can_id = 16: must be a whole number from 1 to 15"),
        ({"wire_format": ["mit_v3"] * 4}, "wire_format = 'mit_v3': must be mit for a DM-J8009"),
        ({"master_id": [0x101, 0, 0, 0]}, "master_id = 257: must be .* without the last two hexadecimal digits of can"),
        ({"master_id": [2, 0, 0, 0]}, "master_id = 2: must be without the lowest 8 bits of motor 2, which would obey"),
        (
            {"torque_range": [540.0, 0.0, 0.0, 0.0]},
            r"torque_range = 540\.0: must be 0, the .*, or from 18 to 162",
        ),
        ({"torque_range": [-54.0, 0.0, 0.0, 0.0]}, r"torque_range = -54\.0"),
        ({"motor": ["AK80-64"] * 4, "master_id": [0x12, 0, 0, 0]}, "master_id = 18: must be 0 for a motor with wire"),
    ],
)
def test_what_no_motor_of_the_family_has_is_refused(given, sentence):
    with pytest.raises(ParameterError, match=sentence):
        motors_of(parameters(**given))


def test_every_motor_of_a_family_can_be_had_in_each_format_that_has_ranges_for_it():
    for family in FAMILIES.values():
        for spec in family.motors.values():
            assert spec.family == family.name and spec.peak_torque <= spec.torque_range
            assert 0.0 < spec.rated_torque < spec.peak_torque and 0.0 < spec.rated_speed < spec.no_load_speed
            assert spec.source
    assert format_of("AK10-9", "mit_v3").ranged(MOTORS["AK10-9"]).torque_range == 54.0
    for name in ("AK70-10", "AK80-6", "AK80-64"):
        with pytest.raises(ParameterError, match=f"another format for an {name}"):
            format_of(name, "mit_v3").ranged(MOTORS[name])


def test_an_effort_is_impossible_beyond_what_the_own_motor_could_ever_give():
    limits = limits_of(parameters(motor=["AK80-64", "DM-J10010", "AK60-6", "DM-J8009"], can_id=[1, 2, 3, 4]))
    assert limits.max_command == (240.0, 300.0, 40.0, 80.0)


def told(boards, joint, number, value, now):
    form = "<I" if number < 20 else "<f"
    boards.told(joint, bytes((joint + 1, 0, 0x33, number)) + struct.pack(form, value), now)


RIGHT = {10: 1, 7: 0x11, 9: 4000, 21: 12.5, 22: 30.0, 23: 10.0}


@pytest.mark.parametrize(
    ("number", "value", "sentence"),
    [
        (TMAX, 28.0, r"its TMAX \(register 23\) is 28, must be 10, or torque_range 28 in the file"),
        (PMAX, 12.566, r"its PMAX \(register 21\) is 12\.566, must be 12\.5, or position_range 12\.566 in"),
        (10, 2, r"its CTRL_MODE \(register 10\) is 2, must be 1$"),
        (TIMEOUT, 8000, r"its TIMEOUT \(register 9\) is 8000, must be 4000, or motor_timeout 0\.4 in the file"),
        (7, 0x21, r"its MST_ID \(register 7\) is 33, must be 17"),
        (22, 30.001, "^$"),  # a float, and the file's decimal
    ],
)
def test_a_register_that_is_not_as_the_file_says_hinders_a_start_with_what_to_set(number, value, sentence):
    boards = Boards([motor()])
    boards.take(0, JointSample(0.0, 0.0, 0.0, 30, 0, 1.0, False))
    assert boards.hindrance(1.0, 250.0) == "motor 1 to tell its CTRL_MODE"
    for register, right in (RIGHT | {number: value}).items():
        told(boards, 0, register, right, 1.0)
    assert re.search(sentence, boards.hindrance(1.0, 250.0)), boards.hindrance(1.0, 250.0)


def test_settings_are_asked_for_one_by_one_and_again_after_a_while():
    boards = Boards([motor()])
    asked = set()
    for _ in RIGHT:
        ((frame_id, data),) = boards.question(0, 1.0)
        assert (frame_id, data[:3]) == (0x7FF, bytes((1, 0, 0x33)))
        asked.add(data[3])
        told(boards, 0, data[3], RIGHT[data[3]], 1.0)
    assert asked == set(RIGHT) and boards.question(0, 1.0) == ()
    assert boards.question(0, 1.0 + CHECK.ask_again)
    boards.take(0, JointSample(0.0, 0.0, 0.0, 30, 0, 2.5, False))
    assert boards.hindrance(2.5, 250.0).startswith("motor 1 to tell its")


def test_a_motor_that_replies_with_another_id_is_named_with_both():
    boards = Boards([motor(can_id=3)])
    boards.heard(0, ELSEWHERE, (0x23, STATE), 1.0)
    assert boards.hindrance(1.1, 250.0) == "motor 3 replies with the ID 35: set master_id = 35, or 19 on the motor"


def test_eight_motors_fit_on_classic_can_at_500_hz_and_on_can_fd_at_1000():
    classic, fd = Traffic(8), Traffic(8, data_bitrate=5_000_000)
    assert classic.load(500.0) == pytest.approx(0.97, abs=0.01)
    assert fd.load(1000.0) == pytest.approx(0.84, abs=0.01) and fd.load(1000.0, worst=True) < 1.0
    assert Traffic(7, data_bitrate=5_000_000).load(500.0) < 0.4
    with pytest.raises(ParameterError, match=r"8 motors need 1\d\d% of its time"):
        fd.check(1300.0)


def test_can_fd_is_refused_for_motors_that_do_not_speak_it():
    fd = {"fd": True}
    assert traffic_of(parameters(), fd)["can0"] == Traffic(4, data_bitrate=5_000_000)
    assert traffic_of(parameters(), fd | {"data_bitrate": 2_000_000})["can0"].data_bitrate == 2_000_000
    for name in ("AK80-9", "DM-J6006"):
        values = parameters(motor=["DM-J8009", "DM-J8009", "DM-J4340", name])
        with pytest.raises(ParameterError, match=rf"can\.options\.fd = True: must be false: a {name}"):
            traffic_of(values, fd)
    with pytest.raises(ParameterError, match="data_bitrate = 9000000"):
        traffic_of(parameters(), fd | {"data_bitrate": 9_000_000})
