# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Frames of the motors: every code survives, the scaling is the manual's, no frame has two meanings; the bus load.

Bytes are worked out by hand from the
documents that core/motors names, or come from public drivers.
"""

import json
import math
import pickle
import re
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import MIT, MIT_V3, pack_reply
from exo_gravity.core.motors.ak import MOTORS as AK
from exo_gravity.core.motors.boards import CHECK, Boards
from exo_gravity.core.motors.damiao import DAMIAO_MIT, PMAX, TIMEOUT, TMAX
from exo_gravity.core.motors.families import FAMILIES, FORMATS, MOTORS, format_of
from exo_gravity.core.motors.frames import (
    ALIAS,
    BROADCAST_ID,
    COMMAND,
    ELSEWHERE,
    ENTER,
    EXIT,
    EXTENDED,
    ID_BITS,
    MALFORMED,
    OTHER,
    REPLY,
    SERVO,
    SET_ZERO,
    SETTING,
    MotorReply,
    MotorSpec,
    WireFormat,
    is_special,
    pack_command,
    unpack_command,
)
from exo_gravity.core.motors.joint_motor import (
    BITRATE,
    COMMAND_BITS,
    FD_BITS,
    FD_COMMAND_BITS,
    FD_REPLY_BITS,
    MAX_CAN_ID,
    REPLY_BITS,
    STATUS_BITS,
    V3_COMMAND_BITS,
    JointMotor,
    JointSample,
    Traffic,
    motors_of,
    traffic_of,
)
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, limits_of

AK60 = MOTORS["AK60-6"]
V3_AK60, V3_AK80 = MIT_V3.ranged(AK60), MIT_V3.ranged(MOTORS["AK80-9"])
OF_COMMAND, OF_REPLY = ("position", "velocity", "kp", "kd", "torque"), ("position", "velocity", "torque")
# Seven bytes FF and one of EE to FF are special on some firmware: codes by which the torque is then reduced at most.
SPECIAL_FRAMES = [b"\xff" * 7 + bytes((last,)) for last in range(0xEE, 0x100)]
SPECIAL_NUDGE = len(SPECIAL_FRAMES)
IDS = frozenset((1, 2, 3, 126))

seeded = settings(max_examples=60, derandomize=True, database=None, deadline=None)
NUMBERS = st.floats() | st.floats(-20.0, 20.0) | st.floats(0.0, 600.0) | st.integers(-(10**30), 10**30)
BOARDS = st.sampled_from([*((MIT, spec) for spec in AK.values()), (MIT_V3, V3_AK60), (MIT_V3, V3_AK80)])
SHARES = st.floats(-1.0, 1.0) | st.sampled_from((-1.0, 0.0, 1.0))


def mounted(board, *mounting):
    """A joint whose motor has this format and these ranges."""
    return JointMotor(board[1], *mounting, board[0])


MOUNTED = st.builds(
    mounted, BOARDS, st.integers(1, 126), st.sampled_from((1, -1)), st.floats(-9.0, 9.0), st.floats(0.2, 2.0)
)


def bounds(spec, field):
    """Lowest and highest value of a field, and the step between two codes."""
    low, high, bits = {
        "position": (-spec.position_range, spec.position_range, 16),
        "velocity": (-spec.velocity_range, spec.velocity_range, 12),
        "kp": (0.0, spec.kp_max, 12),
        "kd": (0.0, spec.kd_max, 12),
        "torque": (-spec.torque_range, spec.torque_range, 12),
    }[field]
    return low, high, (high - low) / (2**bits - 1)


def scaled(spec, fields, shares):
    """Values of `fields`: the shares -1..1 of their ranges."""
    values = []
    for field, share in zip(fields, shares, strict=True):
        low, high, _ = bounds(spec, field)
        values.append(min(high, max(low, (low + high) / 2.0 + share * (high - low) / 2.0)))
    return values


@seeded
@given(BOARDS, st.tuples(*[SHARES] * 5), st.integers(1, MAX_CAN_ID))
def test_a_command_survives_a_round_trip_within_half_a_code_and_is_a_command(board, shares, can_id):
    wire_format, spec = board
    sent = scaled(spec, OF_COMMAND, shares)
    data = wire_format.pack_command(spec, *sent)
    assert wire_format is MIT_V3 or data not in SPECIAL_FRAMES
    got = wire_format.unpack_command(spec, data)
    top = all(g >= bounds(spec, f)[1] - 1e-9 for f, g in zip(OF_COMMAND[:4], got[:4], strict=True))
    for field, wanted, value in zip(OF_COMMAND, sent, got, strict=True):
        codes = 0.5 + (SPECIAL_NUDGE if wire_format is MIT and top and field == "torque" else 0)
        assert abs(value - wanted) <= (codes + 1e-6) * bounds(spec, field)[2]
    if data[0] != can_id:  # in the format mit only if the position is not 0: JointMotor never sends such a command
        assert wire_format.classify(wire_format.first_id + can_id, data, frozenset((can_id,))) == (COMMAND, can_id)


@seeded
@given(MOUNTED, st.tuples(*[SHARES] * 3), st.integers(-40, 127), st.integers(0, 255), st.floats(-3.0, 3.0))
def test_a_reply_survives_a_round_trip_and_is_a_reply(motor, shares, temperature, error, angle):
    wire_format, spec, can_id = motor.wire_format, motor.spec, motor.can_id
    sent = MotorReply(can_id, *scaled(spec, OF_REPLY, shares), temperature, error)
    data = wire_format.pack_reply(spec, sent)
    got = wire_format.unpack_reply(spec, can_id, data)
    assert (got.motor_id, got.temperature, got.error) == (can_id, temperature, error)
    for field, wanted, value in zip(OF_REPLY, sent[1:4], got[1:4], strict=True):
        assert abs(value - wanted) <= ((0.5 + 1e-6) * bounds(spec, field)[2] if wire_format is MIT else 0.02)
    assert wire_format.classify(wire_format.reply_id(can_id), data, frozenset((can_id,))) == (REPLY, can_id)
    turned = wire_format.pack_reply(spec, sent._replace(position=motor.motor_position(angle)))
    assert motor.sample(turned, 0.0).position == pytest.approx(angle, abs=0.001)


@seeded
@given(MOUNTED, NUMBERS, NUMBERS)
def test_a_joint_at_rest_gets_any_effort_without_stiffness_within_its_range_or_rejects_it(motor, effort, damping):
    spec = motor.spec
    try:
        command = motor.wire_format.unpack_command(spec, motor.command(effort, damping))
    except ParameterError:
        assert not (math.isfinite(effort) and abs(effort) < 1e100 and 0.0 <= damping <= spec.kd_max)
        return
    for field, value in zip(OF_COMMAND, command, strict=True):
        assert bounds(spec, field)[0] - 1e-9 <= value <= bounds(spec, field)[1] + 1e-9
    kd = min(damping / motor.torque_scale, spec.kd_max)
    assert command.kp == 0.0 and abs(command.kd - kd) <= bounds(spec, "kd")[2]
    torque = motor.direction * effort / motor.torque_scale
    applied = command.torque + command.kd * command.velocity  # at rest
    slack = 1.5 * bounds(spec, "torque")[2] + command.kd * bounds(spec, "velocity")[2]
    assert abs(applied - max(-spec.torque_range, min(spec.torque_range, torque))) <= slack


def test_a_reversed_motor_has_reversed_angle_and_torque_and_one_that_is_read_at_the_end_of_its_range_is_held_there():
    motor = JointMotor(AK60, 1, direction=-1, zero=0.5, torque_scale=0.75)
    assert motor.sample(pack_reply(AK60, 1, 0.2, 1.0, -2.0), 0.0)[:3] == pytest.approx((0.3, -1.0, 1.5), abs=0.02)
    assert unpack_command(AK60, JointMotor(AK60, 1, zero=3.53).command(0.0, 0.0, 1.0, -12.5 - 3.53)).position == -12.5


@pytest.mark.parametrize("codes_below_top", range(20))
def test_a_command_that_would_spell_a_special_frame_gets_a_slightly_lower_torque(codes_below_top):
    code = 30.0 / 4095
    torque = 15.0 - codes_below_top * code
    data = pack_command(AK60, 12.5, 45.0, 500.0, 5.0, torque)
    assert data not in SPECIAL_FRAMES
    lowered = torque - unpack_command(AK60, data).torque
    assert lowered == pytest.approx(max(0, SPECIAL_NUDGE - codes_below_top) * code, abs=1e-6)
    for field in range(4):  # one other field below its maximum, and no torque is lowered
        fields = [12.5, 45.0, 500.0, 5.0]
        fields[field] *= 0.99
        assert unpack_command(AK60, pack_command(AK60, *fields, torque)).torque == pytest.approx(torque)


def test_every_frame_that_some_firmware_takes_for_another_is_special():
    assert all(is_special(data) for data in (*SPECIAL_FRAMES, ENTER, EXIT, SET_ZERO))
    assert not any(map(is_special, (b"\xff" * 7 + b"\xed", b"\xff" * 6 + b"\xfe\xfc", ENTER[1:])))


@pytest.mark.parametrize(
    ("board", "frame_id", "data", "is_remote", "expected"),
    [
        *((MIT, 3, b"\xff" * length, remote, (COMMAND, 3)) for length, remote in ((6, 0), (1, 0), (0, 0), (0, 1))),
        *((MIT, frame_id, b"\xff", frame_id == 0x103, (ALIAS, 3)) for frame_id in (0x83, 0x703, 0x103)),
        *((MIT, frame_id, b"\xff", False, (OTHER, 0)) for frame_id in (4, 0x84, 0x704, 0x104)),
        *((MIT, 0, bytes((3,)) + bytes(length - 1), False, (MALFORMED, 3)) for length in (1, 5)),
        (MIT, EXTENDED | 0x2903, bytes(8), False, (SERVO, 3)),  # a status frame is no reply of a V1 board
        (MIT, EXTENDED | 0x2904, bytes(8), False, (OTHER, 0)),
        *((MIT_V3, EXTENDED | mode << 8 | 2, bytes(4), False, (COMMAND, 2)) for mode in range(16)),
        *((MIT_V3, EXTENDED | mode << 8 | 9, bytes(4), False, (OTHER, 0)) for mode in range(16)),
        *((MIT_V3, EXTENDED | mode << 8 | 0xFF, bytes(4), False, (COMMAND, BROADCAST_ID)) for mode in range(16)),
        *((MIT_V3, MIT_V3.reply_id(1), bytes(length), False, (MALFORMED, 1)) for length in (0, 7, 9)),
    ],
)
def test_an_ak_motor_may_obey_short_and_remote_frames_other_modes_and_ids_with_its_lowest_7_bits(
    board, frame_id, data, is_remote, expected
):
    assert board.classify(frame_id, data, IDS, bool(is_remote)) == expected


DAMIAO_ERRORS = ("over-voltage", "under-voltage", "over-current", "MOSFET over-temperature", "coil over-temperature",
                 "communication lost", "overload", "unknown")  # fmt: skip


@pytest.mark.parametrize(
    ("board", "byte", "text"),
    [
        (MIT, 2, "over-current; as a bit mask: warm, above 81 degC"),
        (MIT, 6, "MOSFET over-temperature; as a bit mask: warm, above 81 degC, shut off, above 120 degC"),
        (MIT, 9, "unknown; as a bit mask: unknown, unknown"),
        *((DAMIAO_MIT, 8 + n, text) for n, text in enumerate(DAMIAO_ERRORS)),
    ],
)
def test_an_error_is_named_as_in_the_manuals(board, byte, text):
    assert board.error_text(byte).startswith(text)


def test_a_motor_keeps_its_wire_format_on_the_way_to_the_watchdog():
    for board in FORMATS.values():
        motor = JointMotor(board.ranged(MOTORS["AK80-9"]), 4, wire_format=board)
        assert pickle.loads(pickle.dumps(motor)) == motor


PUBLIC = json.loads((Path(__file__).parents[1] / "data" / "motor_frames.json").read_text())
DRIVERS_OWN = {"AK60-6": {"velocity_range": 50.0}}  # ranges that the public driver has otherwise
DM4310 = MOTORS["DM-J4310"]
REPLY_IDS = {1: 0x11, 2: 0x12, 8: 0x18}


def damiao(spec=DM4310, can_id=1, timeout=0.2, **changes):
    return JointMotor(spec, can_id, wire_format=DAMIAO_MIT, timeout=timeout, **changes)


PUBLIC_REPLIES = [  # by public drivers: the motor, its ID, the frame, the state, degC and the error or whether it is on
    *(
        (MIT, replace(MOTORS[name], **DRIVERS_OWN.get(name, {})), data, int(data[:2], 16), state, degrees - 40, error)
        for name, rows in PUBLIC["ak"].items()
        for data, *state, degrees, error in rows
    ),
    *(
        (DAMIAO_MIT, MOTORS[name], data, can_id, readings, max(degrees), state if state > 1 else 0)
        for name, rows in PUBLIC["damiao"]["replies"].items()
        for data, can_id, state, *readings, mosfet, coil in rows
        for degrees in [(mosfet, coil)]
    ),
]


@pytest.mark.parametrize(("board", "spec", "data", "can_id", "state", "degrees", "error"), PUBLIC_REPLIES)
def test_a_public_driver_reads_the_same_in_the_replies_of_every_motor(board, spec, data, can_id, state, degrees, error):
    reply = board.unpack_reply(spec, can_id, bytes.fromhex(data))
    assert reply == pytest.approx((can_id, *state, degrees, error), abs=1e-6)


@pytest.mark.parametrize("name", PUBLIC["damiao"]["commands"])
def test_a_public_driver_sends_the_same_commands_but_for_its_truncation(name):
    for *values, expected in PUBLIC["damiao"]["commands"][name]:
        ours, theirs = pack_command(MOTORS[name], *values), bytes.fromhex(expected)
        for shift, bits in ((48, 16), (36, 12), (24, 12), (12, 12), (0, 12)):
            codes = [int.from_bytes(data, "big") >> shift & (1 << bits) - 1 for data in (ours, theirs)]
            assert codes[0] - codes[1] in (0, 1)


# position 0 -> 32767.5 -> 32768, velocity 0 -> 2047.5 -> 2048, kp 0, kd 5 of 5 -> 4095
COMMANDS = [
    (MIT, AK60, 3.0, "8000800000fff999"),  # torque 3 of +-15 -> 2457
    (MIT_V3, V3_AK60, 12.0, "000fff8000800fff"),  # kp and kd first, torque 12 of +-12 -> 4095
    (DAMIAO_MIT, DM4310, 3.0, "8000800000fffa66"),  # torque 3 of +-10: 13 / 20 x 4095 = 2661.75 -> 2662
]
SPEED = 100.0 * 2.0 * math.pi / 60.0  # rad/s, of 840 x 10 electrical rpm / 14 pole pairs / gear 6 = 100 rpm
REPLIES = [
    # motor 7, position 0xffff -> 12.5, velocity 0 -> -45, torque 2457 -> 3, 70 - 40 degC, error 2
    (MIT, AK60, 7, "07 ffff 000999 46 02", (12.5, -45.0, 3.0, 30, 2)),
    # 90.0 deg, 100 rpm, -2 A x 0.2997 Nm/A, -5 degC, error 7
    (MIT, AK60, 255, "ff ffff 000999 00", (12.5, -45.0, 3.0, None, None)),  # the open drive's seventh byte
    (MIT, AK60, 255, "ff ffff 000999 00 00", (12.5, -45.0, 3.0, -40, 0)),
    (MIT_V3, V3_AK60, 3, "0384 0348 ff38 fb 07", (math.pi / 2, SPEED, -2.0 * 0.2997, -5, 7)),
    (MIT_V3, V3_AK80, 3, "0384 0348 ff38 fb 07", (math.pi / 2, SPEED * 14 * 6 / 21 / 9, -2.0 * 9.0 / 10.3, -5, 7)),
    # on (1), motor 3, position 0xffff -> 12.5, velocity 0 -> -30, torque 4095 -> 10, MOSFET 40, coil 55 degC
    (DAMIAO_MIT, DM4310, 3, "13 ffff 000fff 28 37", (12.5, -30.0, 10.0, 55, 0)),
]


def test_commands_and_replies_have_the_bytes_worked_out_by_hand():
    for wire_format, spec, torque, data in COMMANDS:
        assert wire_format.pack_command(spec, 0.0, 0.0, 0.0, 5.0, torque) == bytes.fromhex(data)
    for wire_format, spec, can_id, data, values in REPLIES:
        assert wire_format.unpack_reply(spec, can_id, bytes.fromhex(data)) == pytest.approx((can_id, *values))
    assert JointMotor(V3_AK60, 0x7E, wire_format=MIT_V3).command_id == EXTENDED | 0x87E
    assert MIT_V3.reply_id(3) == EXTENDED | 0x2903
    motor = JointMotor(V3_AK60, 5, wire_format=MIT_V3)  # a current of 0 switches it off
    assert (motor.exit, motor.enter, motor.set_zero) == (((EXTENDED | 0x105, bytes(4)),), (), ())


@pytest.mark.parametrize(("state", "on", "error"), [(0, False, 0), (1, True, 0), (0xD, False, 0), (0xE, False, 0xE)])
def test_a_reply_says_whether_the_motor_is_on_and_a_lost_command_is_no_defect(state, on, error):
    sample = damiao(can_id=2, direction=-1).sample(bytes((state << 4 | 2, 0x80, 0, 0x80, 0x08, 0, 30, 31)), 1.0)
    assert (sample.on, sample.error, sample.temperature, sample.time) == (on, error, 31, 1.0)
    assert bool(sample.trouble) == (state > 1)


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


BRIDGE = {"can.interface": "virtual", "can.channel": "c"}
DAMIAO = {"motor": ["DM-J8009", "DM-J8009", "DM-J4340", "DM-J4310"], "motor_timeout": [0.2] * 4}
MIXED = {"wire_format": ["mit", "mit_v3", "mit_v3", "mit"]}
OWN = {"motor_timeout": [0.0, 0.15, 0.5, 0.3], "position_range": [12.56, 0.0, 12.5, 12.566]}
AMPERES = {"wire_format": ["mit_v3"] * 4, "torque_per_ampere": [0.0, 0.0, 0.45, 0.0]}
QUARTER, TEN_AMPERES = pack_reply(AK60, 1, math.pi / 2, 0.0, 0.0), bytes.fromhex("0000 0000 03e8 19 00")
STRONG = {**DAMIAO, "motor": ["AK80-64", "DM-J10010", "AK60-6", "DM-J8009"], "can_id": [1, 2, 3, 4]}
OF_MOTORS = [  # parameters, what of each motor, and its values
    (MIXED, lambda motor: motor.wire_format.name, MIXED["wire_format"]),
    (MIXED, lambda motor: motor.spec.torque_range, [15.0, 18.0, 12.0, 15.0]),
    (MIXED, lambda motor: motor.spec.velocity_range, [45.0, 65.0, 60.0, 45.0]),
    (OWN, lambda motor: motor.timeout, OWN["motor_timeout"]),
    (OWN, lambda motor: motor.spec.position_range, [12.56, 12.5, 12.5, 12.566]),
    (OWN, lambda motor: 100 * round(motor.sample(QUARTER, 0.0).position, 3), [157.8, 157.1, 157.1, 157.9]),
    (AMPERES, lambda motor: motor.sample(TEN_AMPERES, 0.0).effort, [2.997, 10.0 * 9.0 / 10.3, 4.5, 2.997]),
    (DAMIAO, lambda motor: motor.reply_id, [0x11, 0x12, 0x13, 0x14]),
    (DAMIAO, lambda motor: motor.spec.torque_range, [54.0, 54.0, 28.0, 10.0]),
]


@pytest.mark.parametrize(("given", "of", "values"), OF_MOTORS)
def test_each_motor_is_as_the_parameters_and_its_own_board_have_it(given, of, values):
    found = [of(motor) for motor in motors_of(values_of(CAN_BRIDGE, {**BRIDGE, **given}))]
    assert found == (pytest.approx(values) if isinstance(values[0], float) else values)


def test_an_effort_is_impossible_beyond_what_the_own_motor_could_ever_give():
    assert limits_of(values_of(CAN_BRIDGE, {**BRIDGE, **STRONG})).max_command == (240.0, 300.0, 40.0, 80.0)


def test_every_motor_of_a_family_can_be_had_in_each_format_that_has_ranges_for_it():
    for family in FAMILIES.values():
        for spec in family.motors.values():
            assert spec.family == family.name and spec.peak_torque <= spec.torque_range
            assert 0.0 < spec.rated_torque < spec.peak_torque and 0.0 < spec.rated_speed < spec.no_load_speed
            assert spec.source
    assert format_of("AK10-9", "mit_v3").ranged(MOTORS["AK10-9"]).torque_range == 54.0


def answer(number, value):
    return bytes((1, 0, 0x33, number)) + struct.pack("<I" if number < 20 else "<f", value)


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
    boards = Boards([damiao()])
    boards.take(0, sample(1.0))
    assert boards.setup_error(1.0, 250.0) == "motor 1 to tell its CTRL_MODE"
    for register, right in (RIGHT | {number: value}).items():
        boards.told(0, answer(register, right), 1.0)
    assert re.search(sentence, boards.setup_error(1.0, 250.0)), boards.setup_error(1.0, 250.0)


def test_settings_are_asked_for_one_by_one_and_again_after_a_while():
    boards = Boards([damiao()])
    asked = set()
    for _ in RIGHT:
        ((frame_id, data),) = boards.question(0, 1.0)
        assert (frame_id, data[:3]) == (0x7FF, bytes((1, 0, 0x33)))
        asked.add(data[3])
        boards.told(0, answer(data[3], RIGHT[data[3]]), 1.0)
    assert asked == set(RIGHT) and boards.question(0, 1.0) == ()
    assert boards.question(0, 1.0 + CHECK.ask_again)
    boards.take(0, sample(2.5))
    assert boards.setup_error(2.5, 250.0).startswith("motor 1 to tell its")


RATE = 400.0  # Hz of the control loop


def boards_of(board):
    return tuple(JointMotor(board.ranged(MOTORS["AK60-6"]), can_id, wire_format=board) for can_id in (1, 2, 3, 4))


def sample(time, temperature=25):
    return JointSample(0.0, 0.0, 0.0, temperature, 0, time)


ENOUGH = (500.0, 480.0, 420.0, 500.0)
REPORTS = [  # a format, frames a second of each motor, for how many s, and what hinders a start then
    (MIT_V3, ENOUGH, 2.0, "^$"),
    *(
        (MIT_V3, (500.0, 500.0, 50.0, 500.0), seconds,  # as the board's files ship it
         "^motor 3 sends 50 status frames a second, rate = 400 needs at least that many: set 500 on its board$")
        for seconds in (0.7, 1.0, 3.0)
    ),
    (MIT_V3, (500.0, 0.0, 500.0, 500.0), 1.0, "^$"),  # it may report once a second
    (MIT_V3, (500.0, 0.0, 500.0, 500.0), 1.5, "^motor 2 sends no status frame: switch its supply"),
    (MIT, (250.0, 0.0, 0.0, 0.0), 3.0, "^$"),  # of a V1 board that does not reply the state machine takes care
]  # fmt: skip


@pytest.mark.parametrize(("board", "rates", "seconds", "sentence"), REPORTS)
def test_a_board_that_reports_too_seldom_hinders_a_start_with_what_to_set(board, rates, seconds, sentence):
    """Each motor sends `rates` (Hz) frames a second."""
    boards = Boards(boards_of(board))
    boards.setup_error(0.0, RATE)
    for joint, rate in enumerate(rates):
        for count in range(int(seconds * rate)):
            boards.take(joint, sample(count / rate))
    assert re.search(sentence, boards.setup_error(seconds, RATE))


HEARD = [  # of what kind and which frame of motor 3 is no reply, and what is said of it
    (
        MALFORMED,
        (3, bytes.fromhex("0380017ff8")),
        "sent 5 bytes [03 80 01 7f f8] as its reply: must be 6, 7 or 8 bytes",
    ),
    (SERVO, (0x2903, bytes(8)), "does not reply, but sends status frames: set it to MIT mode"),
    (ELSEWHERE, (0x23, STATE), "replies with the ID 35: set master_id = 35, or 3 on the motor"),
]


@pytest.mark.parametrize(("kind", "frame", "said"), HEARD)
def test_a_frame_in_place_of_replies_is_shown_until_the_motor_replies_or_falls_silent(kind, frame, said):
    boards = Boards(boards_of(MIT))
    boards.heard(2, kind, frame, 1.0)
    assert boards.setup_error(1.5, RATE).startswith(f"motor 3 {said}")
    assert boards.setup_error(2.1, RATE) == ""
    boards.heard(2, kind, frame, 3.0)
    boards.take(2, sample(3.1))
    assert boards.setup_error(3.2, RATE) == ""


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
    boards = Boards(boards_of(MIT))
    for joint, temperature in enumerate(temperatures):
        boards.take(joint, sample(1.0, temperature))
        boards.take(joint, sample(1.1, 80))  # later ones do not matter
    assert boards.odd_temperature.startswith(odd) and bool(boards.odd_temperature) is bool(odd)
    boards.take(0, sample(9.0, -15))  # it was switched off and on
    assert "motor 1 read -15 degC" in boards.odd_temperature


# The bits of CAN frames and the bus load, against the CAN specification and hand-computed figures.

AK60 = MOTORS["AK60-6"]
V3, FD = MIT_V3.ranged(AK60), MOTORS["DM-J4340"]
FOUR_AK = {"motor": ["AK60-6"] * 4}


def frame_bits(data_bytes: int, is_extended: bool = False) -> tuple[int, int]:
    """The bits of a frame by the specification: without stuff bits, and with as many as possible."""
    stuffed = 34 + 20 * is_extended + 8 * data_bytes
    return stuffed + 13, stuffed + 13 + (stuffed - 1) // 4


def stuffed(bits: list[int]) -> list[int]:
    """The places of the bits that a stuff bit follows: after 5 equal ones; it starts the next run."""
    places, last, run = [], None, 0
    for place, bit in enumerate(bits):
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            places.append(place)
            last, run = 1 - bit, 1
    return places


def stuffed_bits(can_id: int, data: bytes, is_extended: bool = False) -> int:
    """The exact number of bits of one frame, with its stuff bits."""
    head = [*bits_of(can_id >> 18, 11), 1, 1, *bits_of(can_id & 0x3FFFF, 18)] if is_extended else bits_of(can_id, 11)
    bits = [0, *head, 0, 0, 0, *bits_of(len(data), 4), *(bit for byte in data for bit in bits_of(byte, 8))]
    bits += bits_of(crc(bits), 15)
    return frame_bits(len(data), is_extended)[0] + len(stuffed(bits))


def bits_of(value: int, width: int) -> list[int]:
    return [value >> place & 1 for place in reversed(range(width))]


def crc(bits: list[int]) -> int:
    """Return CAN's CRC-15: polynomial 0x4599, initial value 0."""
    register = 0
    for bit in bits:
        turn = bit ^ register >> 14
        register = (register << 1 & 0x7FFF) ^ (0x4599 if turn else 0)
    return register


