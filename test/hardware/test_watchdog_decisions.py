# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the watchdog decides from notes and pipe, and what becomes of the arm; in virtual time, without a process."""

from __future__ import annotations

import mmap
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from exo_gravity.core.safety.limits import LOOP
from exo_gravity.hardware.ownership.bus_lock import ArmNotes, BusLock, DriveNotes
from exo_gravity.hardware.ownership.owned_bus import HEARTBEAT, OwnedBus, Silence
from exo_gravity.hardware.ownership.watchdog import SleepInhibitor, guard
from exo_gravity.sim.virtual_time import VirtualClock

from ..support.launched_nodes import children
from ..support.simulated_device import OFF
from .rig import CYCLE, VirtualRig
from .wires import Responder

LET_DOWN = ["letting the arm down", "the arm is down, its motors are off"]


class Pipe:
    """The watchdog's end of the pipe. messages: sent by the bridge, not yet received."""

    def __init__(self, clock: VirtualClock) -> None:
        self.messages: list[object] = []
        self.is_broken = False
        self._clock = clock

    def poll(self, timeout: float) -> bool:
        self._clock.run(timeout, self._is_ready)
        return self._is_ready()

    def recv(self) -> object:
        if not self.messages:
            raise EOFError
        return self.messages.pop(0)

    def _is_ready(self) -> bool:
        return bool(self.messages) or self.is_broken


class Bridge:
    """A bridge that carries the arm and notes it every cycle. killed: when, in s."""

    def __init__(self) -> None:
        self.rig = VirtualRig()
        self.clock = self.rig.clock
        self.notes = DriveNotes.from_buffer(mmap.mmap(-1, mmap.PAGESIZE))
        self.notes.clock = self.clock
        self.notes.owner = "/right/can_bridge (PID 1)"
        self.pipe = Pipe(self.clock)
        self.pipe.messages.append(self.rig.arm)
        self.killed: list[float] = []
        self.log: list[str] = []
        self.inhibited: list[bool] = []
        self.drive = self.rig.drive
        self.freeze = self.clock.every(CYCLE, lambda: self.notes.note(self.drive))
        self.listener = Responder(self.rig.wire)

    def kill(self) -> None:
        assert not self.listener.received  # two processes must never command one motor
        self.killed.append(self.clock.monotonic())
        self.freeze()

    def die(self) -> None:
        self.freeze()
        self.pipe.is_broken = True

    def at(self, delay: float, happens: Callable[[], None]) -> float:
        """Let something happen in `delay` s; return when."""
        self.clock.later(delay, happens)
        return self.clock.monotonic() + delay

    def guard(self, is_wanted: Callable[[], bool] = lambda: False) -> int:
        """Run the watchdog to its end; return its exit code."""
        inhibit = self.inhibited.append
        return guard(self.kill, ArmNotes([self.notes] * 4), self.pipe, self.log.append, is_wanted, inhibit)


@pytest.fixture
def bridge() -> Bridge:
    return Bridge()


def test_the_arm_of_a_bridge_that_has_died_is_let_down_under_the_watchdogs_name(bridge: Bridge) -> None:
    bridge.at(1.0, bridge.die)
    assert bridge.guard() == 0
    assert not bridge.killed
    assert bridge.log == [f"can_bridge has died: {LET_DOWN[0]}", LET_DOWN[1]]
    assert "of /right/can_bridge (PID 1); it is letting the arm down" in bridge.notes.owner
    assert not bridge.notes.drive.powered
    bridge.rig.assert_let_down()


def test_a_watchdog_whose_motors_are_silent_hands_the_bus_over_and_the_next_bridge_lets_the_arm_down(
    bridge: Bridge, lock_folder: Path
) -> None:
    """The lock is free once the watchdog's process has ended: test_bus_lock.py."""
    bridge.at(1.0, lambda: setattr(bridge.rig.device, "bus_silent", True))
    bridge.at(1.0, bridge.die)
    asked = bridge.clock.monotonic() + 20.0
    assert bridge.guard(lambda: bridge.clock.monotonic() > asked) == 1
    assert asked < bridge.clock.monotonic() < asked + 0.5
    assert bridge.notes.drive.powered
    lock = BusLock(bridge.rig.arm.address, "left behind")
    lock.notes.note(bridge.notes.drive)
    lock.release()
    bridge.clock.later(2.0, lambda: setattr(bridge.rig.device, "bus_silent", False))
    OwnedBus(bridge.rig.arm, "the next bridge", bridge.log.append, bridge.clock).close()
    assert bridge.log[-1] == LET_DOWN[1]
    bridge.rig.assert_let_down()


def test_a_descent_is_not_handed_over_while_the_motors_reply(bridge: Bridge) -> None:
    bridge.at(1.0, bridge.die)
    assert bridge.guard(lambda: True) == 0
    bridge.rig.assert_let_down()


