# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One owner per bus and host, and what becomes of the arm that a dead one left with its motors on; in virtual time."""

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
from pathlib import Path
from typing import Any

import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT, ID_BITS, MotorCommand, WireFormat, unpack_command
from exo_gravity.core.motors.joint_motor import Address
from exo_gravity.core.safety.limits import MAX_EFFORT_RATE
from exo_gravity.hardware import bus_lock, owned_bus
from exo_gravity.hardware.bus_lock import (
    ATTEMPT_TIME,
    UNKNOWN_COMMAND,
    ArmNotes,
    BusLock,
    bridge_of,
    bus_name,
    is_asked_for,
    notes_file,
)
from exo_gravity.hardware.owned_bus import ArmLock, OwnedBus, let_down, take_over
from exo_gravity.sim.rig import ACTS
from exo_gravity.sim.virtual_time import VirtualBus, VirtualClock

from ..support.copies import copied
from ..support.simulated_device import OFF, command_of
from ..support.thorough import quick
from .arms import (
    CYCLE,
    FIRST,
    MOTORS_OF_ARM,
    ON_TWO,
    SAFE_SPEED,
    SECOND,
    CarriedArm,
    NoWatchdog,
    Responder,
    cut,
    lose_bus,
    raised_usual_arm,
)
from .arms import raised_arm as raised