def frames(board: WireFormat, spec: MotorSpec, is_reply: bool, count: int = 4) -> Iterator[tuple[int, bytes, bool]]:
    """ID, data and kind of ID of the frames of an arm of `count` motors, in random poses at random torques."""
    rng = np.random.default_rng(5)
    for index in range(2000):
        can_id = index % count + 1
        torque, position, velocity = (rng.uniform((-3, -1.65, -1), (3, 3.14, 1)) * (count / 4, 1, 1)).tolist()
        reply = MotorReply(can_id, position, velocity, torque, int(rng.integers(20, 60)), 0)
        frame_id = (board.reply_id(can_id) or can_id) if is_reply else board.first_id + can_id
        command = board.pack_command(spec, 0.0, 0.0, 0.0, 0.0, torque)
        yield frame_id & ID_BITS, board.pack_reply(spec, reply, True) if is_reply else command, board is MIT_V3


def test_the_counter_of_this_test_agrees_with_a_hand_count_and_the_check_value_of_crc_15_can():
    # 34 zeros (start, ID, control, length 0, a CRC of 0): a stuff bit after the first 5, then after every 5 more.
    assert stuffed_bits(0, b"") == frame_bits(0)[0] + 34 // 5
    assert crc([bit for byte in b"123456789" for bit in bits_of(byte, 8)]) == 0x059E


