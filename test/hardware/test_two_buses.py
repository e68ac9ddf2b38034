# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm whose motors are on two buses: one safety unit, a lock and notes for each bus. In virtual time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import pytest

from exo_gravity.core.arm.gravity import gravity_torque
from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.frames import ID_BITS, WireFormat
from exo_gravity.core.motors.joint_motor import channels_of
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.core.safety.limits import DAMPING
from exo_gravity.core.safety.power import Power
from exo_gravity.hardware.can.can_port import Address, ArmOnBus, message_of
from exo_gravity.hardware.can.motor_bus import FOREIGN_COMMAND, MotorBus
from exo_gravity.hardware.ownership import bus_lock, owned_bus
from exo_gravity.hardware.ownership.bus_lock import ArmLock, ArmNotes, BusLock, notes_file
from exo_gravity.hardware.ownership.owned_bus import OwnedBus, let_down
from exo_gravity.sim.virtual_time import TICK, Played, VirtualBus, Wire

from ..support.simulated_device import drive_of
from ..support.thorough import quick
from .rig import CYCLE, LIMITS, SAFE_SPEED, ArmOnWires, CarriedArm, VirtualRig, raised_arm
from .test_watchdog_decisions import LET_DOWN
from .wires import Responder

FIRST, SECOND = f"first{os.getpid()}", f"second{os.getpid()}"
FORMATS = pytest.mark.parametrize("wire_format", quick([MIT], [MIT, MIT_V3]), ids=["mit", "mit_v3"])


class HalfPlayed(Played):
    """Some motors of a device whose others are played on another wire. strays: frames to those that came here."""

    def __init__(self, wire: Wire, rig: VirtualRig, joints: tuple[int, ...], other: HalfPlayed | None = None) -> None:
        self._joints, self._other = joints, other
        self.strays: list[can.Message] = []
        super().__init__(wire, rig.device, rig.note_speed, TICK)

    def deliver(self, message: can.Message) -> None:
        if (message.arbitration_id & 0xFF) - 1 in self._joints:
            super().deliver(message)
        else:
            self.strays.append(message)

    def catch_up(self) -> None:
        if self._other:
            self._other.catch_up()
        else:
            super().catch_up()

    def _report(self, joint: int) -> None:
        if joint in self._joints:
            super()._report(joint)


class TwoBusRig(VirtualRig):
    """Motors 1 and 2 are on the first bus, 3 and 4 on the second."""

    def connect(self) -> None:
        self.wires = {FIRST: self.wire, SECOND: Wire(self.clock)}
        self.first, self.second = self.wires.values()
        near = HalfPlayed(self.first, self, (0, 1))
        self.halves = near, HalfPlayed(self.second, self, (2, 3), near)
        address: Address = ("wire", f"{FIRST},{FIRST},{SECOND},{SECOND}", {})
        limits = replace(LIMITS, channels=channels_of(address[1], 4))
        self.arm = ArmOnWires(address, self.motors, limits, CYCLE, self.wires)

    @property
    def damping(self) -> list[float]:
        return [motor.damping for motor in self.device.motors]


def carried(wire_format: WireFormat = MIT) -> CarriedArm:
    return raised_arm(wire_format=wire_format, kind=TwoBusRig)


def halves(arm: CarriedArm) -> TwoBusRig:
    assert isinstance(arm.rig, TwoBusRig)
    return arm.rig


def silence(wire: Wire, silent: bool = True) -> None:
    wire.loss = float(silent)


@FORMATS
def test_an_arm_on_two_buses_is_carried_and_each_motor_is_commanded_on_its_own(wire_format: WireFormat) -> None:
    arm = carried(wire_format)
    before, counted = arm.loop.incomplete, arm.loop.cycles
    arm.run(1.0)
    assert arm.rig.is_raised and arm.loop.cycles > counted + 100
    assert arm.loop.incomplete == before
    assert not any(half.strays for half in halves(arm).halves)
    arm.safety.disable(arm.clock.monotonic())
    arm.assert_let_down()


