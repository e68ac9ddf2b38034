"""One owner per CAN bus on this host: two processes must never command one motor.

The lock is a file named after the bus, locked with flock(2). The watchdog inherits its descriptor, so the kernel
releases the lock when bridge and watchdog have both ended. The file itself stays, and with it the notes
(hardware/ownership/drive_notes.py): if both processes were killed, the next owner knows what the motors still apply.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import re
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from exo_gravity.core.errors import BusError
from exo_gravity.hardware.ownership.drive_notes import DriveNotes

ATTEMPT_TIME = 1.0  # s; a watchdog with nothing to do may take that long to end after its bridge
ATTEMPT_PERIOD = 0.02  # s

Address = tuple[str, str, Mapping[str, Any]]  # interface, channel and options of a python-can bus


class BusLock:
    """Exclusive ownership of the bus at `address` until `release`. owner: shown to others who want the bus.

    notes: the shared page. descriptor: of the lock file, for the watchdog to inherit. Raises BusError with the present
    owner if the bus is still held after `patience` s.
    """

    def __init__(self, address: Address, owner: str, patience: float = ATTEMPT_TIME) -> None:
        path = lock_file(address)
        try:
            path.parent.mkdir(mode=0o700, exist_ok=True)
            self.descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
            if os.fstat(self.descriptor).st_size < mmap.PAGESIZE:
                os.ftruncate(self.descriptor, mmap.PAGESIZE)
        except OSError as error:
            raise BusError(f"lock file {path}: {error.strerror}") from error
        self._page = mmap.mmap(self.descriptor, mmap.PAGESIZE)
        self.notes = DriveNotes(self._page)
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
        end = time.monotonic() + patience
        while True:
            try:
                fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return True
            except BlockingIOError:
                if time.monotonic() > end:
                    return False
                time.sleep(ATTEMPT_PERIOD)


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