CLASSIC = [
    (MIT, AK60, False, COMMAND_BITS),
    (MIT, AK60, True, REPLY_BITS),
    (MIT_V3, V3, False, V3_COMMAND_BITS),
    (MIT_V3, V3, True, STATUS_BITS),
]


@pytest.mark.parametrize(("board", "spec", "is_reply", "bits"), CLASSIC)
def test_typical_bits_are_the_mean_of_a_carried_arm_and_the_most_those_of_the_specification(
    board, spec, is_reply, bits
):
    assert np.mean([stuffed_bits(*frame) for frame in frames(board, spec, is_reply)]) == pytest.approx(
        bits.typical, abs=1.0
    )
    assert bits.most == frame_bits(8, board is MIT_V3)[1]


def fd_bits(can_id: int, data: bytes) -> tuple[int, int]:
    """The bits of a CAN FD frame at the bit rates of arbitration and of data, with its stuff bits before the CRC.

    After the data: stuff count 4, CRC 17, 6 fixed stuff bits; then, slowly again, 13 bits to the next frame.
    """
    head = [0, *bits_of(can_id, 11), 0, 0, 1, 0, 1]
    rest = [0, *bits_of(len(data), 4), *(bit for byte in data for bit in bits_of(byte, 8))]
    places = stuffed([*head, *rest])
    slow = sum(place < len(head) for place in places)
    return len(head) + 13 + slow, len(rest) + 27 + len(places) - slow


