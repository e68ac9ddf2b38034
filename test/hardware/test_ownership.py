# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One owner per bus and host, and what becomes of the arm that a dead one left with its motors on; in virtual time."""

from __future__ import annotations

import itertools
import os
import re
import stat
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from exo_gravity.core.arm.gravity import NO_TORQUE, gravity_torque
from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT, ID_BITS, MotorCommand, WireFormat, unpack_command
from exo_gravity.core.safety.limits import MAX_EFFORT_RATE
from exo_gravity.hardware.can.can_port import Address
from exo_gravity.hardware.ownership import bus_lock, owned_bus
from exo_gravity.hardware.ownership.bus_lock import (
    ATTEMPT_TIME,
    UNKNOWN_DRIVE,
    ArmLock,
    ArmNotes,
    BusLock,
    bridge_of,
    bus_name,
    is_asked_for,
    notes_file,
)
from exo_gravity.hardware.ownership.owned_bus import OwnedBus, let_down, take_over
from exo_gravity.sim.virtual_time import VirtualBus, VirtualClock

from ..support.simulated_device import OFF, drive_of
from ..support.thorough import quick
from .rig import CYCLE, FIRST, LIMITS, MOTORS_OF_ARM, SAFE_SPEED, SECOND, ArmOnWires, OnWatch, TwoBusRig, VirtualRig
from .simulated_rig import PERIOD, NoWatchdog
from .wires import Responder, motor_bus

CHANNEL = f"can{os.getpid()}"  # other test runs share the network namespace
CAN0 = ("socketcan", CHANNEL, {})
DRIVE = drive_of((0.0, 3.0, 1.0, 0.5), (0.0, 5.0, 0.0, 0.0))
ENDED = "the last can_bridge on this bus and its watchdog ended with the motors on: letting the arm down"
OWNER = f"/right/can_bridge (PID {os.getpid()})"
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


def test_a_held_bus_is_refused_with_its_owner_whose_notes_stay_and_free_again_after_its_release():
    assert bridge_of(CAN0) == ""
    lock = lock_of(OWNER)
    lock.notes.note(DRIVE)
    with pytest.raises(BusError, match=f"^CAN bus {CHANNEL} is held by {re.escape(OWNER)}$"):
        lock_of("/left/can_bridge (PID 124)")
    assert (lock.notes.drive, lock.notes.owner, bridge_of(CAN0)) == (DRIVE, OWNER, OWNER)
    BusLock(("socketcan", f"{CHANNEL}x", {}), "another").release()
    lock.release()
    assert bridge_of(CAN0) == ""
    lock_of("another").release()


def test_a_process_of_another_user_and_container_is_refused_although_it_shares_no_folder(tmp_path):
    lock = lock_of(OWNER)
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
    owned = OwnedBus(rig.arm, OWNER, print, rig.clock)
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


NEXT: list[tuple[type[VirtualRig], WireFormat, bool]] = [
    (VirtualRig, MIT, True),
    (VirtualRig, MIT, False),
    (TwoBusRig, MIT, False),
    (TwoBusRig, MIT_V3, False),
]


@pytest.mark.parametrize(
    ("kind", "wire_format", "is_recovery"),
    quick(NEXT[:3], NEXT),
    ids=["recovery", "next owner", "two buses", "two buses, V3 boards"],
)
def test_the_arm_that_a_dead_owner_left_with_its_motors_on_is_let_down_first(kind, wire_format, is_recovery):
    rig, log = kind(wire_format=wire_format), []
    rig.leave_on()
    if is_recovery:
        take_over(rig.arm, "a recovery", log.append, clock=rig.clock).release()
    else:
        OwnedBus(rig.arm, "the next owner", log.append, rig.clock).close()
    assert log == [ENDED, "the arm is down, its motors are off"]
    rig.assert_let_down()
    assert [powered(part.address) for part in rig.arm.parts] == [False] * len(rig.arm.parts)


def powered(address: Address) -> bool:
    """Return whether the notes of a bus say that its motors may be on."""
    lock = BusLock(address, "a test")
    found = lock.notes.drive.powered
    lock.release()
    return found


def test_an_arm_whose_notes_cannot_be_read_is_let_down_gently_from_what_its_motors_reply():
    rig, log = VirtualRig(), []
    notes_file(rig.arm.address).mkdir()
    OwnedBus(rig.arm, "the next owner", log.append, rig.clock).close()
    assert log[0].startswith("it is not known what the motors apply, they may be on")
    rig.assert_let_down()