CHANNEL = f"can{os.getpid()}"  # other test runs share the network namespace
CAN0 = ("socketcan", CHANNEL, {})
NOTED = command_of((0.0, 3.0, 1.0, 0.5), (0.0, 5.0, 0.0, 0.0))._replace(is_unproven=True)
ENDED = "the last can_bridge on this bus and its watchdog ended with the motors on: letting the arm down"
OWNER = f"/right/can_bridge (PID {os.getpid()})"
# Prints why a process of another session, with other folders, may not have the bus.
OTHER_SESSION = """
import sys
from pathlib import Path
from exo_gravity.core.errors import BusError
from exo_gravity.hardware import bus_lock
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
    lock.notes.note(NOTED)
    with pytest.raises(BusError, match=f"^CAN bus {CHANNEL} is held by {re.escape(OWNER)}$"):
        lock_of("/left/can_bridge (PID 124)")
    assert (lock.notes.command, lock.notes.owner, bridge_of(CAN0)) == (NOTED, OWNER, OWNER)
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
    assert not lock.notes.command.powered and not lock.problem
    assert stat.S_IMODE(notes_file(CAN0).stat().st_mode) == 0o666  # the next owner may be another user
    lock.notes.note(NOTED)
    lock.release()
    lock = lock_of("second")
    assert lock.notes.command == NOTED
    lock.notes.note(OFF)
    lock.release()
    assert not list(lock_folder.iterdir())


OBSTACLES: dict[str, Callable[[Path, Path], object]] = {
    "link": lambda path, other: path.symlink_to(other),
    "second link": lambda path, other: path.hardlink_to(other),
    "folder": lambda path, other: path.mkdir(),
    "pipe": lambda path, other: os.mkfifo(path),
    "damage": lambda path, other: path.write_bytes(b"\xff" * 4096),
    # As of another version of the package: numbers, but no torques.
    "another layout": lambda path, other: path.write_bytes(struct.pack("=10d", *[1e9] * 10)),
    "no folder": lambda path, other: setattr(bus_lock, "FOLDERS", (path.parent / "none",)),
}


@pytest.mark.parametrize("obstacle", OBSTACLES)
def test_motors_whose_notes_cannot_be_trusted_may_be_on(obstacle, lock_folder):
    other = lock_folder / "another file"
    other.write_bytes(b"precious")
    OBSTACLES[obstacle](notes_file(CAN0), other)
    lock = lock_of("first")
    assert str(notes_file(CAN0)) in lock.problem
    assert lock.notes.command == UNKNOWN_COMMAND and lock.notes.command.powered
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


def leave_on(arm: CarriedArm) -> None:
    """Leave the notes of a bridge that died with its watchdog, on each bus; of other buses they know nothing."""
    effort = arm.notes.command.effort
    for part in arm.on_bus.parts:
        lock = BusLock(part.address, "a dead bridge")
        lock.notes.note(command_of([torque if joint in part.joints else 7.0 for joint, torque in enumerate(effort)]))
        lock.release()


def test_a_second_owner_sends_no_frame_and_the_first_keeps_carrying():
    arm = raised().leave()
    owned = OwnedBus(arm.on_bus, OWNER, print, arm.clock)
    bus = owned.open()
    bus.exchange(command_of(arm.notes.command.effort), arm.now + 1.0)
    arm.clock.sleep(0.01)  # until the last replies
    listener = Responder(arm.wire)
    with pytest.raises(BusError, match="held by /right/can_bridge"):
        OwnedBus(arm.on_bus, "/left/can_bridge (PID 2)", print, arm.clock)
    assert not listener.received and all(arm.motors_on)
    bus.stop()
    owned.close()


def test_a_bus_that_another_host_commands_is_refused_without_a_frame():
    """Another host does not see the lock: its frames show it."""
    arm = CarriedArm()
    arm.clock.every(0.02, lambda: arm.bus.exchange(OFF, arm.now))
    owned = OwnedBus(arm.on_bus, "a test", print, arm.clock)
    with pytest.raises(BusError, match="is in use: another sender commands motor"):
        owned.open()
    assert arm.bus.foreign_commands == 0
    owned.close()


def leave_no_notes(arm: CarriedArm) -> None:
    notes_file(arm.on_bus.address).mkdir()


NEXT = [
    (take_over, FIRST, MIT, leave_on),
    (OwnedBus, FIRST, MIT, leave_on),
    (OwnedBus, FIRST, MIT, leave_no_notes),
    (OwnedBus, ON_TWO, MIT, leave_on),
    (OwnedBus, ON_TWO, MIT_V3, leave_on),
]


@pytest.mark.parametrize(
    ("owner", "channel", "wire_format", "leave"),
    quick([NEXT[0], *NEXT[2:4]], NEXT),
    ids=["recovery", "next owner", "notes that cannot be read", "two buses", "two buses, V3 boards"],
)
def test_the_arm_that_a_dead_owner_left_with_its_motors_on_is_let_down_first(owner, channel, wire_format, leave):
    arm, log = raised(channel=channel, wire_format=wire_format).leave(), []
    leave(arm)
    next_owner = owner(arm.on_bus, "the next owner", log.append, clock=arm.clock)
    (next_owner.close if owner is OwnedBus else next_owner.release)()
    said = ENDED if leave is leave_on else "it is not known what the motors apply, they may be on"
    assert log[0].startswith(said) and log[1:] == ["the arm is down, its motors are off"]
    arm.assert_down()
    assert leave is leave_no_notes or not any(powered(part.address) for part in arm.on_bus.parts)


def powered(address: Address) -> bool:
    """Return whether the notes of a bus say that its motors may be on."""
    lock = BusLock(address, "a test")
    found = lock.notes.command.powered
    lock.release()
    return found


@pytest.mark.parametrize(
    ("channel", "lose", "unreached"),
    [
        (FIRST, lambda arm: setattr(arm.device, "bus_silent", True), [True] * 4),
        (ON_TWO, lambda arm: lose_bus(arm, SECOND), [False, False, True, True]),
    ],
    ids=["silent", "second bus cannot be opened"],
)
def test_a_watchdog_stays_with_what_the_next_owner_cannot_reach(monkeypatch, channel, lose, unreached):
    arm, stayed = raised(channel=channel).leave(), []

    class Stays(NoWatchdog):
        def __init__(self, lock: ArmLock, *_: object) -> None:
            stayed.append([own.notes.command.powered for own in lock.of_joints])

    monkeypatch.setattr(owned_bus, "Watchdog", Stays)
    leave_on(arm)
    lose(arm)
    with pytest.raises(BusError, match="a motor that may be powered does not reply"):
        OwnedBus(arm.on_bus, "the next owner", lambda text: None, arm.clock)
    assert stayed == [unreached] and arm.motors_on == unreached
    assert [powered(part.address) for part in arm.on_bus.parts] == sorted(set(unreached))


@pytest.mark.parametrize("held", [FIRST, SECOND], ids=["first", "second"])
def test_an_arm_of_which_one_bus_is_held_is_refused_and_holds_neither(held: str) -> None:
    arm = CarriedArm(channel=ON_TWO)
    lock = BusLock(("wire", held, {}), "/left/can_bridge (PID 1)", clock=arm.clock)
    with pytest.raises(BusError, match=rf"CAN bus {held} is held by /left/can_bridge \(PID 1\)"):
        ArmLock(arm.on_bus, "/right/can_bridge (PID 2)", 0.1, arm.clock)
    lock.release()
    for name in (FIRST, SECOND):
        BusLock(("wire", name, {}), "another", 0.0, arm.clock).release()


@pytest.mark.parametrize("order", [(FIRST, SECOND), (SECOND, FIRST)])
def test_the_locks_are_taken_in_one_order_however_the_motors_are_wired(
    order: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[str] = []

    def noted(address: Address, *others: Any, **options: Any) -> BusLock:
        taken.append(address[1])
        return BusLock(address, *others, **options)

    monkeypatch.setattr(owned_bus, "BusLock", noted)
    on_bus, (first, second) = CarriedArm(channel=ON_TWO).on_bus, order
    crossed = replace(on_bus, address=("wire", f"{first},{second},{second},{first}", {}))
    ArmLock(crossed, "a test", 0.1, VirtualClock()).release()
    assert taken == [FIRST, SECOND]


def test_an_end_that_was_opened_is_closed_if_the_other_bus_cannot_be() -> None:
    arm = CarriedArm(channel=ON_TWO).leave()
    lose_bus(arm, SECOND)
    with pytest.raises(BusError, match="no such device"):
        arm.on_bus.ports(arm.clock)
    assert not any(isinstance(end, VirtualBus) for end in arm.wire.ends)


# How the arm that a dead process left is let down.


def lowered(arm: CarriedArm, log: Callable[[str], None] = print, is_wanted: bool = False) -> bool:
    """Let down the arm that a dead process left with what it noted; return whether it is off."""
    return let_down(arm.on_bus, ArmNotes([arm.notes] * 4), log, lambda: is_wanted)


def commands(listener: Responder, can_id: int) -> list[MotorCommand]:
    """Return the commands to motor `can_id` so far, without ENTER and EXIT."""
    frames = [bytes(message.data) for message in listener.received if message.arbitration_id == can_id]
    spec = MOTORS_OF_ARM[can_id - 1].spec
    return [unpack_command(spec, data) for data in frames if data[0] != can_id and data not in (ENTER, EXIT)]


def test_the_arm_is_lowered_from_the_noted_torques_and_damping_and_its_motors_are_switched_off():
    arm = raised().leave()
    held, listener = arm.notes.command.effort, Responder(arm.wire)
    arm.notes.note(command_of(held, (5.0,) * 4))
    assert lowered(arm)
    sent = commands(listener, 2)
    assert sent[0].torque == pytest.approx(held[1], abs=0.1)  # the damping of half a code
    assert min(command.kd for command in sent[:50]) == pytest.approx(5.0, abs=0.01)
    largest = max(abs(after.torque - before.torque) for before, after in itertools.pairwise(sent))
    assert largest <= MAX_EFFORT_RATE * CYCLE + 2 * MOTORS["AK80-9"].torque_range / 4095
    assert not arm.notes.command.powered
    arm.assert_down()


def test_a_motor_that_has_lost_its_power_is_not_pushed_by_the_noted_torque():
    """The operator cut the supply: the motors are off, and the arm hangs."""
    arm = CarriedArm().leave()
    arm.notes.note(command_of((0.0, 6.0, 2.0, 1.0)))
    assert lowered(arm)
    assert arm.fastest < 0.01 and not arm.device.powered


def test_motors_whose_signs_were_not_proven_are_switched_off_without_damping_which_drives_a_reversed_one():
    arm = CarriedArm(has_wearer=False, mode="one_g")
    ACTS["torque_reversed"](arm, 1)
    arm.between_cycles(arm.safety.enable)
    assert arm.run_until(lambda: abs(arm.device.arm.velocities[1]) > 0.05)
    assert lowered(arm.leave())
    arm.assert_not_thrown()


def reach_again(arm: CarriedArm) -> None:
    arm.wire.refusal, arm.device.cut_off = None, (False,) * 4


SILENT = "a motor does not reply; it may still be powered; trying again"
LOSSES: list[tuple[Callable[[CarriedArm], None], float, float, str]] = [
    (lose_bus, 0.1, 14.0, SILENT),
    (partial(ACTS["cut_off"], motors=[1]), 0.0, 14.0, SILENT),
    (lose_bus, 0.0, 1.0, "no such device; the motors may still be powered"),
]


@pytest.mark.parametrize(
    ("lose", "after", "until", "said"),
    quick([LOSSES[0], LOSSES[2]], LOSSES),
    ids=["the adapter", "a motor", "the adapter, from the start"],
)
def test_an_arm_that_is_reached_again_late_is_let_down_and_the_log_is_honest(lose, after, until, said):
    arm, log = raised().leave(), []
    start = arm.now
    arm.clock.later(until, partial(reach_again, arm))
    arm.clock.later(after, partial(lose, arm)) if after else lose(arm)
    assert lowered(arm, log.append)
    assert log == [said] and arm.now > start + until
    arm.assert_down()


@pytest.mark.parametrize(("wire_format", "duration"), quick([(MIT_V3, 2.0)], [(MIT, 10.0), (MIT_V3, 2.0)]))
def test_the_watchdog_leaves_motors_off_whose_supply_returns(wire_format: WireFormat, duration: float) -> None:
    arm = raised(wire_format=wire_format).leave()
    arm.clock.later(0.5, partial(cut(duration), arm))
    arm.clock.later(0.5 + duration, arm.forget)
    assert lowered(arm)
    assert not arm.records["on"].any()


@pytest.mark.parametrize("wire_format", quick([MIT_V3], [MIT, MIT_V3]), ids=["mit", "mit_v3"])
def test_an_arm_on_two_buses_is_let_down_as_one(wire_format: WireFormat) -> None:
    """Motors 3 and 4 hold next to nothing here: they must still be braked while the first bus lowers joint 2."""
    worn: dict[str, Any] = {"has_wearer": False, "mode": "one_g", "channel": ON_TWO, "wire_format": wire_format}
    arm = raised_usual_arm((0.0, 1.3, 0.0, 0.3), **worn).leave()
    carrying = arm.notes.command.effort
    assert max(map(abs, carrying[2:])) < 0.1 and carrying[1] > 3.0
    near, far = copied(arm.notes), copied(arm.notes)
    near.clock = far.clock = arm.clock
    damped: list[float] = []
    arm.clock.later(0.15, lambda: damped.extend(motor.damping for motor in arm.motors))
    on: list[list[bool]] = []
    arm.clock.every(0.1, lambda: on.append(arm.motors_on))
    assert let_down(arm.on_bus, ArmNotes([near, near, far, far]), print, lambda: False)
    assert min(damped) > 1.0
    assert all(any(each[:2]) == any(each[2:]) for each in on)
    assert not near.command.powered and not far.command.powered and not arm.device.powered and arm.fastest < SAFE_SPEED


UNREACHED: list[tuple[WireFormat, Callable[[CarriedArm], None], str]] = [
    (MIT, lose_bus, "the motors may still be powered"),
    (MIT_V3, lose_bus, "the motors may still be powered"),
    (MIT, lambda arm: setattr(arm.wire, "loss", 1.0), "a motor does not reply"),
]


@pytest.mark.parametrize(
    ("wire_format", "lose", "said"),
    quick(UNREACHED[:1], UNREACHED),
    ids=["cannot be opened", "cannot be opened, V3 boards", "silent"],
)
def test_a_bus_that_is_lost_is_handed_over_and_does_not_keep_the_other_waiting(wire_format, lose, said) -> None:
    arm, log = raised(channel=ON_TWO, wire_format=wire_format).leave(), list[str]()
    near, far = copied(arm.notes), copied(arm.notes)
    near.clock = far.clock = arm.clock
    lose(arm)
    other = Responder(arm.wire)
    assert not let_down(arm.on_bus, ArmNotes([near, near, far, far]), log.append, lambda: True)
    assert said in log[0]
    assert arm.motors_on == [True, True, False, False] and near.command.powered
    assert far.command.powered == (not arm.wire.refusal)
    if not arm.wire.refusal:
        return
    # Status frames of V3 boards alone.
    assert all((frame.arbitration_id & ID_BITS) >> 8 == 0x29 for frame in other.received)
    arm.clock.later(15.0, partial(reach_again, arm))
    assert let_down(arm.on_bus, ArmNotes([near, near, far, far]), log.append, lambda: False)
    assert not arm.device.powered