@pytest.mark.parametrize(("is_reply", "fast"), [(False, FD_COMMAND_BITS), (True, FD_REPLY_BITS)])
def test_typical_bits_of_can_fd_are_the_mean_of_a_carried_arm(is_reply, fast):
    bits = [fd_bits(can_id, data) for can_id, data, _ in frames(DAMIAO_MIT, FD, is_reply, 8)]
    assert np.mean(bits, axis=0) == pytest.approx((FD_BITS.typical, fast.typical), abs=1.0)
    assert np.all(np.max(bits, axis=0) <= (FD_BITS.most, fast.most))


REPORTED = 4 * (500.0 * STATUS_BITS.typical + 250.0 * V3_COMMAND_BITS.typical) / BITRATE
LOADS = [  # motors, Hz, whether with the most stuffing, and the load
    (Traffic(4), 500.0, False, 0.48),
    (Traffic(4), 500.0, True, 0.54),
    (Traffic(4), 926.0, True, 1.0),
    (Traffic(4), Traffic(4).largest_rate, False, 1.0),
    (Traffic(0, 4), 250.0, False, REPORTED),
    (Traffic(8), 500.0, False, 0.97),
    (Traffic(8, data_bitrate=5_000_000), 1000.0, False, 0.84),
]


@pytest.mark.parametrize(("motors", "rate", "worst", "load"), LOADS)
def test_the_load_of_replying_and_reporting_motors(motors, rate, worst, load):
    assert motors.load(rate, worst) == pytest.approx(load, abs=0.01)


