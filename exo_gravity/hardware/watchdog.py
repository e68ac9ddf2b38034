"""Lets the arm down when the bridge process dies or freezes: AK motors keep applying the last commanded torque.

The watchdog is a separate process, `python -m exo_gravity.hardware.watchdog`. It shares one page of memory with the
bridge, in which `MotorBus` notes each drive before its frames are sent, and a pipe, which breaks when the bridge dies
for any reason. If the motors were on, the watchdog continues from the last noted torques. A bridge that is alive but
has noted nothing for `FROZEN` is killed first: two processes must never command one motor.
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

from exo_gravity.core.drive import Drive
from exo_gravity.core.errors import BusError
from exo_gravity.core.joint_motor import JointMotor
from exo_gravity.core.limits import Limits
from exo_gravity.core.safety import SafetyMachine
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.hardware.motor_bus import MotorBus, open_bus

FROZEN = 0.08  # s without a note, while the watchdog itself runs
POLL = 0.01  # s
OPEN_TIMEOUT = 1.0  # s for which opening the bus is retried
NOTE = struct.Struct("=7d")  # monotonic time, powered, damping, effort (4,)


class Charge(NamedTuple):
    """The arm to let down: its bus (interface, channel, options), motors, limits, and control period in s."""

    address: tuple[str, str, Mapping[str, Any]]
    motors: Sequence[JointMotor]
    limits: Limits
    period: float


class Watchdog:
    """The bridge's end: starts the watchdog process and keeps it informed."""

    def __init__(self) -> None:
        memory = os.memfd_create("drive")
        os.ftruncate(memory, mmap.PAGESIZE)
        self._memory = mmap.mmap(memory, mmap.PAGESIZE)
        receiver, self._sender = Pipe(duplex=False)
        shared = (memory, receiver.fileno())
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, str(os.getpid()), *map(str, shared)],
            pass_fds=shared,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # keeps Ctrl-C and Ctrl-Z in the terminal away from it
        )
        os.close(memory)
        receiver.close()

    @property
    def alive(self) -> bool:
        """Whether the watchdog process is running."""
        return self._process.poll() is None

    def guard(self, charge: Charge) -> None:
        """Set the arm to let down."""
        self._sender.send(charge)

    def note(self, drive: Drive) -> None:
        """Note the drive that the motors are about to receive."""
        NOTE.pack_into(self._memory, 0, time.monotonic(), drive.powered, drive.damping, *drive.effort)


def _watch(watched: int, memory: mmap.mmap, receiver: Connection, log: Callable[[str], None]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    charge: Charge | None = None
    why = "has died"
    silence, last_look, last_note = 0.0, time.monotonic(), 0.0
    with contextlib.suppress(EOFError):
        while True:
            if receiver.poll(POLL):
                charge = receiver.recv()
                _load(charge.address[0])
            noted, powered, *_ = NOTE.unpack_from(memory)
            now = time.monotonic()
            # If this process did not run either, the whole machine stalled, and the bridge gets another chance.
            silence = silence + min(now - last_look, 2 * POLL) if powered and noted == last_note else 0.0
            last_look, last_note = now, noted
            if silence > FROZEN:
                why = f"was frozen for {FROZEN * 1000:.0f} ms and has been killed"
                os.kill(watched, signal.SIGKILL)  # it sends nothing from here on, even if it takes long to die
                break
    _, powered, _, *effort = NOTE.unpack_from(memory)
    if charge and powered:
        log(f"can_bridge {why}: letting the arm down")
        let_down(charge, effort, log)


def _load(interface: str) -> None:
    """Import the bus's module ahead of time."""
    with contextlib.suppress(KeyError, ImportError):
        importlib.import_module(can.interfaces.BACKENDS[interface][0])


def let_down(charge: Charge, effort: Sequence[float], log: Callable[[str], None]) -> None:
    """Let down an arm whose motors are on with `effort` (4,) Nm after its bridge has died."""
    end = time.monotonic() + OPEN_TIMEOUT
    while True:
        try:
            bus = open_bus(*charge.address)
            break
        except BusError as error:
            if time.monotonic() > end:
                return log(str(error))
            time.sleep(POLL)
    machine = SafetyMachine(charge.limits, charge.period)
    machine.take_over(effort, time.monotonic())
    loop = ControlLoop(MotorBus(bus, charge.motors, powered=True), machine, charge.period, lambda now, joints: None)
    loop.start()
    loop.stop()
    return log("the arm is down, its motors are off")


def main() -> None:
    """Entry point of the watchdog process; arguments: the bridge's PID, and the descriptors of memory and pipe."""
    logging.basicConfig(format="%(levelname)s %(message)s")
    watched, memory, receiver = map(int, sys.argv[1:])
    _watch(watched, mmap.mmap(memory, mmap.PAGESIZE), Connection(receiver, writable=False), logging.error)


if __name__ == "__main__":
    main()
