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
    for can_id, bus in ((7, first), (9, first), (8, second), (1, second)):
        bus.send(frame(can_id, LOW))
        wire.clock.sleep(10e-6 if can_id == 9 else 0.0)
    arrived = []
    start = wire.clock.monotonic() - 10e-6
    while message := listener.recv(0.01):
        arrived.append((message.arbitration_id, wire.clock.monotonic() - start))
    assert [can_id for can_id, _ in arrived] == [7, 8, 1, 9]
    expected = stuffed_bits(7, LOW) / BITRATE
    assert arrived[0][1] == pytest.approx(expected, abs=1e-8)
    assert arrived[1][1] == pytest.approx(expected + stuffed_bits(8, LOW) / BITRATE, abs=1e-7)
    assert (wire.collisions, wire.tec) == (0, 0)


@pytest.mark.parametrize(
    ("second_data", "arrive", "collisions"),
    [
        (LOW, [LOW, HIGH], 16 + 1),  # the dominant bit goes through; 16 times 8 is 128; the next error flag is passive
        (HIGH, [HIGH], 0),
    ],
    ids=["until they are error passive", "frames that are equal do not collide"],
)
def test_two_senders_of_one_id_meet_again(wire, second_data, arrive, collisions):
    first, second, listener = wire.open(), wire.open(), wire.open()
    first.send(frame(1, HIGH))
    second.send(frame(1, second_data))
    wire.clock.sleep(0.02)
    assert [bytes(listener.recv(0.0).data) for _ in arrive] == arrive and listener.recv(0.01) is None
    assert (wire.collisions, wire.tec, wire.bus_offs) == (collisions, 8 * collisions, 0)


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


LATE = replace(FIRMWARES["open_drive"], reply_delay=FIRMWARES["ak"].reply_delay)  # to the master's ID


@pytest.mark.parametrize(
    ("firmware", "at_once"),
    [(FIRMWARES["ak"], (8, 24)), (FIRMWARES["vendor"], (8, 24)), (LATE, (1, 1000)), (FIRMWARES["open_drive"], (0, 0))],
    ids=["ak", "vendor", "late to the master's ID", "at once to the master's ID: they follow each other"],
)
def test_frames_to_a_motor_that_owes_a_reply_collide_and_awaited_ones_never(wire, firmware, at_once):
    device = make_device(firmware)
    wire.play(device)
    host = wire.open()
    assert enable(wire, host, is_awaiting=True) == 0 and wire.tec == 0
    least, most = at_once
    assert least <= enable(wire, host, is_awaiting=False) <= most and (wire.tec >= 128) == (least == 8)
    assert device.powered
