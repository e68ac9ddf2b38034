# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The watchdog: a process that lets the arm down when its bridge dies, freezes or hands it over.

It shares the notes of each bus with the bridge, and a pipe, which breaks when the bridge dies for any reason. It
inherits the lock of each bus. If the motors were on, it continues from the last noted command; motors whose signs were
not proven yet are switched off, because damping could drive them. A bridge that is alive but has noted nothing for
`frozen_timeout` is killed first: two processes must never command one motor. Once a motor has not replied for seconds
and all others are down, the next bridge may ask for the bus: then the watchdog ends, and its notes stay.

While the motors are on it keeps the computer from being suspended: that would freeze both processes.

The process acts first and logs afterwards, on a thread: the pipe of its log may be full, because its reader is frozen.
Its exit code is 0 if the motors were off, or have confirmed that they are; 1 if they may still be powered.
"""

import contextlib
import importlib
import mmap
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from queue import SimpleQueue

import can

from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.bus_lock import ArmNotes, CommandNotes, is_asked_for, remove_notes
from exo_gravity.hardware.can_port import ArmOnBus
from exo_gravity.hardware.clock import raise_priority
from exo_gravity.hardware.owned_bus import Silence, let_down

POLL = 0.01  # s
LOG_TIME = 1.0  # s for the last lines of the log
SYSTEM_BUS = "/run/dbus/system_bus_socket"  # over which logind is reached, where it runs
# Holds logind's lock while its child runs: `cat`, which ends with this process, the other end of its standard input.
INHIBIT = ("systemd-inhibit", "--what=sleep:handle-lid-switch", "--who=exo_gravity", "--why=an arm is carried", "cat")


def guard(
    kill: Callable[[], None],
    notes: ArmNotes,
    receiver: Connection,
    log: Callable[[str], None],
    is_wanted: Callable[[], bool],
    inhibit: Callable[[bool], None],
) -> int:
    """Watch the bridge until it has ended, let its arm down if necessary, and return the exit code.

    kill: kills the bridge.
    receiver: the watchdog's end of the pipe.
    is_wanted: whether the next bridge waits for the bus.
    inhibit: called often with whether the computer must not be suspended.
    """
    arm: ArmOnBus | None = None
    clock, patience = notes.clock, Limits.frozen_timeout
    why, silence = "has died", Silence(clock.monotonic(), 2 * POLL)
    with contextlib.suppress(EOFError, ConnectionError, ProcessLookupError):  # of `kill`: it has died meanwhile
        while True:
            if receiver.poll(POLL):
                message = receiver.recv()
                if isinstance(message, str):
                    kill()
                    why = f"handed the arm over and has been killed ({message})"
                    break
                arm, patience = message, message.limits.frozen_timeout
                with contextlib.suppress(KeyError, ImportError):  # imports the bus's module ahead of time
                    importlib.import_module(can.interfaces.BACKENDS[message.address[0]][0])
            is_powered, noted, now = notes.command.powered, notes.time, clock.monotonic()
            if arm:
                for page in notes.noted:
                    page.heartbeat = now
            inhibit(is_powered)
            if silence.look(now, noted, is_powered) > patience:
                kill()  # it sends nothing from here on, even if it takes long to die
                why = f"was frozen for {patience * 1000:.0f} ms and has been killed"
                break
    if not notes.command.powered:
        return 0
    if arm is None:
        log(f"can_bridge {why}: its motors may still be powered")
        return 1
    for page in notes.noted:
        page.owner = f"the watchdog (PID {os.getpid()}) of {page.owner}; it is letting the arm down, wait until it ends"
    log(f"can_bridge {why}: letting the arm down")
    if let_down(arm, notes, log, is_wanted):
        log("the arm is down, its motors are off")
        return 0
    log("the motors may still be powered: the next can_bridge takes the bus over, and lets the arm down")
    return 1


class SleepInhibitor:
    """Keeps the computer from being suspended, where `command` can; () where nothing can."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None

    def hold(self, is_wanted: bool) -> None:
        """Start the command, or close its standard input, which ends it. Never waits for it, and never raises."""
        if is_wanted and self._process is None and self._command:
            try:
                self._process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
            except OSError:
                self._command = ()
        elif not is_wanted and self._process is not None:
            if self._process.stdin:
                self._process.stdin.close()
            self._process = None


def write_log(lines: SimpleQueue[str]) -> None:
    """Write lines to the standard error output until an empty one."""
    with contextlib.suppress(OSError):
        while line := lines.get():
            os.write(2, f"ERROR {line}\n".encode())


def main() -> None:
    """Entry point of the process.

    Arguments: the bridge's PID, the number of joints, and the descriptors of pipe, notes and locks. The notes are those
    of the bus of each joint's motor, the locks those of the buses.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    raise_priority(20)
    bridge, count, receiver, *shared = map(int, sys.argv[1:])
    pages = {page: CommandNotes.from_buffer(mmap.mmap(page, mmap.PAGESIZE)) for page in shared[:count]}
    locks = [socket.socket(fileno=lock) for lock in shared[count:]]
    log: SimpleQueue[str] = SimpleQueue()
    writer = threading.Thread(target=write_log, args=(log,), daemon=True)
    writer.start()
    code = guard(
        lambda: os.kill(bridge, signal.SIGKILL),
        ArmNotes([pages[page] for page in shared[:count]]),
        Connection(receiver, writable=False),
        log.put,
        lambda: any(map(is_asked_for, locks)),
        SleepInhibitor(INHIBIT if os.path.exists(SYSTEM_BUS) else ()).hold,
    )
    if code == 0:
        for page in pages:
            remove_notes(page)
    log.put("")
    writer.join(LOG_TIME)  # but do not wait for a reader that is frozen
    os._exit(code)  # its thread may be blocked


if __name__ == "__main__":
    main()
