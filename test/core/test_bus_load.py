# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The bits of CAN frames and the bus load, against the CAN specification and hand-computed figures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from exo_gravity.core.motors.ak import MIT_V3, pack_reply
from exo_gravity.core.motors.damiao import DAMIAO_MIT
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ID_BITS, MotorReply, pack_command
from exo_gravity.core.motors.joint_motor import (
    BITRATE,
    COMMAND_BITS,
    FD_BITS,
    FD_COMMAND_BITS,
    FD_REPLY_BITS,
    REPLY_BITS,
    STATUS_BITS,
    V3_COMMAND_BITS,
    Traffic,
    traffic_of,
)

AK60 = MOTORS["AK60-6"]
V3, FD = MIT_V3.ranged(AK60), MOTORS["DM-J4340"]
AK = {"motor": ["AK60-6"] * 4}


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


def frames(kind: str) -> Iterator[tuple[int, bytes, bool]]:
    """ID, data and kind of ID of a carried arm's frames, in random poses and at random permitted torques."""
    rng = np.random.default_rng(5)
    for index in range(2000):
        can_id = index % 4 + 1
        torque, position, velocity = rng.uniform((-3, -1.65, -1), (3, 3.14, 1)).tolist()
        temperature = int(rng.integers(20, 60))
        if kind == "command":
            yield can_id, pack_command(AK60, 0.0, 0.0, 0.0, 0.0, torque), False
        elif kind == "reply":
            yield can_id, pack_reply(AK60, can_id, position, velocity, torque, temperature, 0), False
        elif kind == "FD command":
            yield index % 8 + 1, pack_command(FD, 0.0, 0.0, 0.0, 0.0, 3.0 * torque), False
        elif kind == "FD reply":
            reply = MotorReply(index % 8 + 1, position, velocity, 3.0 * torque, temperature, 0)
            yield DAMIAO_MIT.reply_id(reply.motor_id), DAMIAO_MIT.pack_reply(FD, reply, True), False
        elif kind == "V3 command":
            yield (MIT_V3.first_id + can_id) & ID_BITS, MIT_V3.pack_command(V3, 0.0, 0.0, 0.0, 0.0, torque), True
        else:
            reply = MotorReply(can_id, position, velocity, torque, temperature, 0)
            yield MIT_V3.reply_id(can_id) & ID_BITS, MIT_V3.pack_reply(V3, reply), True


def test_the_counter_of_this_test_agrees_with_a_hand_count_and_the_check_value_of_crc_15_can():
    # 34 zeros (start, ID, control, length 0, a CRC of 0): a stuff bit after the first 5, then after every 5 more.
    assert stuffed_bits(0, b"") == frame_bits(0)[0] + 34 // 5
    assert crc([bit for byte in b"123456789" for bit in bits_of(byte, 8)]) == 0x059E


@pytest.mark.parametrize(
    ("kind", "bits"),
    [("command", COMMAND_BITS), ("reply", REPLY_BITS), ("V3 command", V3_COMMAND_BITS), ("V3 status", STATUS_BITS)],
)
def test_typical_bits_are_the_mean_of_a_carried_arm_and_the_most_those_of_the_specification(kind, bits):
    assert np.mean([stuffed_bits(*frame) for frame in frames(kind)]) == pytest.approx(bits.typical, abs=1.0)
    assert bits.most == frame_bits(8, kind.startswith("V3"))[1]


def fd_bits(can_id: int, data: bytes) -> tuple[int, int]:
    """The bits of a CAN FD frame at the bit rates of arbitration and of data, with its stuff bits before the CRC.

    After the data: stuff count 4, CRC 17, 6 fixed stuff bits; then, slowly again, 13 bits to the next frame.
    """
    head = [0, *bits_of(can_id, 11), 0, 0, 1, 0, 1]
    rest = [0, *bits_of(len(data), 4), *(bit for byte in data for bit in bits_of(byte, 8))]
    places = stuffed([*head, *rest])
    slow = sum(place < len(head) for place in places)
    return len(head) + 13 + slow, len(rest) + 27 + len(places) - slow


@pytest.mark.parametrize(("kind", "fast"), [("FD command", FD_COMMAND_BITS), ("FD reply", FD_REPLY_BITS)])
def test_typical_bits_of_can_fd_are_the_mean_of_a_carried_arm(kind, fast):
    bits = [fd_bits(can_id, data) for can_id, data, _ in frames(kind)]
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


SLCAN = {"can.interface": "slcan", "wire_format": ["mit", "mit", "mit_v3", "mit_v3"], **AK}
SOCKETCAN = {"can.interface": "socketcan", "wire_format": ["mit"] * 4, **AK}
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
