"""The motors' frames in the format `mit`, and a motor on a joint.

Every code survives a round trip, no command is a special frame, and any bytes or numbers give a value within the wire
range or a clear error.
"""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import MOTORS, SPECIAL_FRAMES, pack_command, pack_reply, unpack_command, unpack_reply

AK60 = MOTORS["AK60-6"]
SPECS = pytest.mark.parametrize("spec", MOTORS.values(), ids=MOTORS)
COMMAND, REPLY = ("position", "velocity", "kp", "kd", "torque"), ("position", "velocity", "torque")
SPECIAL_NUDGE = 3  # codes by which the torque is reduced at most if the command would spell a special frame
LONGEST = 80  # bytes; CAN FD has up to 64

seeded = settings(max_examples=200, derandomize=True, database=None, deadline=None)
BYTES = st.binary(max_size=LONGEST) | st.binary(min_size=6, max_size=6) | st.binary(min_size=8, max_size=8)
NUMBERS = st.floats() | st.floats(-20.0, 20.0) | st.floats(0.0, 600.0) | st.integers(-(10**30), 10**30)
EXTREME_CODES = st.lists(st.sampled_from((0x00, 0xFF)), min_size=8, max_size=8).map(bytes)
SHARES = st.floats(-1.0, 1.0) | st.sampled_from((-1.0, 0.0, 1.0))


@st.composite
def specs(draw):
    """A motor with its default ranges or with those of another firmware."""
    spec = draw(st.sampled_from(list(MOTORS.values())))
    return draw(st.just(spec) | st.builds(spec.with_ranges, st.floats(1.0, 100.0), st.floats(1.0, 100.0)))


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


def scaled(spec, field, share):
    low, high, _ = bounds(spec, field)
    return min(high, max(low, (low + high) / 2.0 + share * (high - low) / 2.0))


@seeded
@given(specs(), st.tuples(*[NUMBERS] * 5))
def test_any_numbers_give_a_command_of_8_bytes_or_an_error_that_names_the_field(spec, values):
    inside = [bounds(spec, f)[0] <= v <= bounds(spec, f)[1] for f, v in zip(COMMAND, values, strict=True)]
    if all(inside):
        assert len(pack_command(spec, *values)) == 8
        return
    with pytest.raises(ParameterError) as caught:
        pack_command(spec, *values)
    assert caught.value.name == COMMAND[inside.index(False)]


@seeded
@given(specs(), st.tuples(*[SHARES] * 5))
def test_a_command_survives_a_round_trip_within_half_a_code(spec, shares):
    sent = [scaled(spec, field, share) for field, share in zip(COMMAND, shares, strict=True)]
    data = pack_command(spec, *sent)
    assert data not in SPECIAL_FRAMES
    got = unpack_command(spec, data)
    top = all(g >= bounds(spec, f)[1] - 1e-9 for f, g in zip(COMMAND[:4], got[:4], strict=True))
    for field, wanted, value in zip(COMMAND, sent, got, strict=True):
        codes = 0.5 + (SPECIAL_NUDGE if top and field == "torque" else 0)
        assert abs(value - wanted) <= (codes + 1e-6) * bounds(spec, field)[2]


@seeded
@given(specs(), st.tuples(*[SHARES] * 3), st.integers(0, 255), st.integers(-40, 215) | st.none(), st.integers(0, 255))
def test_a_reply_survives_a_round_trip_within_half_a_code(spec, shares, motor_id, temperature, error):
    sent = [scaled(spec, field, share) for field, share in zip(REPLY, shares, strict=True)]
    got = unpack_reply(spec, pack_reply(spec, motor_id, *sent, temperature, error))
    assert (got.motor_id, got.temperature) == (motor_id, temperature)
    assert got.error == (None if temperature is None else error)
    for field, wanted, value in zip(REPLY, sent, got[1:4], strict=True):
        assert abs(value - wanted) <= (0.5 + 1e-6) * bounds(spec, field)[2]


@seeded
@given(specs(), BYTES)
def test_any_bytes_decode_to_a_reply_within_range_or_an_error_that_shows_them(spec, data):
    try:
        reply = unpack_reply(spec, data)
    except FrameError as error:
        assert len(data) not in (6, 8) and error.data == data
        return
    assert len(data) in (6, 8) and 0 <= reply.motor_id <= 255
    assert_within(spec, REPLY, reply[1:4])
    assert (reply.temperature is None) == (reply.error is None) == (len(data) == 6)


@seeded
@given(specs(), BYTES | st.sampled_from(SPECIAL_FRAMES))
def test_any_bytes_decode_to_a_command_within_range_or_an_error_that_shows_them(spec, data):
    try:
        command = unpack_command(spec, data)
    except FrameError as error:
        assert (len(data) != 8 or data in SPECIAL_FRAMES) and error.data == data
        return
    assert len(data) == 8
    assert_within(spec, COMMAND, command)


@seeded
@given(specs(), st.binary(min_size=8, max_size=8) | EXTREME_CODES)
def test_decoded_bytes_are_packed_to_the_same_bytes(spec, data):
    assume(data not in SPECIAL_FRAMES)
    command, reply = unpack_command(spec, data), unpack_reply(spec, data)
    assume(data[:7] != b"\xff" * 7)  # next to a special frame the torque may have been reduced
    assert pack_command(spec, *command) == data
    assert pack_reply(spec, *reply) == data


