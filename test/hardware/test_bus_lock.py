"""One owner per bus and host."""

import os
import tempfile

import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.safety.drive import OFF, Drive
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.ownership.bus_lock import ATTEMPT_TIME, BusLock, lock_file
from exo_gravity.hardware.ownership.owned_bus import OwnedBus, recover

from .simulated_rig import MOTORS_OF_ARM
from .virtual_rig import VirtualRig
from .virtual_time import Responder, VirtualClock

CAN0 = ("socketcan", "can0", {})
DRIVE = Drive((0.0, 3.0, 1.0, 0.5), (0.0, 5.0, 0.0, 0.0), True)
DIED = "the last can_bridge on this bus and its watchdog died while the motors were on: letting the arm down"

pytestmark = pytest.mark.usefixtures("lock_folder")


def lock_of(owner: str) -> BusLock:
    return BusLock(CAN0, owner, clock=VirtualClock())


def test_a_held_bus_is_refused_with_its_owner_and_free_again_after_its_release():
    lock = lock_of("/right/can_bridge (PID 123)")
    with pytest.raises(BusError, match=r"^CAN bus can0 is held by /right/can_bridge \(PID 123\)$"):
        lock_of("/left/can_bridge (PID 124)")
    BusLock(("socketcan", "can1", {}), "another").release()
    lock.release()
    lock_of("another").release()


def test_a_bus_that_its_owner_releases_a_little_later_is_waited_for():
    lock, clock = lock_of("first"), VirtualClock()
    clock.later(0.9 * ATTEMPT_TIME, lock.release)
    BusLock(CAN0, "second", clock=clock).release()


def test_a_refused_owner_leaves_the_notes_unchanged():
    lock = lock_of("first")
    lock.notes.note(DRIVE)
    with pytest.raises(BusError):
        lock_of("second")
    assert (lock.notes.drive, lock.notes.owner) == (DRIVE, "first")
    lock.release()


def test_the_notes_outlive_their_owner():
    lock = lock_of("first")
    assert lock.notes.drive == OFF
    lock.notes.note(DRIVE)
    lock.release()
    lock = lock_of("second")
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
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    assert lock_file(CAN0).parent == tmp_path / f"exo_gravity-{os.getuid()}"
    BusLock(CAN0, "a test").release()


def test_a_second_owner_sends_no_frame_and_the_first_keeps_carrying():
    rig = VirtualRig()
    owned = OwnedBus(rig.arm, "/right/can_bridge (PID 1)", print, rig.clock)
    bus = owned.open()
    bus.exchange(rig.drive, rig.clock.monotonic() + 1.0)
    rig.clock.sleep(0.01)  # until the last replies
    listener = Responder(rig.wire)
    with pytest.raises(BusError, match="held by /right/can_bridge"):
        OwnedBus(rig.arm, "/left/can_bridge (PID 2)", print, rig.clock)
    assert not listener.received
    assert rig.motors_on == [True] * 4
    bus.stop()
    owned.close()


def test_a_bus_that_another_host_commands_is_refused_without_a_frame():
    """Another host does not see the lock: its frames show it."""
    rig = VirtualRig(carried=False, pose=(0.0,) * 4)
    other = MotorBus(rig.wire.open(), MOTORS_OF_ARM, clock=rig.clock)
    rig.clock.every(0.02, lambda: other.exchange(OFF, rig.clock.monotonic()))
    owned = OwnedBus(rig.arm, "a test", print, rig.clock)
    with pytest.raises(BusError, match="is in use: another sender commands motor"):
        owned.open()
    assert other.foreign_commands == 0
    owned.close()


@pytest.mark.parametrize("is_recovery", [True, False], ids=["recovery", "next owner"])
def test_the_arm_that_a_dead_owner_left_with_its_motors_on_is_let_down_first(is_recovery):
    rig, log = VirtualRig(), []
    leave_on(rig)
    if is_recovery:
        assert recover(rig.arm, "a recovery", log.append, 1.0, rig.clock)
    else:
        OwnedBus(rig.arm, "the next owner", log.append, rig.clock).close()
    assert log == [DIED, "the arm is down, its motors are off"]
    rig.assert_let_down()
    lock = BusLock(rig.arm.address, "a test")
    assert not lock.notes.drive.powered
    lock.release()


def test_an_owner_is_refused_while_an_arm_left_with_its_motors_on_cannot_be_reached():
    rig = VirtualRig()
    leave_on(rig)
    rig.device.bus_silent = True
    with pytest.raises(BusError, match="a motor that may be powered does not reply"):
        OwnedBus(rig.arm, "the next owner", lambda text: None, rig.clock)
    lock = BusLock(rig.arm.address, "a test")
    assert lock.notes.drive.powered
    lock.release()


def leave_on(rig: VirtualRig) -> None:
    """Note that the arm of `rig` is carried, and release its bus."""
    lock = BusLock(rig.arm.address, "/right/can_bridge (PID 1)")
    lock.notes.note(rig.drive)
    lock.release()