def test_the_computer_is_not_suspended_while_the_motors_are_on(bridge: Bridge) -> None:
    bridge.drive = OFF
    bridge.at(1.0, lambda: setattr(bridge, "drive", bridge.rig.drive))
    seen: list[tuple[bool, bool]] = []
    bridge.clock.every(0.1, lambda: seen.append((bridge.drive.powered, bridge.inhibited[-1])))
    bridge.at(2.05, bridge.die)
    assert bridge.guard() == 0
    assert seen[0] == (False, False) and seen[15] == (True, True)


def test_the_inhibiting_program_runs_until_it_is_released() -> None:
    inhibitor, before = SleepInhibitor(("sh", "-c", "cat")), set(children(os.getpid()))
    inhibitor.hold(True)
    (program,) = set(children(os.getpid())) - before
    inhibitor.hold(True)
    assert set(children(os.getpid())) - before == {program}
    inhibitor.hold(False)
    assert os.waitpid(program, 0) == (program, 0)
    for command in ((), ("no_such_program",)):
        SleepInhibitor(command).hold(True)  # no error: the arm matters more


def test_a_frozen_bridge_is_killed_before_the_first_frame_and_its_arm_let_down(bridge: Bridge) -> None:
    when = bridge.at(1.0, bridge.freeze)
    assert bridge.guard() == 0
    assert when < bridge.killed[0] < when + LOOP.frozen + 0.02
    assert bridge.log[0] == f"can_bridge was frozen for 80 ms and has been killed: {LET_DOWN[0]}"
    bridge.rig.assert_let_down()


def test_a_bridge_that_hands_its_arm_over_is_killed_at_once(bridge: Bridge) -> None:
    when = bridge.at(1.0, lambda: bridge.pipe.messages.append("a test"))
    assert bridge.guard() == 0
    assert bridge.killed == [pytest.approx(when)]
    assert bridge.log[0] == f"can_bridge handed the arm over and has been killed (a test): {LET_DOWN[0]}"
    bridge.rig.assert_let_down()


@pytest.mark.parametrize("hands_over", [False, True])
def test_a_bridge_that_dies_before_it_is_killed_has_its_arm_let_down(bridge: Bridge, hands_over: bool) -> None:
    def find_none() -> None:
        bridge.die()
        raise ProcessLookupError

    bridge.kill = find_none
    bridge.at(1.0, lambda: bridge.pipe.messages.append("a test") if hands_over else bridge.freeze())
    assert bridge.guard() == 0
    assert bridge.log == [f"can_bridge has died: {LET_DOWN[0]}", LET_DOWN[1]]
    bridge.rig.assert_let_down()


@pytest.mark.parametrize("is_frozen", [False, True])
def test_nothing_is_sent_for_a_bridge_whose_motors_are_off(bridge: Bridge, is_frozen: bool) -> None:
    bridge.drive = OFF
    if is_frozen:
        bridge.at(0.5, bridge.freeze)
    bridge.at(1.0, bridge.die)
    assert bridge.guard() == 0
    assert not bridge.listener.received
    assert not bridge.log and not bridge.killed


def test_a_bridge_that_dies_before_its_arm_is_known_leaves_motors_that_may_be_powered(bridge: Bridge) -> None:
    bridge.pipe.messages.clear()
    bridge.at(0.5, bridge.die)
    assert bridge.guard() == 1
    assert bridge.log == ["can_bridge has died: its motors may still be powered"]
    assert bridge.notes.heartbeat == 0.0


def test_a_bridge_lives_on_after_the_whole_machine_has_stalled(bridge: Bridge) -> None:
    def stall() -> None:
        """Nothing runs for a while; then the watchdog runs first."""
        bridge.clock.stall(5.0 * LOOP.frozen)

    for delay in (0.5, 1.0):
        bridge.at(delay, stall)
    bridge.at(2.0, lambda: setattr(bridge, "drive", OFF))
    bridge.at(2.5, bridge.die)
    assert bridge.guard() == 0
    assert not bridge.killed
    assert bridge.notes.heartbeat > 100.0


def test_silence_is_the_time_in_which_the_observer_ran_since_the_last_new_sign() -> None:
    silence = Silence(10.0, HEARTBEAT.longest_look)
    assert silence.look(10.1, 1.0) == 0.0
    assert silence.look(10.2, 1.0) == pytest.approx(0.1)
    assert (
        silence.look(15.2, 1.0) == pytest.approx(0.1 + HEARTBEAT.longest_look)
        and 0.1 + HEARTBEAT.longest_look < HEARTBEAT.timeout
    )
    assert silence.look(15.3, 1.0) > HEARTBEAT.timeout
    assert silence.look(15.4, 2.0) == 0.0
    assert silence.look(15.5, 2.0, is_due=False) == 0.0
    assert silence.look(15.6, 2.0) == pytest.approx(0.1)