def test_a_rate_that_crowds_the_bus_is_known_and_a_slow_bus_gets_fewer_reports():
    Traffic(4).check(1000.0)
    Traffic(0, 4, bitrate=250_000).check(160.0)
    slow = Traffic(4, bitrate=250_000)
    assert slow.is_crowded(240.0) and not slow.is_crowded(206.0) and slow.is_crowded(207.0)


SLCAN = {"can.interface": "slcan", "wire_format": ["mit", "mit", "mit_v3", "mit_v3"], **FOUR_AK}
SOCKETCAN = {"can.interface": "socketcan", "wire_format": ["mit"] * 4, **FOUR_AK}
ON_FD = {**SOCKETCAN, "can.channel": "c", "motor": ["DM-J8009", "DM-J8009", "DM-J4340", "DM-J4310"]}
BUSES = [  # parameters, options, and the traffic of each bus
    ({**SOCKETCAN, "can.channel": "can0,can0,can1,can1"}, {}, {"can0": Traffic(2), "can1": Traffic(2)}),
    ({**SLCAN, "can.channel": "c"}, {"bitrate": 250_000}, {"c": Traffic(2, 2, 250_000)}),
    (
        {**SLCAN, "can.channel": "a, b,b, b"}, {"bitrate": [250_000, 1_000_000, 1_000_000, 1_000_000]},
        {"a": Traffic(1, 0, 250_000), "b": Traffic(1, 2, 1_000_000)},
    ),
    (ON_FD, {"fd": True}, {"c": Traffic(4, data_bitrate=5_000_000)}),
    (ON_FD, {"fd": True, "data_bitrate": 2_000_000}, {"c": Traffic(4, data_bitrate=2_000_000)}),
]  # fmt: skip


@pytest.mark.parametrize(("values", "options", "traffic"), BUSES)
def test_each_bus_has_the_load_of_its_own_motors(values, options, traffic):
    assert traffic_of(values, options) == traffic
