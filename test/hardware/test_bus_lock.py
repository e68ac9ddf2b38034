"""One owner per bus and host."""

import os
import threading
import time

import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.safety.drive import OFF, Drive
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.ownership import bus_lock
from exo_gravity.hardware.ownership.bus_lock import BusLock, lock_file
from exo_gravity.hardware.ownership.owned_bus import OwnedBus

from .simulated_rig import MOTORS_OF_ARM

CAN0 = ("socketcan", "can0", {})
DRIVE = Drive((0.0, 3.0, 1.0, 0.5), (0.0, 5.0, 0.0, 0.0), True)


@pytest.fixture(autouse=True)
def _only_here(lock_folder, monkeypatch):
    monkeypatch.setattr(bus_lock, "ATTEMPT_TIME", 0.1)


def test_a_held_bus_is_refused_with_its_owner_and_free_again_after_its_release():
    lock = BusLock(CAN0, "/right/can_bridge (PID 123)")
    with pytest.raises(BusError, match=r"^CAN bus can0 is held by /right/can_bridge \(PID 123\)$"):
        BusLock(CAN0, "/left/can_bridge (PID 124)")
    BusLock(("socketcan", "can1", {}), "another").release()
    lock.release()
    BusLock(CAN0, "another").release()


def test_a_refused_owner_leaves_the_notes_unchanged():
    lock = BusLock(CAN0, "first")
    lock.notes.note(DRIVE)
    with pytest.raises(BusError):
        BusLock(CAN0, "second")
    assert (lock.notes.drive, lock.notes.owner) == (DRIVE, "first")
    lock.release()


def test_the_notes_outlive_their_owner():
    lock = BusLock(CAN0, "first")
    assert lock.notes.drive == OFF
    lock.notes.note(DRIVE)
    lock.release()
    lock = BusLock(CAN0, "second")
    assert lock.notes.drive == DRIVE
    lock.release()


def test_buses_on_two_ports_or_channels_have_two_locks():
    addresses = [("udp_multicast", "239.74.163.2", {"port": port}) for port in (1, 2)]
    addresses += [CAN0, ("slcan", "/dev/ttyACM0", {}), ("slcan", "/dev/ttyACM1", {})]
    assert len({lock_file(address) for address in addresses}) == len(addresses)
    assert lock_file(addresses[-1]).name == "slcan__dev_ttyACM1.bus"


def test_without_a_runtime_folder_the_lock_is_in_a_folder_of_this_user(monkeypatch, tmp_path):
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr(os, "access", lambda folder, mode: False)
    monkeypatch.setattr(bus_lock.tempfile, "gettempdir", lambda: str(tmp_path))
    assert lock_file(CAN0).parent == tmp_path / f"exo_gravity-{os.getuid()}"
    BusLock(CAN0, "a test").release()


def test_a_second_owner_sends_no_frame_and_the_first_keeps_carrying(make_rig):
    rig = make_rig()
    owned = OwnedBus(rig.arm, "/right/can_bridge (PID 1)", print)
    bus = owned.open()
    bus.exchange(Drive(rig.carrying, (0.0,) * 4, True), time.monotonic() + 1.0)
    with rig.open() as listener:
        with pytest.raises(BusError, match="held by /right/can_bridge"):
            OwnedBus(rig.arm, "/left/can_bridge (PID 2)", print)
        commands = [m for m in iter(lambda: listener.recv(0.0), None) if m.data[0] != m.arbitration_id]
        assert commands == []
    assert rig.motors_on == [True] * 4
    bus.stop()
    owned.close()


def test_a_bus_that_another_host_commands_is_refused_without_a_frame(make_rig):
    """Another host does not see the lock: its frames show it."""
    rig = make_rig()
    other, stop = MotorBus(rig.open(), MOTORS_OF_ARM), threading.Event()

    def command():
        while not stop.wait(0.02):
            other.exchange(OFF, time.monotonic() + 0.01)

    thread = threading.Thread(target=command)
    thread.start()
    owned = OwnedBus(rig.arm, "a test", print)
    try:
        with pytest.raises(BusError, match="is in use: another sender commands motor"):
            owned.open()
        assert other.foreign_commands == 0
    finally:
        stop.set()
        thread.join()
        owned.close()
        other.close()
