# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Frames on a wire with a bit rate: their time, their order, and what two senders with one ID do to each other."""

from __future__ import annotations

from dataclasses import replace

import can
import pytest

from exo_gravity.core.motors.frames import ENTER
from exo_gravity.sim import FIRMWARES
from exo_gravity.sim.arbitration import TAIL_BITS, frame_bits
from exo_gravity.sim.virtual_time import VirtualBus, Wire

from ..core.test_bus_load import stuffed_bits
from ..support.simulated_device import command, frame, make_device

BITRATE = 1_000_000
IDS = (1, 2, 3, 4)
HIGH, LOW = b"\x80" + bytes(7), bytes(8)  # data of two frames that differ in their first bit


@pytest.fixture
def wire():
    return Wire(bitrate=BITRATE)


def sent(wire: Wire, bus: VirtualBus, *frames: can.Message) -> None:
    for message in frames:
        bus.send(message)


@pytest.mark.parametrize(
    ("can_id", "data", "is_extended"),
    [
        (1, ENTER, False),
        (4, bytes(8), False),
        (0x7F, bytes(range(8)), False),
        (0x803, ENTER, True),
        (0x2904, LOW, True),
        (5, b"", False),
    ],
)
def test_the_bits_of_a_frame_are_those_of_the_specification(can_id, data, is_extended):
    message = can.Message(arbitration_id=can_id, data=data, is_extended_id=is_extended)
    assert len(frame_bits(message)) + TAIL_BITS == stuffed_bits(can_id, data, is_extended)


def test_frames_take_the_time_of_their_bits_and_the_lowest_waiting_id_is_next(wire):
    first, second, listener = wire.open(), wire.open(), wire.open()
    sent(wire, first, frame(7, LOW), frame(9, LOW))
    wire.clock.sleep(10e-6)
    sent(wire, second, frame(8, LOW), frame(1, LOW))
    arrived = []
    start = wire.clock.monotonic() - 10e-6
    while message := listener.recv(0.01):
        arrived.append((message.arbitration_id, wire.clock.monotonic() - start))
    assert [can_id for can_id, _ in arrived] == [7, 8, 1, 9]
    expected = stuffed_bits(7, LOW) / BITRATE
    assert arrived[0][1] == pytest.approx(expected, abs=1e-8)
    assert arrived[1][1] == pytest.approx(expected + stuffed_bits(8, LOW) / BITRATE, abs=1e-7)
    assert (wire.collisions, wire.tec) == (0, 0)


def test_two_senders_of_one_id_meet_again_until_they_are_error_passive(wire):
    first, second, listener = wire.open(), wire.open(), wire.open()
    sent(wire, first, frame(1, HIGH))
    sent(wire, second, frame(1, LOW))
    wire.clock.sleep(0.02)
    assert [bytes(listener.recv(0.0).data) for _ in range(2)] == [LOW, HIGH]  # the dominant bit goes through
    assert wire.collisions == 16 + 1  # 16 times 8 is 128; the next error flag is passive
    assert wire.tec == 17 * 8 and wire.bus_offs == 0


def test_frames_that_are_equal_do_not_collide(wire):
    first, second, listener = wire.open(), wire.open(), wire.open()
    sent(wire, first, frame(1, LOW))
    sent(wire, second, frame(1, LOW))
    assert bytes(listener.recv(0.01).data) == LOW and listener.recv(0.01) is None
    assert wire.collisions == 0


def test_a_sender_that_fails_too_often_is_off_the_bus_for_a_while(wire):
    host, listener = wire.open(), wire.open()
    for _ in range(40):
        host.send(frame(1, HIGH))
        wire.carry(None, frame(1, LOW), "one shot", False)
        wire.carry(None, frame(1, LOW), "another", False)
        wire.clock.sleep(0.001)
    assert wire.bus_offs > 0 and wire.tec >= 256
    wire.clock.sleep(0.2)
    while listener.recv(0.0):
        pass
    host.send(frame(1, HIGH))
    assert bytes(listener.recv(0.01).data) == HIGH


def enable(wire: Wire, host: VirtualBus, is_awaiting: bool) -> int:
    """Switch four motors on with three frames each, all at once or each after the reply to the last; return collisions.

    All at once is what the motor bus did at a47959f4.
    """
    before = wire.collisions
    for data in (lambda can_id: command(can_id - 1), lambda can_id: ENTER, lambda can_id: command(can_id - 1, 1.0)):
        for can_id in IDS:
            host.send(frame(can_id, data(can_id)))
            assert not is_awaiting or host.recv(0.01)
    wire.clock.sleep(0.01)
    while host.recv(0.0):
        pass
    return wire.collisions - before


@pytest.mark.parametrize("name", ["ak", "vendor"])
def test_three_frames_to_a_motor_that_owes_a_reply_collide_8_to_24_times_and_awaited_ones_never(wire, name):
    device = make_device(FIRMWARES[name])
    wire.play(device)
    host = wire.open()
    assert enable(wire, host, is_awaiting=True) == 0 and wire.tec == 0
    assert 8 <= enable(wire, host, is_awaiting=False) <= 24 and wire.tec >= 128
    assert device.powered


def test_replies_of_two_motors_to_the_masters_id_collide_unless_each_is_awaited(wire):
    late = replace(FIRMWARES["open_drive"], reply_delay=FIRMWARES["ak"].reply_delay)
    wire.play(make_device(late))
    host = wire.open()
    assert enable(wire, host, is_awaiting=True) == 0
    assert enable(wire, host, is_awaiting=False) > 0


def test_replies_that_are_sent_at_once_to_the_masters_id_follow_each_other(wire):
    wire.play(make_device(FIRMWARES["open_drive"]))
    assert enable(wire, wire.open(), is_awaiting=False) == 0
