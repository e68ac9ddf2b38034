"""The watchdog process: lets the arm down when its bridge dies, freezes or hands it over.

If the motors were on, it continues from the last noted drive. A bridge that is alive but has noted nothing for `FROZEN`
is killed first: two processes must never command one motor. It acts first and logs afterwards, on a thread: the pipe of
its log may be full, because its reader is frozen.

Exit code 0: the motors were off, or have confirmed that they are. 1: they may still be powered.
"""

from __future__ import annotations

import contextlib
import importlib
import mmap
import os
import signal
import sys
import threading
import time
from multiprocessing.connection import Connection
from queue import SimpleQueue

import can

from exo_gravity.core.safety.params import FROZEN
from exo_gravity.hardware.ownership.drive_notes import DriveNotes
from exo_gravity.hardware.ownership.handover import Charge, let_down

POLL = 0.01  # s
LOG_TIME = 1.0  # s for the last lines of the log


class Log:
    """Writes lines to the standard error output without ever blocking the caller."""

    def __init__(self) -> None:
        self._lines: SimpleQueue[str | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()

    def write(self, text: str) -> None:
        """Log one line."""
        self._lines.put(f"ERROR {text}\n")

    def close(self) -> None:
        """Wait for the last lines, but not for a reader that is frozen."""
        self._lines.put(None)
        self._thread.join(LOG_TIME)

    def _write(self) -> None:
        with contextlib.suppress(OSError):
            while (line := self._lines.get()) is not None:
                os.write(2, line.encode())


def watch(bridge: int, notes: DriveNotes, receiver: Connection) -> tuple[Charge | None, str]:
    """Watch the process `bridge` until it has ended; return the arm that it had, and why it ended."""
    charge: Charge | None = None
    silence, last_look, last_note = 0.0, time.monotonic(), 0.0
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            if receiver.poll(POLL):
                message = receiver.recv()
                if isinstance(message, str):
                    os.kill(bridge, signal.SIGKILL)
                    return charge, f"handed the arm over and has been killed ({message})"
                charge = message
                _load(message.address[0])
            drive, noted, now = notes.drive, notes.time, time.monotonic()
            if charge:
                notes.beat(now)
            # If this process did not run either, the whole machine stalled, and the bridge gets another chance.
            silence = silence + min(now - last_look, 2 * POLL) if drive.powered and noted == last_note else 0.0
            last_look, last_note = now, noted
            if silence > FROZEN:
                os.kill(bridge, signal.SIGKILL)  # it sends nothing from here on, even if it takes long to die
                return charge, f"was frozen for {FROZEN * 1000:.0f} ms and has been killed"
    return charge, "has died"


def _load(interface: str) -> None:
    """Import the bus's module ahead of time."""
    with contextlib.suppress(KeyError, ImportError):
        importlib.import_module(can.interfaces.BACKENDS[interface][0])


def run(bridge: int, notes: DriveNotes, receiver: Connection, log: Log) -> int:
    """Watch the process `bridge`, let its arm down if necessary, and return the exit code."""
    charge, why = watch(bridge, notes, receiver)
    drive = notes.drive
    if not drive.powered:
        return 0
    if charge is None:
        log.write(f"can_bridge {why}: its motors may still be powered")
        return 1
    notes.owner = f"the watchdog (PID {os.getpid()}) of {notes.owner}; it is letting the arm down, wait until it ends"
    log.write(f"can_bridge {why}: letting the arm down")
    if let_down(charge, drive, notes.note, log.write):
        log.write("the arm is down, its motors are off")
        return 0
    log.write("the motors may still be powered: cut their supply")
    return 1


def main() -> None:
    """Entry point; arguments: the bridge's PID, and the descriptors of lock file and pipe."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    bridge, lock, receiver = map(int, sys.argv[1:])
    log = Log()
    code = run(bridge, DriveNotes(mmap.mmap(lock, mmap.PAGESIZE)), Connection(receiver, writable=False), log)
    log.close()
    os._exit(code)  # the log's thread may be blocked


if __name__ == "__main__":
    main()
