# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The watchdog: what it decides from notes and pipe, in virtual time; and its process, in real time.

What happens after both have died: test_ownership.py in virtual time, nodes/test_stack.py with processes.
"""

import contextlib
import fcntl
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.bus_lock import ArmNotes, BusLock, bridge_of
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.hardware.owned_bus import ArmLock, OwnedBus, Watchdog
from exo_gravity.hardware.watchdog import SleepInhibitor, guard
from exo_gravity.sim.virtual_time import VirtualClock

from ..support.launched_nodes import children
from ..support.simulated_device import OFF, command_of
from ..support.waiting import PATIENCE, wait_until
from .arms import CYCLE, Responder, SimulatedRig
from .arms import raised_arm as raised

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
        self.arm = raised().leave()
        self.clock, self.notes = self.arm.clock, self.arm.notes
        self.notes.owner = "/right/can_bridge (PID 1)"
        self.pipe = Pipe(self.clock)
        self.pipe.messages.append(self.arm.on_bus)
        self.killed: list[float] = []
        self.log: list[str] = []
        self.inhibited: list[bool] = []
        self.command = command_of(self.notes.command.effort)
        self.alive = [True]
        self.freeze = self.alive.clear
        self.clock.every(CYCLE, lambda: self.alive and self.notes.note(self.command))
        self.listener = Responder(self.arm.wire)

    def kill(self) -> None:
        assert not self.listener.received  # two processes must never command one motor
        if self.pipe.is_broken:
            raise ProcessLookupError
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


def freezes_patiently(bridge: Bridge) -> float:
    limits = replace(bridge.arm.on_bus.limits, frozen_timeout=2.0)
    bridge.pipe.messages[:] = [replace(bridge.arm.on_bus, limits=limits)]
    began = bridge.at(1.0, bridge.freeze)
    bridge.at(2.9, lambda: bridge.killed and pytest.fail("1.9 s are no reason yet"))
    return began


def hand_over(bridge: Bridge, is_dead: bool = False) -> None:
    bridge.pipe.messages.append("a test")
    if is_dead:
        bridge.die()


# How a bridge ends, what the watchdog says, and within how many s it kills the bridge; None where it does not.
ENDINGS: dict[str, tuple[Callable[[Bridge], float], str, float | None]] = {
    "died": (lambda bridge: bridge.at(1.0, bridge.die), "has died", None),
    "frozen": (
        lambda bridge: bridge.at(1.0, bridge.freeze), "was frozen for 80 ms and has been killed",
        Limits.frozen_timeout + 0.02),
    "frozen, on a simulated bus with patience": (freezes_patiently, "was frozen for 2000 ms and has been killed", 2.1),
    "handed over": (
        lambda bridge: bridge.at(1.0, lambda: hand_over(bridge)),
        "handed the arm over and has been killed (a test)", 1e-6),
    "handed over, died before it is killed": (
        lambda bridge: bridge.at(1.0, lambda: hand_over(bridge, is_dead=True)), "has died", None),
}  # fmt: skip


# No descent whose motors reply is handed over to an owner who wants the bus.
@pytest.mark.parametrize(("ending", "is_wanted"), [*((name, False) for name in ENDINGS), ("died", True)])
def test_the_arm_of_a_bridge_that_has_ended_is_let_down_under_the_watchdogs_name(
    bridge: Bridge, ending: str, is_wanted: bool
) -> None:
    happens, said, within = ENDINGS[ending]
    when = happens(bridge)
    assert bridge.guard(lambda: is_wanted) == 0
    assert [0.0 <= time - when < (within or 0.0) for time in bridge.killed] == [True] * (within is not None)
    assert bridge.log == [f"can_bridge {said}: {LET_DOWN[0]}", LET_DOWN[1]]
    assert "of /right/can_bridge (PID 1); it is letting the arm down" in bridge.notes.owner
    assert not bridge.notes.command.powered
    bridge.arm.assert_down()


def test_a_watchdog_whose_motors_are_silent_hands_the_bus_over_and_the_next_bridge_lets_the_arm_down(
    bridge: Bridge, lock_folder: Path
) -> None:
    """The lock is free once the watchdog's process has ended: test_ownership.py."""
    bridge.at(1.0, lambda: setattr(bridge.arm.device, "bus_silent", True))
    bridge.at(1.0, bridge.die)
    asked = bridge.clock.monotonic() + 20.0
    assert bridge.guard(lambda: bridge.clock.monotonic() > asked) == 1
    assert asked < bridge.clock.monotonic() < asked + 0.5
    assert bridge.notes.command.powered
    lock = BusLock(bridge.arm.on_bus.address, "left behind")
    lock.notes.note(bridge.notes.command)
    lock.release()
    bridge.clock.later(2.0, lambda: setattr(bridge.arm.device, "bus_silent", False))
    OwnedBus(bridge.arm.on_bus, "the next bridge", bridge.log.append, bridge.clock).close()
    assert bridge.log[-1] == LET_DOWN[1]
    bridge.arm.assert_down()