@pytest.mark.parametrize(
    ("kind", "lose", "unreached"),
    [
        (VirtualRig, lambda rig: setattr(rig.device, "bus_silent", True), [True] * 4),
        (TwoBusRig, lambda rig: setattr(rig.second, "refusal", BusError("no such device")), [False, False, True, True]),
    ],
    ids=["silent", "second bus cannot be opened"],
)
def test_a_watchdog_stays_with_what_the_next_owner_cannot_reach(monkeypatch, kind, lose, unreached):
    rig, stayed = kind(), []

    class Stays(NoWatchdog):
        def __init__(self, lock: ArmLock, *_: object) -> None:
            stayed.append([own.notes.drive.powered for own in lock.of_joints])

    monkeypatch.setattr(owned_bus, "Watchdog", Stays)
    rig.leave_on()
    lose(rig)
    with pytest.raises(BusError, match="a motor that may be powered does not reply"):
        OwnedBus(rig.arm, "the next owner", lambda text: None, rig.clock)
    assert stayed == [unreached] and rig.motors_on == unreached
    assert [powered(part.address) for part in rig.arm.parts] == sorted(set(unreached))


@pytest.mark.parametrize("held", [FIRST, SECOND], ids=["first", "second"])
def test_an_arm_of_which_one_bus_is_held_is_refused_and_holds_neither(held: str) -> None:
    rig = TwoBusRig(carried=False)
    lock = BusLock(("wire", held, {}), "/left/can_bridge (PID 1)", clock=rig.clock)
    with pytest.raises(BusError, match=rf"CAN bus {held} is held by /left/can_bridge \(PID 1\)"):
        ArmLock(rig.arm, "/right/can_bridge (PID 2)", 0.1, rig.clock)
    lock.release()
    for name in (FIRST, SECOND):
        BusLock(("wire", name, {}), "another", 0.0, rig.clock).release()


