"""The watchdog: a process that lets the arm down when its bridge dies, freezes or hands it over. Both ends of it.

It shares the notes of the bus with the bridge, and a pipe, which breaks when the bridge dies for any reason. It
inherits the lock of the bus. If the motors were on, it continues from the last noted drive. A bridge that is alive but
has noted nothing for `FROZEN` is killed first: two processes must never command one motor. Once a motor has not replied
for seconds and all others are down, the next bridge may ask for the bus: then the watchdog ends, and its notes stay.

While the motors are on it keeps the computer from being suspended: that would freeze both processes.

The process acts first and logs afterwards, on a thread: the pipe of its log may be full, because its reader is frozen.
Its exit code is 0 if the motors were off, or have confirmed that they are; 1 if they may still be powered.
"""

from __future__ import annotations

import contextlib
import importlib
import mmap
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from queue import SimpleQueue

import can

from exo_gravity.core.safety.params import FROZEN
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.ownership.bus_lock import BusLock, DriveNotes, is_asked_for, remove_notes
from exo_gravity.hardware.ownership.handover import ArmOnBus, let_down

# In the bridge.
START_TIME = 15.0  # s until the first heartbeat, before which no arm is enabled: imports on a busy machine take long
HEARTBEAT_TIMEOUT = 0.3  # s without a heartbeat, while this process itself runs
LONGEST_LOOK = 0.15  # s between two looks of a process that runs
END_TIME = 2.0  # s for the process to end after `close`
# In the watchdog's process.
POLL = 0.01  # s
LOG_TIME = 1.0  # s for the last lines of the log
SYSTEM_BUS = "/run/dbus/system_bus_socket"  # over which logind is reached, where it runs
# Holds logind's lock while its child runs: `cat`, which ends with this process, the other end of its standard input.
INHIBIT = ("systemd-inhibit", "--what=sleep:handle-lid-switch", "--who=exo_gravity", "--why=an arm is carried", "cat")


class Silence:
    """How long another process has given no sign of life, seen by a process that may have stood still itself.

    now: s. longest_look: s between two looks of a process that runs. If more time has passed, the whole machine may
    have stood still, and the other process gets another chance: only `longest_look` is added.
    """

    def __init__(self, now: float, longest_look: float) -> None:
        self._last_look = now
        self._longest_look = longest_look
        self._sign = 0.0
        self._duration = 0.0

    def look(self, now: float, sign: float, is_due: bool = True) -> float:
        """Return the silence in s at `now`, 0 if `sign` is new. is_due: whether the other process must give signs."""
        is_silent = is_due and sign == self._sign
        self._duration = self._duration + min(now - self._last_look, self._longest_look) if is_silent else 0.0
        self._last_look, self._sign = now, sign
        return self._duration


