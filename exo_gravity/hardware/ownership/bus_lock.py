"""One owner per CAN bus on this host, and a page of notes for the process that comes after it.

The lock is a file named after the bus, locked with flock(2). The watchdog inherits its descriptor, so the kernel
releases the lock when bridge and watchdog have both ended. The file itself stays, and with it the notes: if both
processes were killed, the next owner knows what the motors still apply.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import re
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from exo_gravity.core.errors import BusError
from exo_gravity.core.safety.drive import Drive
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock

ATTEMPT_TIME = 1.0  # s; a watchdog with nothing to do may take that long to end after its bridge
ATTEMPT_PERIOD = 0.02  # s

NOTE = struct.Struct("=10d")  # monotonic time, powered, effort (4,), damping (4,)
HEARTBEAT = struct.Struct("=d")  # monotonic time
HEARTBEAT_AT, OWNER_AT, OWNER_LENGTH = 128, 256, 512  # bytes

Address = tuple[str, str, Mapping[str, Any]]  # interface, channel and options of a python-can bus


class DriveNotes:
    """One page of shared memory: what the motors of a bus receive, who owns the bus, and the watchdog's heartbeat.

    `MotorBus` notes each drive before its frames are sent. A process that outlives the writer thus knows the torque
    that the motors still apply. An empty page means that the motors are off.
    """

    def __init__(self, page: mmap.mmap, clock: Clock) -> None:
        self._page = page
        self._clock = clock

    def note(self, drive: Drive) -> None:
        """Note the drive that the motors are about to receive."""
        NOTE.pack_into(self._page, 0, self._clock.monotonic(), drive.powered, *drive.effort, *drive.damping)

    @property
    def time(self) -> float:
        """Time in s of the last note."""
        return float(NOTE.unpack_from(self._page)[0])

    @property
    def drive(self) -> Drive:
        """The last noted drive."""
        _, powered, *applied = NOTE.unpack_from(self._page)
        return Drive(tuple(applied[:4]), tuple(applied[4:]), bool(powered))

    def beat(self, now: float) -> None:
        """Note that the watchdog runs at `now` (s); 0 before it runs."""
        HEARTBEAT.pack_into(self._page, HEARTBEAT_AT, now)

    @property
    def heartbeat(self) -> float:
        """Time in s at which the watchdog last ran, 0 before it runs."""
        return float(HEARTBEAT.unpack_from(self._page, HEARTBEAT_AT)[0])

    @property
    def owner(self) -> str:
        """Who owns the bus, for error messages."""
        return self._page[OWNER_AT : OWNER_AT + OWNER_LENGTH].rstrip(b"\0").decode(errors="replace")

    @owner.setter
    def owner(self, text: str) -> None:
        self._page[OWNER_AT : OWNER_AT + OWNER_LENGTH] = text.encode()[:OWNER_LENGTH].ljust(OWNER_LENGTH, b"\0")


class BusLock:
    """Exclusive ownership of the bus at `address` until `release`. owner: shown to others who want the bus.

    Raises BusError with the present owner if the bus is still held after `patience` s.
    """

    def __init__(
        self, address: Address, owner: str, patience: float = ATTEMPT_TIME, clock: Clock = COMPUTER_CLOCK
    ) -> None:
        path = lock_file(address)
        try:
            path.parent.mkdir(mode=0o700, exist_ok=True)
            #: Of the lock file, for the watchdog to inherit.
            self.descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
            if os.fstat(self.descriptor).st_size < mmap.PAGESIZE:
                os.ftruncate(self.descriptor, mmap.PAGESIZE)
        except OSError as error:
            raise BusError(f"lock file {path}: {error.strerror}") from error
        self._page = mmap.mmap(self.descriptor, mmap.PAGESIZE)
        self._clock = clock
        #: The shared page.
        self.notes = DriveNotes(self._page, clock)
        if not self._is_acquired(patience):
            holder = self.notes.owner
            self.release()
            raise BusError(f"CAN bus {address[1]} is held by {holder}")
        self.notes.owner = owner
        self.notes.beat(0.0)

    def release(self) -> None:
        """Close the lock file: the bus is free once the watchdog has ended, too."""
        self._page.close()
        os.close(self.descriptor)

    def _is_acquired(self, patience: float) -> bool:
        end = self._clock.monotonic() + patience
        while True:
            try:
                fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return True
            except BlockingIOError:
                if self._clock.monotonic() > end:
                    return False
                self._clock.sleep(ATTEMPT_PERIOD)


def lock_file(address: Address) -> Path:
    """Return the path of the bus's lock file, in this user's runtime folder."""
    interface, channel, options = address
    parts = [interface, channel, *([str(options["port"])] if "port" in options else [])]
    return _runtime_folder() / (re.sub(r"[^\w.:-]", "_", "_".join(parts)) + ".bus")


def _runtime_folder() -> Path:
    for folder in (os.environ.get("XDG_RUNTIME_DIR"), f"/run/user/{os.getuid()}"):
        if folder and os.access(folder, os.W_OK):
            return Path(folder, "exo_gravity")
    return Path(tempfile.gettempdir(), f"exo_gravity-{os.getuid()}")
