"""Who answers on a bus, found without moving a motor."""

from __future__ import annotations

import contextlib
import itertools
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.specs import ENTER, SET_ZERO, unpack_command
from exo_gravity.core.motors.wire_formats import MIT, MIT_V3
from exo_gravity.hardware.can.bus_scan import NOTHING, BusScan
from exo_gravity.hardware.ownership.bus_lock import Address, BusLock
from exo_gravity.sim import Firmware, SimulatedDevice

from ..support.simulated_device import SPECS, frame, make_device

CHANNELS = itertools.count()
Answering = Callable[[can.Message], list[can.Message]]


@pytest.fixture
def address(lock_folder: Path) -> Address:
    """A bus that no other test uses."""
    return "virtual", f"scan-{os.getpid()}-{next(CHANNELS)}", {}


@contextlib.contextmanager
def device_on(address: Address, *devices: SimulatedDevice) -> Iterator[None]:
    """Run `devices` in threads on a bus."""
    stop = threading.Event()
    buses = [can.Bus(interface=address[0], channel=address[1]) for _ in devices]
    threads = [
        threading.Thread(target=device.run, args=(bus, stop.is_set)) for device, bus in zip(devices, buses, strict=True)
    ]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread, bus in zip(threads, buses, strict=True):
            thread.join()
            bus.shutdown()


@contextlib.contextmanager
def responder(address: Address, answer: Answering) -> Iterator[list[can.Message]]:
    """Answer every frame on a bus with those that `answer` returns; yield the list of frames received."""
    received: list[can.Message] = []
    with can.Bus(interface=address[0], channel=address[1]) as bus:

        def listen(message: can.Message) -> None:
            received.append(message)
            for reply in answer(message):
                bus.send(reply)

        notifier = can.Notifier(bus, [listen], timeout=0.01)
        yield received
        notifier.stop()


@pytest.mark.parametrize("firmware", [Firmware(), Firmware(reply_to_master=True, reply_length=6)])
def test_every_motor_is_found_with_its_reply_length_and_angle(address: Address, firmware: Firmware) -> None:
    device = make_device(firmware, ids=(1, 126, 7, 40))
    device.encoder_error = (0.5, -0.2, 1.0, 0.0)
    with device_on(address, device), BusScan(address) as bus:
        answers, problems = bus.scan((1, 2, 7, 39, 40, 41, 126))
    assert problems == ()
    assert [answer.can_id for answer in answers] == [1, 7, 40, 126]
    assert {answer.reply_length for answer in answers} == {firmware.reply_length}
    assert {answer.reply_id for answer in answers} == ({0} if firmware.reply_to_master else {1, 7, 40, 126})
    assert [answer.position for answer in answers] == pytest.approx([0.5, 1.0, 0.0, -0.2], abs=0.02)
    assert answers[0].temperature == (None if firmware.reply_length == 6 else 30)
    assert answers[0].error == (None if firmware.reply_length == 6 else 0)


def test_the_scan_sends_only_commands_without_gains_and_torque(address: Address) -> None:
    with responder(address, lambda message: []) as received, BusScan(address) as bus:
        bus.scan()
    assert {message.arbitration_id for message in received} == set(range(1, 127))
    assert {bytes(message.data) for message in received} == {NOTHING}
    assert NOTHING not in (ENTER, SET_ZERO)
    for spec in SPECS:
        command = unpack_command(spec, NOTHING)
        assert (command.kp, command.kd) == (0.0, 0.0)
        assert abs(command.torque) < 0.005


def test_no_motor_is_switched_on(address: Address) -> None:
    device = make_device()
    with device_on(address, device), BusScan(address) as bus:
        bus.scan(range(1, 6))
        bus.poll((1, 2, 3, 4))
    assert not device.powered


def test_a_motor_without_power_is_missing(address: Address) -> None:
    device = make_device()
    device.motors[2].unplugged = True
    with device_on(address, device), BusScan(address) as bus:
        assert [answer.can_id for answer in bus.scan(range(1, 6)).answers] == [1, 2, 4]
        assert set(bus.poll((1, 3))) == {1}


def test_two_motors_with_one_id_are_told(address: Address) -> None:
    other = make_device(ids=(4, 5, 6, 7))
    other.encoder_error = (1.0, 0.0, 0.0, 0.0)
    with device_on(address, make_device(), other), BusScan(address) as bus:
        answers, problems = bus.scan(range(1, 9))
    assert [answer.can_id for answer in answers] == [1, 2, 3, 4, 5, 6, 7]
    (problem,) = problems
    assert problem.startswith("ID 4: several replies to one command: two motors share it")
    assert "1.00 rad" in problem


