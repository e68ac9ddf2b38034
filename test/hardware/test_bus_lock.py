# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One owner per bus and host."""

import os
import re
import stat
import struct
import subprocess
import sys

import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.hardware.ownership import bus_lock, owned_bus
from exo_gravity.hardware.ownership.bus_lock import (
    ATTEMPT_TIME,
    UNKNOWN_DRIVE,
    BusLock,
    bridge_of,
    bus_name,
    is_asked_for,
    notes_file,
)
from exo_gravity.hardware.ownership.owned_bus import OwnedBus, take_over
from exo_gravity.sim.virtual_time import VirtualClock

from ..support.simulated_device import OFF, drive_of
from .rig import MOTORS_OF_ARM, VirtualRig
from .simulated_rig import NoWatchdog
from .wires import Responder, motor_bus

CHANNEL = f"can{os.getpid()}"  # other test runs share the network namespace
CAN0 = ("socketcan", CHANNEL, {})
DRIVE = drive_of((0.0, 3.0, 1.0, 0.5), (0.0, 5.0, 0.0, 0.0))
ENDED = "the last can_bridge on this bus and its watchdog ended with the motors on: letting the arm down"
FIRST = f"/right/can_bridge (PID {os.getpid()})"
# Prints why a process of another session, with other folders, may not have the bus.
OTHER_SESSION = """
import sys
from pathlib import Path
from exo_gravity.core.errors import BusError
from exo_gravity.hardware.ownership import bus_lock
bus_lock.FOLDERS = (Path(sys.argv[2]),)
try:
    bus_lock.BusLock(("socketcan", sys.argv[1], {}), "another", 0.0)
except BusError as error:
    print(error, end="")
"""

pytestmark = pytest.mark.usefixtures("lock_folder")


def lock_of(owner: str, **options: bool) -> BusLock:
    return BusLock(CAN0, owner, clock=VirtualClock(), **options)


def test_a_held_bus_is_refused_with_its_owner_and_free_again_after_its_release():
    lock = lock_of(FIRST)
    with pytest.raises(BusError, match=f"^CAN bus {CHANNEL} is held by {re.escape(FIRST)}$"):
        lock_of("/left/can_bridge (PID 124)")
    BusLock(("socketcan", f"{CHANNEL}x", {}), "another").release()
    lock.release()
    lock_of("another").release()


def test_a_process_of_another_user_and_container_is_refused_although_it_shares_no_folder(tmp_path):
    lock = lock_of(FIRST)
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "HOME": str(tmp_path), "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", OTHER_SESSION, CHANNEL, str(tmp_path / "none")]
    refused = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert refused.startswith(
        f"CAN bus {CHANNEL} is held by a process that left no notes here, as of another container"
    )
    lock.release()


def test_a_bus_that_its_owner_releases_a_little_later_is_waited_for():
    lock, clock = lock_of("first"), VirtualClock()
    clock.later(0.9 * ATTEMPT_TIME, lock.release)
    BusLock(CAN0, "second", clock=clock).release()


def test_the_bridge_that_holds_a_bus_is_named_to_who_does_not_want_it():
    assert bridge_of(CAN0) == ""
    lock = lock_of(FIRST)
    assert bridge_of(CAN0) == FIRST
    assert not is_asked_for(lock.socket)
    lock.release()
    assert bridge_of(CAN0) == ""


@pytest.mark.parametrize("asks", [False, True])
def test_a_bus_is_asked_for_only_while_someone_waits_for_it(asks):
    lock, clock, seen = lock_of("first"), VirtualClock(), []
    for delay in (0.5 * ATTEMPT_TIME, 1.5 * ATTEMPT_TIME):
        clock.later(delay, lambda: seen.append(is_asked_for(lock.socket)))
    with pytest.raises(BusError):
        BusLock(CAN0, "second", clock=clock, asks=asks)
    clock.sleep(ATTEMPT_TIME)
    assert seen == [asks, False]
    lock.release()


def test_a_refused_owner_leaves_the_notes_unchanged():
    lock = lock_of("first")
    lock.notes.note(DRIVE)
    with pytest.raises(BusError):
        lock_of("second")
    assert (lock.notes.drive, lock.notes.owner) == (DRIVE, "first")
    lock.release()


def test_the_notes_outlive_their_owner_unless_the_motors_are_off(lock_folder):
    lock = lock_of("first")
    assert not lock.notes.drive.powered and not lock.problem
    assert stat.S_IMODE(notes_file(CAN0).stat().st_mode) == 0o666  # the next owner may be another user
    lock.notes.note(DRIVE)
    lock.release()
    lock = lock_of("second")
    assert lock.notes.drive == DRIVE
    lock.notes.note(OFF)
    lock.release()
    assert not list(lock_folder.iterdir())


