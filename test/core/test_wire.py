"""The bits of CAN frames and the bus load, against the CAN specification and hand-computed figures."""

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors import bus_load as wire
from exo_gravity.core.motors.bus_load import (
    BITRATE,
    TYPICAL_COMMAND,
    TYPICAL_REPLY,
    Traffic,
    frame_bits,
    load,
    stuffed_bits,
    worst_frame_bits,
)
from exo_gravity.core.motors.specs import MOTORS, pack_command, pack_reply

SPEC = MOTORS["AK60-6"]


def frames(kind, count=2000, seed=5):
    """(can_id, data) of a carried arm in random poses of its workspace and at random permitted torques."""
    rng = np.random.default_rng(seed)
    for index in range(count):
        can_id = index % 4 + 1
        torque, position, velocity = rng.uniform((-3, -1.65, -1), (3, 3.14, 1))
        if kind == "command":
            yield can_id, pack_command(SPEC, 0.0, 0.0, 0.0, 0.0, torque)
        else:
            extra = (int(rng.integers(20, 60)), 0) if kind == 8 else ()
            yield can_id, pack_reply(SPEC, can_id, position, velocity, torque, *extra)


def test_a_frame_of_8_bytes_has_111_bits_and_at_most_135():
    assert (frame_bits(8), worst_frame_bits(8)) == (111, 135)


def test_a_frame_of_6_bytes_has_95_bits_and_at_most_115():
    assert (frame_bits(6), worst_frame_bits(6)) == (95, 115)


def test_an_empty_frame_with_id_0_has_the_stuff_bits_worked_out_by_hand():
    # 34 zeros (start, ID, control, length 0, a CRC of 0): a stuff bit after the first 5, then after every 5 more.
    assert stuffed_bits(0, b"") == frame_bits(0) + 34 // 5


def test_the_crc_agrees_with_the_check_value_of_crc_15_can():
    # Check value of CRC-15/CAN over the ASCII digits 1 to 9 (catalogue of parametrised CRC algorithms).
    bits = [byte >> place & 1 for byte in b"123456789" for place in range(7, -1, -1)]
    assert wire._crc(bits) == 0x059E


def test_every_frame_is_between_its_length_without_stuffing_and_the_worst_case():
    rng = np.random.default_rng(1)
    for _ in range(500):
        size = int(rng.integers(0, 9))
        data = bytes(rng.choice([0x00, 0xFF, 0x0F, 0x07, 0xF8], size).tolist())
        assert frame_bits(size) <= stuffed_bits(int(rng.integers(0, 2048)), data) <= worst_frame_bits(size)


@pytest.mark.parametrize(
    ("kind", "typical"), [("command", TYPICAL_COMMAND), (6, TYPICAL_REPLY[6]), (8, TYPICAL_REPLY[8])]
)
def test_the_typical_bits_are_the_mean_over_the_frames_of_a_carried_arm(kind, typical):
    assert np.mean([stuffed_bits(*frame) for frame in frames(kind)]) == pytest.approx(typical, abs=1.0)


def test_four_motors_at_500_hz_use_half_the_bus():
    assert load(500.0, 4).share == pytest.approx(0.48, abs=0.01)
    assert load(500.0, 4, worst=True).share == pytest.approx(0.54)


def test_the_largest_rate_of_four_motors_is_926_hz_at_worst_and_typically_above_1000_hz():
    assert load(1.0, 4, worst=True).largest_rate == pytest.approx(926.0, abs=0.5)
    assert 1000.0 < load(1.0, 4).largest_rate < 1061.0


def test_at_the_largest_rate_the_bus_is_full():
    for worst in (False, True):
        full = load(load(1.0, 4, worst=worst).largest_rate, 4, worst=worst)
        assert full.share == pytest.approx(1.0) and full.bits_per_second == pytest.approx(BITRATE)


def test_shorter_replies_and_fewer_motors_load_the_bus_less():
    assert load(500.0, 4, 6).share < load(500.0, 4).share
    assert load(500.0, 8).share == pytest.approx(2 * load(500.0, 4).share)


def test_a_rate_beyond_the_bus_capacity_is_rejected_with_the_largest_rate():
    assert Traffic(4).check(1000.0).share < 1.0
    with pytest.raises(ParameterError, match=r"rate = 600\.0: must be at most 516 Hz"):
        Traffic(8).check(600.0)


@pytest.mark.parametrize(
    ("rate", "motors", "reply_bytes"), [(0.0, 4, 8), (float("nan"), 4, 8), (500.0, 0, 8), (500.0, 4, 7)]
)
def test_an_invalid_rate_motor_count_or_reply_length_is_rejected(rate, motors, reply_bytes):
    with pytest.raises(ParameterError):
        load(rate, motors, reply_bytes)