@pytest.mark.parametrize("order", [(FIRST, SECOND), (SECOND, FIRST)])
def test_the_locks_are_taken_in_one_order_however_the_motors_are_wired(
    order: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[str] = []

    class Noted(BusLock):
        def __init__(self, address: Address, *others: Any, **options: Any) -> None:
            taken.append(address[1])
            super().__init__(address, *others, **options)

    monkeypatch.setattr(bus_lock, "BusLock", Noted)
    rig, (first, second) = TwoBusRig(carried=False), order
    arm = ArmOnWires(("wire", f"{first},{second},{second},{first}", {}), rig.motors, LIMITS, CYCLE, rig.wires)
    ArmLock(arm, "a test", 0.1, rig.clock).release()
    assert taken == [FIRST, SECOND]


def test_an_end_that_was_opened_is_closed_if_the_other_bus_cannot_be() -> None:
    rig = TwoBusRig()
    rig.second.refusal = BusError("no such device")
    with pytest.raises(BusError, match="no such device"):
        rig.arm.ports(rig.clock)
    assert not any(isinstance(end, VirtualBus) for end in rig.first.ends)


# How the arm that a dead process left is let down.


def commands(listener: Responder, can_id: int) -> list[MotorCommand]:
    """Return the commands to motor `can_id` so far, without ENTER and EXIT."""
    frames = [bytes(message.data) for message in listener.received if message.arbitration_id == can_id]
    spec = MOTORS_OF_ARM[can_id - 1].spec
    return [unpack_command(spec, data) for data in frames if data[0] != can_id and data not in (ENTER, EXIT)]


def test_the_arm_is_lowered_from_the_noted_torques_and_its_motors_are_switched_off():
    rig = VirtualRig()
    rig.arm = replace(rig.arm, period=PERIOD)
    listener = Responder(rig.wire)
    assert rig.let_down()
    torques = [command.torque for command in commands(listener, 2)]
    assert torques[0] == pytest.approx(rig.carrying[1], abs=0.02)
    largest = max(abs(after - before) for before, after in itertools.pairwise(torques))
    assert largest <= MAX_EFFORT_RATE * PERIOD + 2 * MOTORS["AK80-9"].torque_range / 4095
    assert not rig.notes.drive.powered
    rig.assert_let_down()


def test_the_noted_damping_is_kept():
    rig = VirtualRig()
    listener = Responder(rig.wire)
    assert rig.let_down(drive_of(rig.carrying, (5.0,) * 4))
    assert min(command.kd for command in commands(listener, 2)[:50]) == pytest.approx(5.0, abs=0.01)


def test_a_motor_that_has_lost_its_power_is_not_pushed_by_the_noted_torque():
    """The operator cut the supply: the motors are off, and the arm hangs."""
    rig = VirtualRig(pose=NO_TORQUE, carried=False)
    assert rig.let_down(drive_of((0.0, 6.0, 2.0, 1.0)))
    assert rig.top_speed < 0.01
    assert rig.motors_on == [False] * 4


def lose_bus(rig: VirtualRig) -> None:
    rig.wire.refusal = BusError("no such device")
    rig.wire.break_down(OSError("no such device"))


def reach_again(rig: VirtualRig) -> None:
    rig.wire.refusal, rig.device.cut_off = None, (False,) * 4


SILENT = "a motor does not reply; it may still be powered; trying again"
LOSSES: list[tuple[Callable[[VirtualRig], None], float, float, str]] = [
    (lose_bus, 0.1, 14.0, SILENT),
    (lambda rig: setattr(rig.device, "cut_off", (False, True, False, False)), 0.0, 14.0, SILENT),
    (lose_bus, 0.0, 1.0, "no such device; the motors may still be powered"),
]


@pytest.mark.parametrize(
    ("lose", "after", "until", "said"),
    quick([LOSSES[0], LOSSES[2]], LOSSES),
    ids=["the adapter", "a motor", "the adapter, from the start"],
)
def test_an_arm_that_is_reached_again_late_is_let_down_and_the_log_is_honest(lose, after, until, said):
    rig, log = VirtualRig(), []
    start = rig.clock.monotonic()
    rig.clock.later(until, partial(reach_again, rig))
    rig.clock.later(after, partial(lose, rig)) if after else lose(rig)
    assert rig.let_down(log=log.append)
    assert log == [said]
    assert rig.clock.monotonic() > start + until
    rig.assert_let_down()


@pytest.mark.parametrize(("wire_format", "duration"), [(MIT, 10.0), (MIT_V3, 2.0)])
def test_the_watchdog_leaves_motors_off_whose_supply_returns(wire_format: WireFormat, duration: float) -> None:
    rig = VirtualRig(wire_format=wire_format)
    watches: list[OnWatch] = []

    def release() -> None:
        watches.append(OnWatch(rig))
        rig.switch_supply(True)

    rig.clock.later(0.5, lambda: rig.switch_supply(False))
    rig.clock.later(0.5 + duration, release)
    assert rig.let_down()
    assert watches and not watches[0].was_on


@pytest.mark.parametrize("wire_format", quick([MIT_V3], [MIT, MIT_V3]), ids=["mit", "mit_v3"])
def test_an_arm_on_two_buses_is_let_down_as_one(wire_format: WireFormat) -> None:
    """Motors 3 and 4 hold next to nothing here: they must still be braked while the first bus lowers joint 2."""
    rig = TwoBusRig(pose=(0.0, 1.3, 0.0, 0.3), carried=False, wire_format=wire_format)
    carrying = tuple(gravity_torque(rig.links, rig.device.arm.positions).tolist())
    assert max(map(abs, carrying[2:])) < 0.1 and carrying[1] > 3.0
    for motor, torque in zip(rig.motors, carrying, strict=True):
        for frame in ((motor.command_id, motor.command(torque, 0.0)), *motor.enter):
            rig.device.exchange(*frame)
    near, far = (rig.notes_of(drive_of(carrying)) for _ in range(2))
    damped: list[float] = []
    rig.clock.later(0.15, lambda: damped.extend(rig.damping))
    on: list[tuple[bool, bool]] = []
    rig.clock.every(0.1, lambda: on.append((any(rig.motors_on[:2]), any(rig.motors_on[2:]))))
    assert let_down(rig.arm, ArmNotes([near, near, far, far]), print, lambda: False)
    assert min(damped) > 1.0
    assert all(first == second for first, second in on)
    assert not near.drive.powered and not far.drive.powered
    assert rig.motors_on == [False] * 4 and rig.top_speed < SAFE_SPEED


UNREACHED = [
    (MIT, lambda wire: setattr(wire, "refusal", BusError("no such device")), "the motors may still be powered"),
    (MIT_V3, lambda wire: setattr(wire, "refusal", BusError("no such device")), "the motors may still be powered"),
    (MIT, lambda wire: setattr(wire, "loss", 1.0), "a motor does not reply"),
]


@pytest.mark.parametrize(
    ("wire_format", "lose", "said"),
    quick([UNREACHED[0], UNREACHED[2]], UNREACHED),
    ids=["cannot be opened", "cannot be opened, V3 boards", "silent"],
)
def test_a_bus_that_is_lost_is_handed_over_and_does_not_keep_the_other_waiting(wire_format, lose, said) -> None:
    rig, log = TwoBusRig(wire_format=wire_format), list[str]()
    near, far = rig.notes_of(), rig.notes_of()
    lose(rig.first)
    other = Responder(rig.first)
    assert not let_down(rig.arm, ArmNotes([near, near, far, far]), log.append, lambda: True)
    assert said in log[0]
    assert rig.motors_on == [True, True, False, False] and near.drive.powered
    assert far.drive.powered == (not rig.first.refusal)
    if not rig.first.refusal:
        return
    # Status frames of V3 boards alone.
    assert all((frame.arbitration_id & ID_BITS) >> 8 == 0x29 for frame in other.received)
    rig.clock.later(30.0, lambda: setattr(rig.first, "refusal", None))
    assert let_down(rig.arm, ArmNotes([near, near, far, far]), log.append, lambda: False)
    assert rig.motors_on == [False] * 4