@pytest.mark.parametrize("obstacle", ["link", "second link", "folder", "pipe", "damage", "another layout", "no folder"])
def test_motors_whose_notes_cannot_be_trusted_may_be_on(obstacle, lock_folder, monkeypatch):
    path, other = notes_file(CAN0), lock_folder / "another file"
    other.write_bytes(b"precious")
    if obstacle == "link":
        path.symlink_to(other)
    elif obstacle == "second link":
        path.hardlink_to(other)
    elif obstacle == "folder":
        path.mkdir()
    elif obstacle == "pipe":
        os.mkfifo(path)
    elif obstacle == "damage":
        path.write_bytes(b"\xff" * 4096)
    elif obstacle == "another layout":  # as of another version of the package: numbers, but no torques
        path.write_bytes(struct.pack("=10d", *[1e9] * 10))
    else:
        monkeypatch.setattr(bus_lock, "FOLDERS", (lock_folder / "none",))
    lock = lock_of("first")
    assert str(notes_file(CAN0)) in lock.problem
    assert lock.notes.drive == UNKNOWN_DRIVE and lock.notes.drive.powered
    lock.release()
    assert other.read_bytes() == b"precious"


def test_each_bus_has_one_name_and_no_other_bus_has_it(tmp_path):
    addresses = [("udp_multicast", "239.74.163.2", {"port": port}) for port in (1, 2)]
    addresses += [CAN0, ("slcan", "/dev/ttyACM0", {}), ("slcan", "/dev/ttyACM1", {})]
    assert len(set(map(bus_name, addresses))) == len(addresses)
    link = tmp_path / "adapter"
    link.symlink_to("/dev/null")  # as udev's names of an adapter
    names = {bus_name(("slcan", channel, {})) for channel in ("/dev/null", f"{link}", f"{link}@115200")}
    assert names == {"device_1_3"}


def test_the_notes_are_in_the_first_folder_that_every_user_may_write_to(monkeypatch, tmp_path):
    folders = tuple(tmp_path / name for name in ("missing", "private", "shared"))
    for folder, mode in zip(folders[1:], (0o755, 0o1777), strict=True):
        folder.mkdir()
        folder.chmod(mode)
    monkeypatch.setattr(bus_lock, "FOLDERS", folders)
    assert notes_file(CAN0) == folders[2] / f"exo_gravity_socketcan_{CHANNEL}.bus"


def test_a_second_owner_sends_no_frame_and_the_first_keeps_carrying():
    rig = VirtualRig()
    owned = OwnedBus(rig.arm, FIRST, print, rig.clock)
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
    other = motor_bus(rig.wire, MOTORS_OF_ARM)
    rig.clock.every(0.02, lambda: other.exchange(OFF, rig.clock.monotonic()))
    owned = OwnedBus(rig.arm, "a test", print, rig.clock)
    with pytest.raises(BusError, match="is in use: another sender commands motor"):
        owned.open()
    assert other.foreign_commands == 0
    owned.close()


@pytest.mark.parametrize("is_recovery", [True, False], ids=["recovery", "next owner"])
def test_the_arm_that_a_dead_owner_left_with_its_motors_on_is_let_down_first(is_recovery):
    rig, log = VirtualRig(), []
    rig.leave_on()
    if is_recovery:
        take_over(rig.arm, "a recovery", log.append, clock=rig.clock).release()
    else:
        OwnedBus(rig.arm, "the next owner", log.append, rig.clock).close()
    assert log == [ENDED, "the arm is down, its motors are off"]
    rig.assert_let_down()
    lock = BusLock(rig.arm.address, "a test")
    assert not lock.notes.drive.powered
    lock.release()


def test_an_arm_whose_notes_cannot_be_read_is_let_down_gently_from_what_its_motors_reply():
    rig, log = VirtualRig(), []
    notes_file(rig.arm.address).mkdir()
    OwnedBus(rig.arm, "the next owner", log.append, rig.clock).close()
    assert log[0].startswith("it is not known what the motors apply, they may be on")
    rig.assert_let_down()


def test_a_watchdog_stays_with_an_arm_that_the_next_owner_cannot_reach(monkeypatch):
    rig, stayed = VirtualRig(), []

    class Stays(NoWatchdog):
        def __init__(self, lock: BusLock, *_: object) -> None:
            stayed.append(lock.notes.drive.powered)

    monkeypatch.setattr(owned_bus, "Watchdog", Stays)
    rig.leave_on()
    rig.device.bus_silent = True
    with pytest.raises(BusError, match="a motor that may be powered does not reply"):
        OwnedBus(rig.arm, "the next owner", lambda text: None, rig.clock)
    assert stayed == [True]
    lock = BusLock(rig.arm.address, "a test")
    assert lock.notes.drive.powered
    lock.release()