def test_both_buses_are_sent_their_commands_before_the_replies_of_either_are_awaited() -> None:
    """The replies take 0.2 to 0.4 ms on each bus: awaited one after the other they take longer than together."""
    rig = TwoBusRig()
    bus = MotorBus(rig.arm.ports(rig.clock), rig.motors, clock=rig.clock)
    rig.first.batch = rig.second.batch = 0.003  # the adapters deliver both together
    for _ in range(20):
        start = rig.clock.monotonic()
        assert bus.exchange(rig.drive, start + 0.007)
        assert rig.clock.monotonic() - start < 0.005


@FORMATS
@pytest.mark.parametrize("dead", quick([SECOND], [FIRST, SECOND]), ids=["first", "second"])
def test_a_silent_bus_lets_the_whole_arm_down_and_its_motors_once_they_reply(
    wire_format: WireFormat, dead: str
) -> None:
    arm = carried(wire_format)
    rig = halves(arm)
    live = [0, 1] if dead == SECOND else [2, 3]
    silence(rig.wires[dead])
    arm.run(0.2)
    assert arm.safety.state is State.LETTING_DOWN and arm.safety.fault
    assert arm.safety.fault.code is FaultCode.MOTOR_SILENT
    assert f"no motor on {dead} replies: the bus is lost, or the supply is cut" in arm.safety.fault.reason
    assert all(rig.damping[joint] > 0.3 * DAMPING for joint in live)
    arm.run_until(lambda: arm.safety.is_unreached)
    assert not any(arm.safety.limits.is_silent(arm.clock.monotonic(), arm.loop.samples[joint]) for joint in live)
    assert not arm.loop.is_off
    silence(rig.wires[dead], False)
    arm.assert_let_down()


def test_a_bus_that_fails_does_not_keep_the_other_from_its_commands() -> None:
    arm = carried()
    rig = halves(arm)
    rig.second.refusal = BusError("no such device")
    rig.second.break_down(can.CanOperationError("No buffer space available"))
    arm.run(0.2)
    assert arm.safety.fault and arm.safety.fault.code is FaultCode.BUS_ERROR
    assert all(damping > 0.3 * DAMPING for damping in rig.damping[:2])
    assert rig.damping[2:] == [0.0, 0.0]
    rig.second.refusal = None  # it is plugged in again
    rig.second.broken = set()
    arm.assert_let_down()


def test_motors_on_a_bus_that_fails_while_they_are_switched_off_are_not_taken_for_off() -> None:
    arm = carried()
    rig = halves(arm)
    arm.safety.disable(arm.clock.monotonic())
    arm.run_until(lambda: arm.safety.power[2].state is Power.LEAVING)
    rig.second.refusal = BusError("no such device")
    rig.second.break_down(can.CanOperationError("Network is down"))
    arm.run(0.5)
    assert not arm.loop.is_off
    rig.second.refusal = None
    rig.second.broken = set()
    arm.run_until(lambda: arm.loop.is_off)
    assert rig.motors_on == [False] * 4


def test_motors_that_all_lost_their_supply_stay_off_and_those_of_one_bus_are_held_again() -> None:
    """A supply that is cut is seen by the silence of all motors, on both buses."""
    arm = carried()
    arm.rig.switch_supply(False)
    arm.run(1.0)
    assert arm.safety.fault and "no motor on" in arm.safety.fault.reason
    arm.rig.switch_supply(True)
    arm.run(3.0)
    assert arm.rig.motors_on == [False] * 4 and arm.loop.is_off


def test_a_command_to_a_motor_that_is_on_the_other_bus_is_no_foreign_command() -> None:
    rig = TwoBusRig()
    bus = MotorBus(rig.arm.ports(rig.clock), rig.motors, clock=rig.clock)
    command = message_of((3, rig.motors[2].command(1.0, 0.0)))
    rig.first.carry(None, command)
    bus.receive_until(rig.clock.monotonic() + CYCLE)
    assert bus.ignored == {"foreign frame": 1} and not bus.foreign_commands
    rig.second.carry(None, command)
    bus.receive_until(rig.clock.monotonic() + CYCLE)
    assert bus.ignored[FOREIGN_COMMAND] == bus.foreign_commands == 1


@pytest.mark.parametrize("wire_format", [MIT, MIT_V3], ids=["mit", "mit_v3"])
def test_the_watchdog_lets_the_arm_down_as_one(wire_format: WireFormat) -> None:
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


