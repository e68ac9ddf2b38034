"""The bridge's end of the watchdog: starts its process, checks that it runs, and can hand the arm over to it.

The watchdog is a separate process (watchdog_process.py). It shares the notes of the bus with the bridge, and a
pipe, which breaks when the bridge dies for any reason. It inherits the lock of the bus.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from multiprocessing import Pipe

from exo_gravity.hardware.ownership.bus_lock import BusLock
from exo_gravity.hardware.ownership.handover import Charge

START_TIME = 15.0  # s until the first heartbeat: the process must import its modules on a busy machine
HEARTBEAT_TIMEOUT = 0.3  # s without a heartbeat, while this process itself runs
LONGEST_LOOK = 0.15  # s between two looks that count; longer ones show that this process did not run
END_TIME = 2.0  # s for the process to end after `close`


class Watchdog:
    """A watchdog process for the arm `charge`, on the bus that `lock` holds."""

    def __init__(self, lock: BusLock, charge: Charge) -> None:
        self._notes = lock.notes
        self._start = self._last_look = time.monotonic()
        self._heartbeat = 0.0
        self._silence = 0.0
        receiver, self._sender = Pipe(duplex=False)
        shared = (lock.descriptor, receiver.fileno())
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "exo_gravity.hardware.ownership.watchdog_process",
                str(os.getpid()),
                *map(str, shared),
            ],
            pass_fds=shared,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # keeps Ctrl-C and Ctrl-Z in the terminal away from it
        )
        receiver.close()
        self._sender.send(charge)

    @property
    def pid(self) -> int:
        """The process ID."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the watchdog process runs. Read it several times a second: it must also notice a frozen process."""
        if self._process.poll() is not None:
            return False
        now, heartbeat = time.monotonic(), self._notes.heartbeat
        if heartbeat == 0.0:
            return now - self._start < START_TIME
        is_new = heartbeat != self._heartbeat
        self._silence = 0.0 if is_new else self._silence + min(now - self._last_look, LONGEST_LOOK)
        self._heartbeat, self._last_look = heartbeat, now
        return self._silence < HEARTBEAT_TIMEOUT

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