@st.composite
def joints(draw):
    return JointMotor(
        draw(specs()),
        draw(st.integers(1, 126)),
        draw(st.sampled_from((1, -1))),
        draw(st.floats(-9.0, 9.0)),
        draw(st.floats(0.2, 2.0)),
    )


@seeded
@given(joints(), NUMBERS, NUMBERS)
def test_a_joint_packs_any_effort_without_stiffness_or_rejects_it(motor, effort, damping):
    try:
        command = unpack_command(motor.spec, motor.command(effort, damping))
    except ParameterError:
        assert not (math.isfinite(effort) and abs(effort) < 1e100 and 0.0 <= damping <= motor.spec.kd_max)
        return
    assert_within(motor.spec, COMMAND, command)
    kd = min(damping / motor.torque_scale, motor.spec.kd_max)
    assert command.kp == 0.0 and abs(command.kd - kd) <= bounds(motor.spec, "kd")[2]
    torque = motor.direction * effort / motor.torque_scale
    slack = (1.5 + kd) * max(bounds(motor.spec, field)[2] for field in ("torque", "velocity"))
    assert abs(command.torque - max(-motor.spec.torque_range, min(motor.spec.torque_range, torque))) <= slack


@seeded
@given(joints(), BYTES)
def test_a_joint_decodes_any_bytes_to_finite_numbers_or_rejects_them(motor, data):
    try:
        reply = motor.joint_reply(data)
    except FrameError:
        assert len(data) not in (6, 8)
        return
    assert all(map(math.isfinite, reply[1:4]))
    assert abs(reply.position) <= motor.spec.position_range + abs(motor.zero) + 1e-9


@seeded
@given(joints(), st.floats(-3.0, 3.0))
def test_a_joint_angle_survives_a_round_trip_within_one_code(motor, angle):
    data = pack_reply(motor.spec, motor.can_id, motor.motor_position(angle), 0.0, 0.0)
    assert motor.joint_reply(data).position == pytest.approx(angle, abs=bounds(motor.spec, "position")[2])


def command_word(**codes) -> bytes:
    """A command built from the manual's table, independent of the code under test."""
    bits = "".join(f"{codes[name]:0{width}b}" for name, width in LAYOUT)
    return int(bits, 2).to_bytes(8, "big")


LAYOUT = (("position", 16), ("velocity", 12), ("kp", 12), ("kd", 12), ("torque", 12))


@SPECS
@pytest.mark.parametrize(("field", "width"), LAYOUT)
def test_every_code_of_every_command_field_survives_unpack_and_pack(spec, field, width):
    middle = {"position": 0x1234, "velocity": 0x567, "kp": 0x89A, "kd": 0xBC, "torque": 0xDEF}
    for code in range(1 << width):
        data = command_word(**{**middle, field: code})
        assert pack_command(spec, *unpack_command(spec, data)) == data


@SPECS
@pytest.mark.parametrize(("offset", "width"), [(24, 16), (12, 12), (0, 12)])
def test_every_code_of_every_reply_field_survives_unpack_and_pack(spec, offset, width):
    for code in range(1 << width):
        data = (5 << 40 | (0x123456789 & ~(((1 << width) - 1) << offset)) | code << offset).to_bytes(6, "big")
        reply = unpack_reply(spec, data)
        assert pack_reply(spec, reply.motor_id, reply.position, reply.velocity, reply.torque) == data


@pytest.mark.parametrize("codes_below_top", [1, 2, 3])
def test_a_command_that_would_spell_a_special_frame_gets_a_slightly_lower_torque(codes_below_top):
    torque = 15.0 - codes_below_top * 30.0 / 4095
    data = pack_command(AK60, 12.5, 45.0, 500.0, 5.0, torque)
    assert data not in SPECIAL_FRAMES
    assert 0.0 <= torque - unpack_command(AK60, data).torque < 0.025


@pytest.mark.parametrize("value", [math.nan, math.inf, 99.0])
def test_a_reply_out_of_range_or_not_finite_is_rejected(value):
    with pytest.raises(ParameterError):
        pack_reply(AK60, 1, value, 0.0, 0.0)


def test_a_reversed_motor_has_reversed_angle_and_torque():
    motor = JointMotor(AK60, 1, direction=-1, zero=0.5, torque_scale=0.75)
    assert motor.joint_position(0.2) == pytest.approx(0.3)
    assert motor.motor_position(motor.joint_position(0.2)) == pytest.approx(0.2)
    commanded = unpack_command(AK60, motor.command(1.5, 0.0)).torque
    assert commanded == pytest.approx(-2.0, abs=0.004)
    assert motor.joint_effort(commanded) == pytest.approx(1.5, abs=0.003)


@pytest.mark.parametrize("spec", MOTORS.values(), ids=MOTORS)
def test_damping_alone_does_not_push_an_arm_at_rest(spec):
    command = unpack_command(spec, JointMotor(spec, 1).command(0.0, 5.0))
    assert abs(command.torque + command.kd * command.velocity) < spec.torque_range / 4095 * 1.01


@pytest.mark.parametrize(
    ("field", "value"),
    [("can_id", 0), ("can_id", 127), ("direction", 0), ("zero", 11.0), ("zero", math.nan), ("torque_scale", 0.0)],
)
def test_an_impossible_motor_is_rejected_by_name(field, value):
    with pytest.raises(ParameterError) as caught:
        JointMotor(AK60, **{"can_id": 1, field: value})
    assert caught.value.name == field