@FORMATS
def test_a_bus_that_cannot_be_opened_does_not_keep_the_other_waiting(
    wire_format: WireFormat, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = TwoBusRig(wire_format=wire_format)
    near, far = rig.notes_of(), rig.notes_of()
    rig.first.refusal = BusError("no such device")
    other = Responder(rig.first)
    assert not let_down(rig.arm, ArmNotes([near, near, far, far]), print, lambda: True)
    assert "no such device; the motors may still be powered" in capsys.readouterr().out
    assert rig.motors_on == [True, True, False, False]
    assert near.drive.powered and not far.drive.powered
    assert all((frame.arbitration_id & ID_BITS) >> 8 == 0x29 for frame in other.received)  # status of V3 boards alone
    rig.clock.later(30.0, lambda: setattr(rig.first, "refusal", None))
    assert let_down(rig.arm, ArmNotes([near, near, far, far]), print, lambda: False)
    assert rig.motors_on == [False] * 4


def test_a_silent_bus_is_handed_over(capsys: pytest.CaptureFixture[str]) -> None:
    rig = TwoBusRig()
    near, far = rig.notes_of(), rig.notes_of()
    silence(rig.second)
    assert not let_down(rig.arm, ArmNotes([near, near, far, far]), print, lambda: True)
    assert "a motor does not reply" in capsys.readouterr().out
    assert rig.damping[:2] < [0.3, 0.3] and rig.motors_on[2:] == [True, True]
    assert far.drive.powered


@pytest.fixture
def locks(lock_folder: Path) -> Iterator[None]:
    yield
    for name in (FIRST, SECOND):
        notes_file(("wire", name, {})).unlink(missing_ok=True)


@pytest.mark.usefixtures("locks")
@pytest.mark.parametrize("held", [FIRST, SECOND], ids=["first", "second"])
def test_an_arm_of_which_one_bus_is_held_is_refused_and_holds_neither(held: str) -> None:
    rig = TwoBusRig(carried=False)
    lock = BusLock(("wire", held, {}), "/left/can_bridge (PID 1)", clock=rig.clock)
    with pytest.raises(BusError, match=rf"CAN bus {held} is held by /left/can_bridge \(PID 1\)"):
        ArmLock(rig.arm, "/right/can_bridge (PID 2)", 0.1, rig.clock)
    lock.release()
    for name in (FIRST, SECOND):
        BusLock(("wire", name, {}), "another", 0.0, rig.clock).release()


@pytest.mark.usefixtures("locks")
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


@pytest.mark.usefixtures("locks")
@FORMATS
def test_the_next_bridge_lets_the_whole_arm_down_from_the_notes_of_both_buses(wire_format: WireFormat) -> None:
    rig, log = TwoBusRig(wire_format=wire_format), list[str]()
    rig.leave_on()
    owned = OwnedBus(rig.arm, "the next bridge", log.append, rig.clock)
    owned.close()
    assert log[-1] == LET_DOWN[1]
    rig.assert_let_down()


@pytest.mark.usefixtures("locks")
def test_an_arm_with_a_bus_that_cannot_be_opened_gets_a_watchdog_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, guarded = TwoBusRig(), list[tuple[bool, ...]]()
    rig.leave_on()
    rig.second.refusal = BusError("no such device")

    class Noted:
        def __init__(self, lock: ArmLock, arm: ArmOnBus) -> None:
            guarded.append(tuple(own.notes.drive.powered for own in lock.of_joints))

        def close(self) -> None:
            pass

    monkeypatch.setattr(owned_bus, "Watchdog", Noted)
    with pytest.raises(BusError, match="a motor that may be powered does not reply"):
        OwnedBus(rig.arm, "the next bridge", print, rig.clock)
    assert guarded == [(False, False, True, True)]
    assert rig.motors_on == [False, False, True, True]
    assert [BusLock(part.address, "a test").notes.drive.powered for part in rig.arm.parts] == [False, True]


def test_an_end_that_was_opened_is_closed_if_the_other_bus_cannot_be() -> None:
    rig = TwoBusRig()
    rig.second.refusal = BusError("no such device")
    with pytest.raises(BusError, match="no such device"):
        rig.arm.ports(rig.clock)
    assert not any(isinstance(end, VirtualBus) for end in rig.first.ends)
