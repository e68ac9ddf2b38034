"""Lets the arm down when the process that carries it dies or freezes: AK motors go on pushing as they were last told.

A process of its own: `python -m exo_gravity.hardware.watchdog`. It shares one page of memory with the watched one, in
which `MotorBus` notes each drive before its frames leave, and a pipe, which breaks when the watched process dies,
however it dies. Where the motors were on then, it takes over from the torques noted last. A process that is alive but
has noted nothing for `FROZEN` is killed first: two must never command one motor.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import mmap
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import can

from exo_gravity.core.errors import BusError
from exo_gravity.core.joint_motor import JointMotor
from exo_gravity.core.limits import Limits
from exo_gravity.core.safety import Drive, SafetyMachine
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.hardware.motor_bus import MotorBus, open_bus

FROZEN = 0.08  # s without a note, while this process is running
POLL = 0.01  # s
OPENING = 1.0  # s for which a bus that can't be opened is tried again
NOTE = struct.Struct("=7d")  # monotonic time, powered, damping, effort (4,)


class Charge(NamedTuple):
    """The arm to be let down: its bus, its motors, its limits, and the s of a cycle."""

    address: tuple[str, str, Mapping[str, Any]]
    motors: Sequence[JointMotor]
    limits: Limits
    period: float


class Watchdog:
    """The watched process's end; starts the other."""

    def __init__(self):
        memory = os.memfd_create("drive")
        os.ftruncate(memory, mmap.PAGESIZE)
        self._memory = mmap.mmap(memory, mmap.PAGESIZE)
        receiver, self._sender = Pipe(duplex=False)
        shared = (memory, receiver.fileno())
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, str(os.getpid()), *map(str, shared)],
            pass_fds=shared,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # a Ctrl-C or Ctrl-Z in the terminal is not for it
        )
        os.close(memory)
        receiver.close()

    @property
    def alive(self) -> bool:
        """Whether the other process is there."""
        return self._process.poll() is None

    def guard(self, charge: Charge) -> None:
        """Say what to let down."""
        self._sender.send(charge)

    def note(self, drive: Drive) -> None:
        """Note what the motors are about to get."""
        NOTE.pack_into(self._memory, 0, time.monotonic(), drive.powered, drive.damping, *drive.effort)


def _watch(watched: int, memory: mmap.mmap, receiver: Connection, tell: Callable[[str], None]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    charge: Charge | None = None
    why = "died"
    silence, looked, seen = 0.0, time.monotonic(), 0.0
    with contextlib.suppress(EOFError):
        while True:
            if receiver.poll(POLL):
                charge = receiver.recv()
                _load(charge.address[0])
            noted, powered, *_ = NOTE.unpack_from(memory)
            now = time.monotonic()
            # Where this process was not run either, the whole machine stood still, and the other one gets its chance.
            silence = silence + min(now - looked, 2 * POLL) if powered and noted == seen else 0.0
            looked, seen = now, noted
            if silence > FROZEN:
                why = f"did nothing for {FROZEN * 1000:.0f} ms, and was killed"
                os.kill(watched, signal.SIGKILL)  # from here on it does nothing any more, even if it takes long to die
                break
    _, powered, _, *effort = NOTE.unpack_from(memory)
    if charge and powered:
        tell(f"the process that carried the arm {why}: letting the arm down")
        let_down(charge, effort, tell)


def _load(interface: str) -> None:
    """Import what the bus needs while there is time."""
    with contextlib.suppress(KeyError, ImportError):
        importlib.import_module(can.interfaces.BACKENDS[interface][0])


def let_down(charge: Charge, effort: Sequence[float], tell: Callable[[str], None]) -> None:
    """Let down an arm whose motors are on with `effort` (4,) Nm and nobody commands any more."""
    end = time.monotonic() + OPENING
    while True:
        try:
            bus = open_bus(*charge.address)
            break
        except BusError as error:
            if time.monotonic() > end:
                return tell(str(error))
            time.sleep(POLL)
    machine = SafetyMachine(charge.limits, charge.period)
    machine.take_over(effort, time.monotonic())
    loop = ControlLoop(MotorBus(bus, charge.motors, powered=True), machine, charge.period, lambda now, joints: None)
    loop.start()
    loop.stop()
    return tell("the arm is down, its motors are off")


def main() -> None:
    """The other process: arguments are the watched one's ID, and the descriptors of memory and pipe."""
    logging.basicConfig(format="%(levelname)s %(message)s")
    watched, memory, receiver = map(int, sys.argv[1:])
    _watch(watched, mmap.mmap(memory, mmap.PAGESIZE), Connection(receiver, writable=False), logging.error)


if __name__ == "__main__":
    main()
