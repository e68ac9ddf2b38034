"""The watchdog: after the bridge has died, its arm is let down, whatever else died or froze."""

from __future__ import annotations

import fcntl
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.hardware.ownership.bus_lock import BusLock
from exo_gravity.hardware.ownership.owned_bus import OwnedBus
from exo_gravity.hardware.ownership.watchdog import Watchdog

from .simulated_rig import SimulatedRig, wait_until

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

    def order(self, text: str) -> None:
        self.process.stdin.write(f"{text}\n")
        self.process.stdin.flush()

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
def rig(make_rig: Callable[..., SimulatedRig]) -> SimulatedRig:
    return make_rig(interface="udp_multicast", carried=True)


@pytest.fixture
def carry(rig: SimulatedRig, tmp_path: Path) -> Iterator[Callable[..., Carrier]]:
    carriers: list[Carrier] = []

    def carry(**options: int) -> Carrier:
        carriers.append(Carrier(rig, tmp_path, **options))
        assert carriers[-1].watchdog, carriers[-1].log()
        assert rig.motors_on == [True] * 4
        return carriers[-1]

    yield carry
    for carrier in carriers:
        carrier.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_the_arm_of_a_killed_or_frozen_bridge_is_let_down(rig, carry, number):
    carrier = carry()
    carrier.kill(number)
    assert carrier.process.wait(5) == -signal.SIGKILL
    assert carrier.log().endswith("letting the arm down\nERROR the arm is down, its motors are off\n")
    rig.assert_let_down()


def test_a_bridge_can_hand_its_arm_over(rig, carry):
    carrier = carry()
    carrier.order("hand over")
    assert carrier.process.wait(5) == -signal.SIGKILL
    assert "handed the arm over and has been killed (a test)" in carrier.log()
    rig.assert_let_down()


def test_the_watchdog_of_a_killed_bridge_with_its_motors_off_ends_and_sends_nothing(rig, carry):
    carrier = carry()
    carrier.order("off")
    wait_until(lambda: not any(rig.motors_on))
    time.sleep(0.1)  # until the motors have confirmed it
    carrier.kill()
    assert carrier.log() == ""
    wait_until(lambda: not is_running(carrier.watchdog))


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


def test_a_bus_whose_arm_is_being_let_down_is_held_by_the_watchdog(rig, carry):
    carrier = carry()
    carrier.kill()
    with pytest.raises(BusError, match=rf"held by the watchdog \(PID {carrier.watchdog}\) of /right/can_bridge"):
        BusLock(rig.arm.address, "another")
    wait_until(lambda: not is_running(carrier.watchdog))
    rig.assert_let_down()


def test_after_bridge_and_watchdog_were_killed_the_next_owner_lets_the_arm_down_first(rig, carry):
    carrier = carry()
    os.kill(carrier.watchdog, signal.SIGSTOP)
    carrier.kill()
    os.kill(carrier.watchdog, signal.SIGKILL)
    carrier.process.wait(5)
    wait_until(lambda: not is_running(carrier.watchdog))
    assert rig.motors_on == [True] * 4
    log: list[str] = []
    owned = OwnedBus(rig.arm, "the next owner", log.append)
    owned.close()
    assert log[-1] == "the arm is down, its motors are off"
    rig.assert_let_down()


def test_a_bridge_lives_on_after_the_whole_machine_has_stalled(carry):
    carrier = carry()
    for number in (signal.SIGSTOP, signal.SIGCONT):
        for pid in (carrier.process.pid, carrier.watchdog):
            os.kill(pid, number)
        time.sleep(0.3)  # several times FROZEN, both stopped and running
    assert carrier.process.poll() is None


def test_a_frozen_watchdog_is_noticed_and_recovers(rig):
    lock = BusLock(rig.arm.address, "a test")
    watchdog = Watchdog(lock, rig.arm, COMPUTER_CLOCK)

    def is_alive_after(seconds: float) -> bool:
        end = time.monotonic() + seconds
        while time.monotonic() < end and watchdog.alive:
            time.sleep(0.05)
        return watchdog.alive

    wait_until(lambda: lock.notes.heartbeat)
    assert is_alive_after(0.5)
    os.kill(watchdog.pid, signal.SIGSTOP)
    assert not is_alive_after(0.5)
    os.kill(watchdog.pid, signal.SIGCONT)
    wait_until(lambda: watchdog.alive)
    watchdog.close()
    assert not watchdog.alive
    lock.release()
