"""The motors' frames: every code survives a round trip, nothing overflows, and no command is a special frame."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from exo_gravity.core.errors import FrameError, ParameterError
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import MOTORS, SPECIAL_FRAMES, pack_command, pack_reply, unpack_command, unpack_reply

AK60, AK80 = MOTORS["AK60-6"], MOTORS["AK80-9"]
SPECS = pytest.mark.parametrize("spec", MOTORS.values(), ids=MOTORS)


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


@SPECS
def test_the_largest_values_do_not_overflow(spec):
    command = unpack_command(spec, pack_command(spec, 12.5, -spec.velocity_range, 0.0, 0.0, spec.torque_range))
    assert command.torque == pytest.approx(spec.torque_range)
    assert command.position == pytest.approx(12.5)
    assert command.velocity == pytest.approx(-spec.velocity_range)


def test_zero_torque_is_packed_to_the_nearest_code():
    for spec in MOTORS.values():
        off = unpack_command(spec, pack_command(spec, 0.0, 0.0, 0.0, 0.0, 0.0))
        assert abs(off.torque) <= spec.torque_range / 4095 * 1.0001


@given(
    st.sampled_from(list(MOTORS.values())),
    *(st.sampled_from([-1.0, 1.0]) | st.floats(-1, 1) for _ in range(2)),
    *(st.just(1.0) | st.floats(0, 1) for _ in range(2)),
    st.floats(0.99, 1.0) | st.floats(-1, 1),
)
def test_no_command_is_ever_a_special_frame(spec, position, velocity, kp, kd, torque):
    data = pack_command(
        spec, position * 12.5, velocity * spec.velocity_range, kp * 500, kd * 5, torque * spec.torque_range
    )
    assert data not in SPECIAL_FRAMES


@pytest.mark.parametrize("codes_below_top", [1, 2, 3])
def test_a_command_that_would_spell_a_special_frame_gets_a_slightly_lower_torque(codes_below_top):
    torque = 15.0 - codes_below_top * 30.0 / 4095
    data = pack_command(AK60, 12.5, 45.0, 500.0, 5.0, torque)
    assert data not in SPECIAL_FRAMES
    assert 0.0 <= torque - unpack_command(AK60, data).torque < 0.025


@pytest.mark.parametrize("field", range(5))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e3, -1e3])
def test_a_command_out_of_range_or_not_finite_is_rejected(field, value):
    fields = [0.0] * 5
    fields[field] = value
    with pytest.raises(ParameterError, match="must be from"):
        pack_command(AK60, *fields)


@pytest.mark.parametrize("value", [math.nan, math.inf, 99.0])
def test_a_reply_out_of_range_or_not_finite_is_rejected(value):
    with pytest.raises(ParameterError):
        pack_reply(AK60, 1, value, 0.0, 0.0)


def test_a_6_byte_reply_has_no_temperature_and_an_8_byte_reply_has_one():
    short = unpack_reply(AK80, pack_reply(AK80, 2, 1.0, -2.0, 3.0))
    long = unpack_reply(AK80, pack_reply(AK80, 2, 1.0, -2.0, 3.0, temperature=-40, error=7))
    assert (short.temperature, short.error) == (None, None)
    assert (long.temperature, long.error) == (-40, 7)
    assert long.position == pytest.approx(1.0, abs=25 / 65535)
    assert long.velocity == pytest.approx(-2.0, abs=100 / 4095)
    assert long.torque == pytest.approx(3.0, abs=36 / 4095)


@given(st.binary(max_size=16))
def test_any_bytes_are_decoded_within_range_or_rejected(data):
    try:
        reply = unpack_reply(AK60, data)
    except FrameError as error:
        assert error.data == data
        return
    assert len(data) in (6, 8)
    assert abs(reply.position) <= 12.5 + 1e-9
    assert abs(reply.torque) <= 15.0 + 1e-9


@pytest.mark.parametrize("data", [b"", b"\x00" * 7, *SPECIAL_FRAMES])
def test_bytes_that_are_not_a_command_are_rejected(data):
    with pytest.raises(FrameError):
        unpack_command(AK60, data)


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


def test_an_effort_beyond_the_wire_range_is_clamped_and_one_that_is_not_finite_is_rejected():
    motor = JointMotor(AK60, 1)
    assert unpack_command(AK60, motor.command(99.0, 0.0)).torque == pytest.approx(15.0)
    for effort in (math.nan, math.inf):
        with pytest.raises(ParameterError):
            motor.command(effort, 0.0)


@pytest.mark.parametrize(
    ("field", "value"),
    [("can_id", 0), ("can_id", 127), ("direction", 0), ("zero", 11.0), ("zero", math.nan), ("torque_scale", 0.0)],
)
def test_an_impossible_motor_is_rejected_by_name(field, value):
    with pytest.raises(ParameterError) as caught:
        JointMotor(AK60, **{"can_id": 1, field: value})
    assert caught.value.name == field
