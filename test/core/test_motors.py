# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The frames of AK motors in every wire format, and a motor on a joint.

Every code survives a round trip, the scaling is the manual's, no frame has two meanings, and any bytes or numbers give
a value within the wire range or a clear error.
"""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.motors.ak import MIT, MIT_V3, MOTORS, error_text, pack_reply, unpack_reply
from exo_gravity.core.motors.families import FORMATS
from exo_gravity.core.motors.frames import (
    ALIAS,
    BROADCAST_ID,
    COMMAND,
    ENTER,
    EXIT,
    EXTENDED,
    MALFORMED,
    OTHER,
    REPLY,
    SERVO,
    SET_ZERO,
    MotorReply,
    is_special,
    pack_command,
    unpack_command,
)
from exo_gravity.core.motors.joint_motor import MAX_CAN_ID, JointMotor, motors_of
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE

AK60 = MOTORS["AK60-6"]
V3_AK60, V3_AK80 = MIT_V3.ranged(AK60), MIT_V3.ranged(MOTORS["AK80-9"])
SPECS = pytest.mark.parametrize("spec", MOTORS.values(), ids=MOTORS)
OF_COMMAND, OF_REPLY = ("position", "velocity", "kp", "kd", "torque"), ("position", "velocity", "torque")
# Seven bytes FF and one of EE to FF are special on some firmware: codes by which the torque is then reduced at most.
SPECIAL_FRAMES = [b"\xff" * 7 + bytes((last,)) for last in range(0xEE, 0x100)]
SPECIAL_NUDGE = len(SPECIAL_FRAMES)
LONGEST = 80  # bytes; CAN FD has up to 64
IDS = frozenset((1, 2, 3, 126))

seeded = settings(max_examples=60, derandomize=True, database=None, deadline=None)
BYTES = st.binary(max_size=LONGEST) | st.binary(min_size=6, max_size=6) | st.binary(min_size=8, max_size=8)
BYTES |= st.lists(st.sampled_from((0x00, 0xFF)), min_size=8, max_size=8).map(bytes)
NUMBERS = st.floats() | st.floats(-20.0, 20.0) | st.floats(0.0, 600.0) | st.integers(-(10**30), 10**30)
SHARES = st.floats(-1.0, 1.0) | st.sampled_from((-1.0, 0.0, 1.0))


@st.composite
def specs(draw):
    """A motor with its default ranges or with those of another firmware."""
    spec = draw(st.sampled_from(list(MOTORS.values())))
    ranges = {"velocity_range": st.floats(1.0, 100.0), "torque_range": st.floats(1.0, 100.0)}
    return draw(st.just(spec) | st.builds(partial(replace, spec), **ranges))


@st.composite
def boards(draw):
    """A format, and a motor with its ranges."""
    return draw(st.tuples(st.just(MIT), specs()) | st.tuples(st.just(MIT_V3), st.sampled_from((V3_AK60, V3_AK80))))


@st.composite
def joints(draw):
    board, spec = draw(boards())
    mounting = draw(st.integers(1, 126)), draw(st.sampled_from((1, -1))), draw(st.floats(-9.0, 9.0))
    return JointMotor(spec, *mounting, draw(st.floats(0.2, 2.0)), board)


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


def assert_within(spec, fields, values):
    for field, value in zip(fields, values, strict=True):
        low, high, code = bounds(spec, field)
        assert low - 1e-9 * code <= value <= high + 1e-9 * code


def scaled(spec, fields, shares):
    """Values of `fields`: the shares -1..1 of their ranges."""
    values = []
    for field, share in zip(fields, shares, strict=True):
        low, high, _ = bounds(spec, field)
        values.append(min(high, max(low, (low + high) / 2.0 + share * (high - low) / 2.0)))
    return values


@seeded
@given(boards(), st.tuples(*[NUMBERS] * 5))
def test_any_numbers_give_a_command_of_8_bytes_or_an_error_that_names_the_field(board, values):
    wire_format, spec = board
    inside = [bounds(spec, f)[0] <= v <= bounds(spec, f)[1] for f, v in zip(OF_COMMAND, values, strict=True)]
    if all(inside):
        assert len(wire_format.pack_command(spec, *values)) == 8
        return
    with pytest.raises(ParameterError) as caught:
        wire_format.pack_command(spec, *values)
    assert not inside[OF_COMMAND.index(caught.value.name)]


@seeded
@given(boards(), st.tuples(*[SHARES] * 5), st.integers(1, MAX_CAN_ID))
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
@given(joints(), st.tuples(*[SHARES] * 3), st.integers(-40, 127), st.integers(0, 255), st.floats(-3.0, 3.0))
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
@given(joints(), BYTES)
def test_any_bytes_decode_to_a_reply_within_range_or_an_error_that_shows_them(motor, data):
    is_mit = motor.wire_format is MIT
    try:
        reply = motor.wire_format.unpack_reply(motor.spec, motor.can_id, data)
    except FrameError as error:
        assert len(data) not in ((6, 7, 8) if is_mit else (8,)) and error.data == data
        return
    assert (reply.temperature is None) == (reply.error is None) == (len(data) < 8)
    if is_mit:
        assert_within(motor.spec, OF_REPLY, reply[1:4])
    assert all(map(math.isfinite, motor.sample(data, 0.0)[:3]))


@seeded
@given(boards(), BYTES | st.sampled_from(SPECIAL_FRAMES))
def test_any_bytes_decode_to_a_command_within_range_or_an_error_that_shows_them(board, data):
    wire_format, spec = board
    try:
        command = wire_format.unpack_command(spec, data)
    except FrameError as error:
        assert (len(data) != 8 or (wire_format is MIT and data in SPECIAL_FRAMES)) and error.data == data
        return
    assert len(data) == 8
    assert_within(spec, OF_COMMAND, command)


@seeded
@given(
    boards(),
    st.integers(0, 2047) | st.integers(0, 0x2FFF).map(lambda i: i | EXTENDED),
    st.binary(max_size=64),
    st.booleans(),
)
def test_any_frame_is_a_reply_that_can_be_read_or_a_command_or_neither(board, frame_id, data, is_remote):
    wire_format, spec = board
    kind, can_id = wire_format.classify(frame_id, data, IDS, is_remote)
    assert (kind, can_id) == (OTHER, 0) or kind in (REPLY, COMMAND, ALIAS, MALFORMED, SERVO)
    assert can_id in IDS or kind == OTHER or (kind, can_id) == (COMMAND, BROADCAST_ID)
    if kind == REPLY:
        assert all(map(math.isfinite, wire_format.unpack_reply(spec, can_id, data)[1:4]))


@seeded
@given(joints(), NUMBERS, NUMBERS)
def test_a_joint_at_rest_gets_any_effort_without_stiffness_within_its_range_or_rejects_it(motor, effort, damping):
    spec = motor.spec
    try:
        command = motor.wire_format.unpack_command(spec, motor.command(effort, damping))
    except ParameterError:
        assert not (math.isfinite(effort) and abs(effort) < 1e100 and 0.0 <= damping <= spec.kd_max)
        return
    assert_within(spec, OF_COMMAND, command)
    kd = min(damping / motor.torque_scale, spec.kd_max)
    assert command.kp == 0.0 and abs(command.kd - kd) <= bounds(spec, "kd")[2]
    torque = motor.direction * effort / motor.torque_scale
    applied = command.torque + command.kd * command.velocity  # at rest
    slack = 1.5 * bounds(spec, "torque")[2] + command.kd * bounds(spec, "velocity")[2]
    assert abs(applied - max(-spec.torque_range, min(spec.torque_range, torque))) <= slack


def test_a_reversed_motor_has_reversed_angle_and_torque():
    motor = JointMotor(AK60, 1, direction=-1, zero=0.5, torque_scale=0.75)
    commanded = unpack_command(AK60, motor.command(1.5, 0.0)).torque
    assert commanded == pytest.approx(-2.0, abs=0.004)
    reply = motor.sample(pack_reply(AK60, 1, 0.2, 1.0, commanded), 0.0)
    assert reply[:3] == pytest.approx((0.3, -1.0, 1.5), abs=0.02)


@SPECS
def test_damping_alone_does_not_push_an_arm_at_rest(spec):
    command = unpack_command(spec, JointMotor(spec, 1).command(0.0, 5.0))
    assert abs(command.torque + command.kd * command.velocity) < spec.torque_range / 4095 * 1.01


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
    assert not is_special(b"\xff" * 7 + b"\xed") and not is_special(b"\xff" * 6 + b"\xfe\xfc")
    assert not is_special(ENTER[1:])


@pytest.mark.parametrize(
    ("frame_id", "length", "is_remote"),
    [(3, 6, False), (3, 1, False), (3, 0, False), (3, 0, True), (0x83, 8, False), (0x703, 1, False), (0x103, 0, True)],
)
def test_a_motor_may_obey_short_and_remote_frames_and_ids_whose_lowest_7_bits_are_its_own(frame_id, length, is_remote):
    kind = COMMAND if frame_id == 3 else ALIAS
    assert MIT.classify(frame_id, b"\xff" * length, IDS, is_remote) == (kind, 3)
    assert MIT.classify(frame_id + 1, b"\xff" * length, IDS, is_remote) == (OTHER, 0)


def test_a_reply_of_another_length_is_malformed_and_a_status_frame_is_no_reply_of_a_v1_board():
    for length in (1, 5):
        assert MIT.classify(0, bytes((3,)) + bytes(length - 1), IDS) == (MALFORMED, 3)
    assert MIT.classify(EXTENDED | 0x2903, bytes(8), IDS) == (SERVO, 3)
    assert MIT.classify(EXTENDED | 0x2904, bytes(8), IDS) == (OTHER, 0)


def test_the_seventh_byte_of_the_open_drive_is_no_temperature():
    reply = unpack_reply(AK60, pack_reply(AK60, 3, 0.5, 0.0, 0.0) + b"\x4d")
    assert reply[:2] == (3, pytest.approx(0.5, abs=0.001)) and reply[4:] == (None, None)


@pytest.mark.parametrize(
    ("byte", "text"),
    [
        (2, "over-current; as a bit mask: warm, above 81 degC"),
        (6, "MOSFET over-temperature; as a bit mask: warm, above 81 degC, shut off, above 120 degC"),
        (9, "unknown; as a bit mask: unknown, unknown"),
    ],
)
def test_an_error_byte_is_printed_with_both_readings(byte, text):
    assert error_text(byte) == text


def test_a_reply_has_any_temperature_of_a_byte_and_no_angle_beyond_its_range():
    for temperature in (-40, 215):
        assert unpack_reply(AK60, pack_reply(AK60, 255, 0.0, 0.0, 0.0, temperature, 0)).temperature == temperature
    for value in (math.nan, math.inf, 99.0):
        with pytest.raises(ParameterError):
            pack_reply(AK60, 1, value, 0.0, 0.0)


@pytest.mark.parametrize(
    ("field", "value"),
    [("can_id", 0), ("can_id", 127), ("direction", 0), ("zero", 11.0), ("zero", math.nan), ("torque_scale", 0.0)],
)
def test_an_impossible_motor_is_rejected_by_name(field, value):
    with pytest.raises(ParameterError) as caught:
        JointMotor(AK60, **{"can_id": 1, field: value})
    assert caught.value.name == field


def test_a_v1_command_and_reply_have_the_bytes_worked_out_by_hand():
    # position 0 -> 32767.5 -> 32768, velocity 0 -> 2047.5 -> 2048, kp 0, kd 4095, torque 3 of +-15 -> 2457
    assert pack_command(AK60, 0.0, 0.0, 0.0, 5.0, 3.0) == bytes.fromhex("8000800000fff999")
    # motor 7, position 0xffff -> 12.5, velocity 0 -> -45, torque 2457 -> 3, 70 - 40 degC, error 2
    data = bytes.fromhex("07 ffff 000999 46 02")
    assert unpack_reply(AK60, data) == (7, *(pytest.approx(value) for value in (12.5, -45.0, 3.0)), 30, 2)


def test_a_v3_command_has_the_bytes_worked_out_by_hand():
    # kp 0, kd 4095/4095, position 0 -> 32767.5 -> 32768, velocity 0 -> 2047.5 -> 2048, torque 12 -> 4095
    assert MIT_V3.pack_command(V3_AK60, 0.0, 0.0, 0.0, 5.0, 12.0) == bytes.fromhex("000fff8000800fff")
    assert JointMotor(V3_AK60, 0x7E, wire_format=MIT_V3).command_id == EXTENDED | 0x87E


def test_a_v3_status_frame_has_the_values_worked_out_by_hand():
    # 90.0 deg, 840 x 10 electrical rpm / 14 pole pairs / gear 6 = 100 rpm, -2 A x 0.2997 Nm/A, -5 degC, error 7
    data = bytes.fromhex("0384 0348 ff38 fb 07")
    reply = MIT_V3.unpack_reply(V3_AK60, 3, data)
    assert reply[:3] == (3, pytest.approx(math.pi / 2), pytest.approx(100.0 * 2.0 * math.pi / 60.0))
    assert reply[3:] == (pytest.approx(-2.0 * 0.2997), -5, 7)
    assert MIT_V3.reply_id(3) == EXTENDED | 0x2903
    assert MIT_V3.unpack_reply(V3_AK80, 3, data).velocity == pytest.approx(8400.0 / 21 / 9 * 2.0 * math.pi / 60.0)


def test_a_v3_board_is_switched_off_by_a_current_of_0_and_obeys_every_control_mode():
    motor = JointMotor(V3_AK60, 5, wire_format=MIT_V3)
    assert motor.exit == ((EXTENDED | 0x105, bytes(4)),)
    assert motor.enter == motor.set_zero == ()
    for mode in range(16):
        assert MIT_V3.classify(EXTENDED | mode << 8 | 2, bytes(4), IDS) == (COMMAND, 2)
        assert MIT_V3.classify(EXTENDED | mode << 8 | 9, bytes(4), IDS) == (OTHER, 0)
        assert MIT_V3.classify(EXTENDED | mode << 8 | 0xFF, bytes(4), IDS) == (COMMAND, BROADCAST_ID)
    for length in (0, 7, 9):  # of a status frame
        assert MIT_V3.classify(MIT_V3.reply_id(1), bytes(length), IDS) == (MALFORMED, 1)


def test_a_motor_keeps_its_wire_format_on_the_way_to_the_watchdog():
    for board in FORMATS.values():
        motor = JointMotor(board.ranged(MOTORS["AK80-9"]), 4, wire_format=board)
        assert pickle.loads(pickle.dumps(motor)) == motor


def parameters(**given: object) -> dict[str, object]:
    return values_of(CAN_BRIDGE, {"can.interface": "virtual", "can.channel": "c", **given})


def test_each_joint_has_the_ranges_of_its_own_wire_format():
    motors = motors_of(parameters(wire_format=["mit", "mit_v3", "mit_v3", "mit"]))
    assert [motor.wire_format.name for motor in motors] == ["mit", "mit_v3", "mit_v3", "mit"]
    assert [motor.spec.torque_range for motor in motors] == [15.0, 18.0, 12.0, 15.0]
    assert [motor.spec.velocity_range for motor in motors] == [45.0, 65.0, 60.0, 45.0]


def test_the_torque_range_of_a_v1_board_is_refused_for_a_v3_board():
    given = {"wire_format": ["mit_v3"] * 4, "torque_range": [15.0, 0.0, 0.0, 0.0]}
    with pytest.raises(ParameterError, match=r"torque_range = 15\.0: must be 12 or 0 for an AK60-6 with wire_format"):
        motors_of(parameters(**given))
    assert motors_of(parameters(**{**given, "torque_range": [9.0, 0.0, 0.0, 0.0]}))[0].spec.torque_range == 9.0


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("motor_timeout", 0.1, r"must be 0 \(never\) or from 0\.15 to 0\.5 s"),
        ("motor_timeout", 3.0, r"must be 0 \(never\) or from 0\.15 to 0\.5 s"),
        ("motor_timeout", math.nan, r"must be 0 \(never\) or from 0\.15 to 0\.5 s"),
        ("position_range", 10.0, r"must be 0, the usual one of the motor, or from 12\.4 to 12\.6"),
        ("torque_per_ampere", 0.3, "must be 0 with wire_format = mit, whose replies carry the torque itself"),
    ],
)
def test_a_value_that_no_firmware_has_is_refused(name, value, sentence):
    with pytest.raises(ParameterError, match=f"{name} = .*: {sentence}"):
        motors_of(parameters(**{name: [0.0, value, 0.0, 0.0]}))


def test_each_motor_has_the_time_out_and_position_range_of_its_own_firmware():
    motors = motors_of(parameters(motor_timeout=[0.0, 0.15, 0.5, 0.3], position_range=[12.56, 0.0, 12.5, 12.566]))
    assert [motor.timeout for motor in motors] == [0.0, 0.15, 0.5, 0.3]
    assert [motor.spec.position_range for motor in motors] == [12.56, 12.5, 12.5, 12.566]
    quarter_turn = pack_reply(motors[0].spec, 1, math.pi / 2, 0.0, 0.0)
    assert motors[0].sample(quarter_turn, 0.0).position == pytest.approx(math.pi / 2, abs=0.001)
    assert motors[1].sample(quarter_turn, 0.0).position == pytest.approx(math.radians(90.0 - 0.43), abs=0.001)


def test_the_torque_of_a_v3_board_is_its_current_times_the_torque_per_ampere_of_its_firmware():
    given = {"wire_format": ["mit_v3"] * 4, "torque_per_ampere": [0.0, 0.0, 0.45, 0.0]}
    data = bytes.fromhex("0000 0000 03e8 19 00")  # 10 A
    efforts = [motor.sample(data, 0.0).effort for motor in motors_of(parameters(**given))]
    assert efforts == pytest.approx([2.997, 10.0 * 9.0 / 10.3, 4.5, 2.997])