@pytest.mark.parametrize(
    ("reply", "problem"),
    [
        (frame(3, bytes((3, 1, 2, 3, 4))), "ID 3: a reply of 5 bytes, must be 6 or 8"),
        (frame(3, bytes((9, 0x80, 0, 0x80, 8, 0))), "ID 3: the reply says that it is from motor 9"),
        (frame(77, bytes((3, 0x80, 0, 0x80, 8, 0))), "ID 3: a reply with ID 77, must be 3 or 0"),
    ],
)
def test_a_reply_that_fits_no_motor_is_told(address: Address, reply: can.Message, problem: str) -> None:
    with responder(address, lambda message: [reply] if message.arbitration_id == 3 else []), BusScan(address) as bus:
        assert bus.scan(range(1, 6)) == ((), (problem,))


def test_a_bus_that_a_bridge_holds_is_refused_with_its_holder(address: Address) -> None:
    lock = BusLock(address, "/right/can_bridge (PID 4711)")
    try:
        with pytest.raises(BusError, match=r"is held by /right/can_bridge \(PID 4711\)"):
            BusScan(address)
    finally:
        lock.release()


def test_the_bus_is_free_after_the_scan_and_after_a_refusal(address: Address) -> None:
    with responder(address, lambda message: []):
        for _ in range(2):
            BusScan(address).close()
    lock = BusLock(address, "a bridge")
    lock.notes.note(lock.notes.drive._replace(powered=True))
    lock.release()
    with pytest.raises(BusError, match="may have left the motors on: start can_bridge"):
        BusScan(address)
    BusLock(address, "a bridge").release()


@contextlib.contextmanager
def chatter(address: Address, message: can.Message) -> Iterator[None]:
    """Send `message` every 10 ms."""
    with can.Bus(interface=address[0], channel=address[1]) as bus:
        task = bus.send_periodic(message, 0.01)
        yield
        task.stop()


def test_a_bus_that_another_host_commands_is_refused(address: Address) -> None:
    with chatter(address, frame(2, NOTHING)), pytest.raises(BusError, match="a frame with ID 2 was heard"):
        BusScan(address)


def test_motors_of_both_formats_are_found_on_one_bus_and_the_v3_boards_are_sent_nothing(address: Address) -> None:
    device = make_device(Firmware(status_rate=100.0), formats=(MIT, MIT_V3, MIT, MIT_V3))
    device.encoder_error = (0.5, -0.2, 1.0, 0.3)
    with device_on(address, device), BusScan(address) as bus, responder(address, lambda message: []) as received:
        answers, problems = bus.scan(range(1, 7))
        polled = bus.poll((1, 2, 3, 4))
    assert problems == ()
    assert [(answer.can_id, answer.wire_format) for answer in answers] == [
        (1, "mit"), (2, "mit_v3"), (3, "mit"), (4, "mit_v3"),
    ]  # fmt: skip
    assert [answer.position for answer in answers] == pytest.approx([0.5, -0.2, 1.0, 0.3], abs=0.02)
    assert (answers[1].temperature, answers[1].error, answers[1].reply_id) == (30, 0, 0x2902)
    assert sorted(polled) == [1, 2, 3, 4]
    sent = {message.arbitration_id for message in received if bytes(message.data) == NOTHING}
    assert sent == {1, 3, 5, 6}
    assert not device.powered


def test_a_v3_board_that_falls_silent_is_missing(address: Address) -> None:
    device = make_device(Firmware(status_rate=100.0), formats=(MIT_V3,) * 4)
    with device_on(address, device), BusScan(address) as bus:
        device.motors[2].unplugged = True
        assert sorted(bus.poll((1, 2, 3, 4))) == [1, 2, 4]


def test_a_v3_board_with_an_id_that_no_parameter_can_have_is_told(address: Address) -> None:
    status = frame(0x29C8, bytes(8), is_extended_id=True)
    with chatter(address, status), BusScan(address) as bus:
        assert bus.scan(range(1, 4)).problems == ("ID 200: a V3 board; its ID must be from 1 to 126",)


def test_a_bus_on_which_another_host_commands_a_v3_board_is_refused(address: Address) -> None:
    command = frame(0x0803, bytes(8), is_extended_id=True)
    with chatter(address, command), pytest.raises(BusError, match="a frame with ID 2051 was heard"):
        BusScan(address)


def test_a_late_reply_is_not_taken_for_a_second_motor(address: Address) -> None:
    reply = frame(3, bytes((3, 0x80, 0, 0x80, 8, 0)))
    asked: list[can.Message] = []

    def late(message: can.Message) -> list[can.Message]:
        if message.arbitration_id != 3:
            return []
        asked.append(message)
        return [reply, reply] if len(asked) == 2 else []

    with responder(address, late), BusScan(address) as bus:
        answers, problems = bus.scan(range(1, 6))
    assert [answer.can_id for answer in answers] == [3]
    assert problems == ()