class Watchdog:
    """The bridge's end: the watchdog process of `arm`, on the bus that `lock` holds."""

    def __init__(self, lock: BusLock, arm: ArmOnBus, clock: Clock) -> None:
        self._notes = lock.notes
        self._clock = clock
        self._start = clock.monotonic()
        self._silence = Silence(self._start, LONGEST_LOOK)
        receiver, self._sender = Pipe(duplex=False)
        shared = (lock.descriptor, lock.socket.fileno(), receiver.fileno())
        self._process = subprocess.Popen(
            [sys.executable, "-m", "exo_gravity.hardware.ownership.watchdog", *map(str, (os.getpid(), *shared))],
            pass_fds=shared,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # keeps Ctrl-C and Ctrl-Z in the terminal away from it
        )
        receiver.close()
        self._sender.send(arm)

    @property
    def pid(self) -> int:
        """The process ID."""
        return self._process.pid

    @property
    def is_starting(self) -> bool:
        """Whether the watchdog does not watch yet: no motor may be switched on."""
        return self._notes.heartbeat == 0.0

    @property
    def alive(self) -> bool:
        """Whether the watchdog process runs. Read it several times a second: it must also notice a frozen process."""
        if self._process.poll() is not None:
            return False
        now, heartbeat = self._clock.monotonic(), self._notes.heartbeat
        if heartbeat == 0.0:
            return now - self._start < START_TIME
        return self._silence.look(now, heartbeat) < HEARTBEAT_TIMEOUT

    def hand_over(self, reason: str) -> bool:
        """Request the watchdog to kill this process and let the arm down; return whether it is alive."""
        if self._process.poll() is not None:
            return False
        with contextlib.suppress(OSError):
            self._sender.send(reason)
            return True
        return False

    def close(self) -> None:
        """End the watchdog and wait until it has ended. If the motors may be on, it stays and lets the arm down."""
        self._sender.close()
        if self._notes.drive.powered:
            return
        try:
            self._process.wait(END_TIME)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def guard(
    kill: Callable[[], None],
    notes: DriveNotes,
    receiver: Connection,
    log: Callable[[str], None],
    clock: Clock,
    is_wanted: Callable[[], bool] = lambda: False,
    inhibit: Callable[[bool], None] = lambda is_powered: None,
) -> int:
    """Watch the bridge until it has ended, let its arm down if necessary, and return the exit code.

    kill: kills the bridge. receiver: the watchdog's end of the pipe. is_wanted: whether the next bridge waits for the
    bus. inhibit: called often with whether the computer must not be suspended.
    """
    arm, why = _watch(kill, notes, receiver, clock, inhibit)
    drive = notes.drive
    if not drive.powered:
        return 0
    if arm is None:
        log(f"can_bridge {why}: its motors may still be powered")
        return 1
    notes.owner = f"the watchdog (PID {os.getpid()}) of {notes.owner}; it is letting the arm down, wait until it ends"
    log(f"can_bridge {why}: letting the arm down")
    if let_down(arm, drive, notes.note, log, clock=clock, is_wanted=is_wanted):
        log("the arm is down, its motors are off")
        return 0
    log("the motors may still be powered: the next can_bridge takes the bus over, and lets the arm down")
    return 1


def _watch(
    kill: Callable[[], None],
    notes: DriveNotes,
    receiver: Connection,
    clock: Clock,
    inhibit: Callable[[bool], None],
) -> tuple[ArmOnBus | None, str]:
    """Watch the bridge until it has ended; return the arm that it had, and why it ended."""
    arm: ArmOnBus | None = None
    silence = Silence(clock.monotonic(), 2 * POLL)
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            if receiver.poll(POLL):
                message = receiver.recv()
                if isinstance(message, str):
                    kill()
                    return arm, f"handed the arm over and has been killed ({message})"
                arm = message
                with contextlib.suppress(KeyError, ImportError):  # imports the bus's module ahead of time
                    importlib.import_module(can.interfaces.BACKENDS[message.address[0]][0])
            is_powered, noted, now = notes.drive.powered, notes.time, clock.monotonic()
            if arm:
                notes.beat(now)
            inhibit(is_powered)
            if silence.look(now, noted, is_powered) > FROZEN:
                kill()  # it sends nothing from here on, even if it takes long to die
                return arm, f"was frozen for {FROZEN * 1000:.0f} ms and has been killed"
    return arm, "has died"


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


def main() -> None:
    """Entry point of the process; arguments: the bridge's PID, and the descriptors of notes, lock and pipe."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    bridge, page, lock, receiver = map(int, sys.argv[1:])
    notes = DriveNotes(mmap.mmap(page, mmap.PAGESIZE), COMPUTER_CLOCK)
    log, pipe = Log(), Connection(receiver, writable=False)
    sleep = SleepInhibitor(INHIBIT if os.path.exists(SYSTEM_BUS) and shutil.which(INHIBIT[0]) else ())
    code = guard(
        lambda: os.kill(bridge, signal.SIGKILL),
        notes,
        pipe,
        log.write,
        COMPUTER_CLOCK,
        partial(is_asked_for, socket.socket(fileno=lock)),
        sleep.hold,
    )
    if code == 0:
        remove_notes(page)
    log.close()
    os._exit(code)  # the log's thread may be blocked


if __name__ == "__main__":
    main()