def test_the_computer_is_not_suspended_while_the_motors_are_on(bridge: Bridge) -> None:
    on, bridge.command = bridge.command, OFF
    bridge.at(1.0, lambda: setattr(bridge, "command", on))
    seen: list[tuple[bool, bool]] = []
    bridge.clock.every(0.1, lambda: seen.append((bridge.command.powered, bridge.inhibited[-1])))
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


@pytest.mark.parametrize("is_frozen", [False, True])
def test_nothing_is_sent_for_a_bridge_whose_motors_are_off(bridge: Bridge, is_frozen: bool) -> None:
    bridge.command = OFF
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
        bridge.clock.stall(5.0 * Limits.frozen_timeout)

    for delay in (0.5, 1.0):
        bridge.at(delay, stall)
    bridge.at(2.0, lambda: setattr(bridge, "command", OFF))
    bridge.at(2.5, bridge.die)
    assert bridge.guard() == 0
    assert not bridge.killed
    assert bridge.notes.heartbeat > 0.0


# The process.

REPO = Path(__file__).parents[2]


@pytest.fixture
def rig() -> Iterator[SimulatedRig]:
    rig = SimulatedRig(raised().leave().device, "udp_multicast")
    yield rig
    rig.close()


@pytest.mark.real_time
@pytest.mark.parametrize("is_full", [False, pytest.param(True, marks=pytest.mark.thorough)], ids=["", "full log"])
def test_the_arm_of_a_bridge_that_is_killed_is_let_down_by_the_watchdog_which_holds_its_bus_meanwhile(
    rig: SimulatedRig, tmp_path: Path, is_full: bool
) -> None:
    reader, writer = os.pipe()
    (tmp_path / "arm").write_bytes(pickle.dumps((rig.arm, rig.carrying)))
    command = [sys.executable, "-m", "test.hardware.carrier", str(tmp_path / "arm")]
    with subprocess.Popen(command, cwd=REPO, stdout=subprocess.PIPE, stderr=writer, text=True) as process:
        watchdog = int(process.stdout.readline() or 0)
        is_carried = watchdog and all(rig.motors_on) and "/right/can_bridge" in bridge_of(rig.arm.address)
        if is_full:  # the log's pipe, which nobody reads
            fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
            os.write(writer, b"x" * 4096)
        process.kill()
    assert is_carried and process.returncode == -signal.SIGKILL
    try:
        with pytest.raises(BusError, match=rf"held by the watchdog \(PID {watchdog}\) of /right/can_bridge"):
            BusLock(rig.arm.address, "another")
        BusLock(rig.arm.address, "the next", PATIENCE).release()
        log = os.read(reader, 8192)
        assert is_full or log.endswith(b"letting the arm down\nERROR the arm is down, its motors are off\n")
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(watchdog, signal.SIGKILL)
    rig.assert_down()
    os.close(reader)
    os.close(writer)


@pytest.mark.real_time
def test_a_frozen_watchdog_is_noticed_and_recovers_and_ends_with_its_bridge(rig):
    lock = ArmLock(rig.arm, "a test", 0.0, COMPUTER_CLOCK)
    watchdog = Watchdog(lock, rig.arm)
    wait_until(lambda: lock.notes.heartbeat and watchdog.alive)
    os.kill(watchdog.process.pid, signal.SIGSTOP)
    wait_until(lambda: not watchdog.alive)
    os.kill(watchdog.process.pid, signal.SIGCONT)
    wait_until(lambda: watchdog.alive)
    watchdog.close()
    assert not watchdog.alive
    assert not watchdog.hand_over("a test")
    lock.release()


# What a process may ask of Linux's scheduler.

FAVOURED = """
import os
from exo_gravity.hardware.clock import raise_priority
raise_priority(15)
print(os.getpriority(os.PRIO_PROCESS, 0))
"""
AUTOGROUP = Path("/proc/self/autogroup")


def test_a_favoured_process_runs_before_other_sessions_processes_if_permitted():
    read = f"print(open({str(AUTOGROUP)!r}).read())" if AUTOGROUP.exists() else ""
    command = [sys.executable, "-c", FAVOURED + read]
    result = subprocess.run(command, start_new_session=True, capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (0, "")
    nice, *session = result.stdout.split("\n", 1)
    if os.geteuid():
        assert int(nice) <= 0
    else:
        assert int(nice) == -15
        assert not read or session[0].strip().endswith(" nice -15")
