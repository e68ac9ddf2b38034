# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The watchdog's process: after the bridge has died, its arm is let down, whatever else froze.

What it decides, and how it lets the arm down, is tested in virtual time: test_watchdog_decisions.py. What happens after
both have died: test_bus_lock.py in virtual time, nodes/test_stack.py with processes.
"""

from __future__ import annotations

import fcntl
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.hardware.ownership.bus_lock import ArmLock, BusLock, bridge_of
from exo_gravity.hardware.ownership.owned_bus import Watchdog

from ..support.waiting import PATIENCE, wait_until
from .simulated_rig import SimulatedRig

pytestmark = pytest.mark.real_time
REPO = Path(__file__).parents[2]


class Carrier:
    """A process that carries the arm of `rig` with a constant torque, and its watchdog."""

    def __init__(self, rig: SimulatedRig, folder: Path, stderr: int = subprocess.PIPE) -> None:
        path = folder / "arm.pickle"
        path.write_bytes(pickle.dumps((rig.arm, rig.carrying)))
        command = [sys.executable, "-m", "test.hardware.carrier", str(path)]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, cwd=REPO, stdin=pipe, stdout=pipe, stderr=stderr, text=True)
        self.watchdog = int(self.process.stdout.readline() or 0)

    def kill(self, number: int = signal.SIGKILL) -> None:
        self.process.send_signal(number)

    def log(self) -> str:
        """Return the log once carrier and watchdog have ended."""
        return self.process.stderr.read()

    def close(self) -> None:
        self.process.kill()
        if self.watchdog and is_running(self.watchdog):
            os.kill(self.watchdog, signal.SIGKILL)
        self.process.communicate()


def is_running(pid: int) -> bool:
    """Return whether the process runs; a zombie has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.fixture
def rig() -> Iterator[SimulatedRig]:
    rig = SimulatedRig(interface="udp_multicast", carried=True)
    yield rig
    rig.close()


@pytest.fixture
def carry(rig: SimulatedRig, tmp_path: Path) -> Iterator[Callable[..., Carrier]]:
    carriers: list[Carrier] = []

    def carry(**options: int) -> Carrier:
        carriers.append(Carrier(rig, tmp_path, **options))
        carrier = carriers[-1]
        if not (carrier.watchdog and all(rig.motors_on)):
            carrier.kill()
            pytest.fail(f"the arm is not carried: motors {rig.motors_on}, log: {carrier.log()}")
        return carriers[-1]

    yield carry
    for carrier in carriers:
        carrier.close()


def test_the_arm_of_a_bridge_that_is_killed_is_let_down_by_the_watchdog_which_holds_its_bus_meanwhile(rig, carry):
    carrier = carry()
    assert "/right/can_bridge" in bridge_of(rig.arm.address)
    carrier.kill()
    assert carrier.process.wait(PATIENCE) == -signal.SIGKILL
    assert bridge_of(rig.arm.address) == ""
    with pytest.raises(BusError, match=rf"held by the watchdog \(PID {carrier.watchdog}\) of /right/can_bridge"):
        BusLock(rig.arm.address, "another")
    assert carrier.log().endswith("letting the arm down\nERROR the arm is down, its motors are off\n")
    rig.assert_let_down()


@pytest.mark.thorough
def test_a_full_pipe_of_the_log_does_not_delay_the_watchdog(rig, carry):
    reader, writer = os.pipe()
    carrier = carry(stderr=writer)
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    os.write(writer, b"x" * 4096)
    carrier.kill()
    wait_until(lambda: not any(rig.motors_on))
    wait_until(lambda: not is_running(carrier.watchdog))
    os.close(reader)
    os.close(writer)
    rig.assert_let_down()


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
