"""One page of shared memory: what the motors of a bus receive, who owns the bus, and the watchdog's heartbeat.

`MotorBus` notes each drive before its frames are sent. So whoever outlives the writer knows the torque that the motors
still apply: the watchdog, or the next bridge, because the page belongs to the lock file of the bus.
"""

from __future__ import annotations

import mmap
import struct
import time

from exo_gravity.core.safety.drive import Drive

NOTE = struct.Struct("=10d")  # monotonic time, powered, effort (4,), damping (4,)
HEARTBEAT = struct.Struct("=d")  # monotonic time
HEARTBEAT_AT, OWNER_AT, OWNER_LENGTH = 128, 256, 512  # bytes


class DriveNotes:
    """The notes in `page`, which two processes share. An empty page means that the motors are off."""

    def __init__(self, page: mmap.mmap) -> None:
        self._page = page

    def note(self, drive: Drive) -> None:
        """Note the drive that the motors are about to receive."""
        NOTE.pack_into(self._page, 0, time.monotonic(), drive.powered, *drive.effort, *drive.damping)

    @property
    def time(self) -> float:
        """Monotonic time in s of the last note."""
        return float(NOTE.unpack_from(self._page)[0])

    @property
    def drive(self) -> Drive:
        """The last noted drive."""
        _, powered, *applied = NOTE.unpack_from(self._page)
        return Drive(tuple(applied[:4]), tuple(applied[4:]), bool(powered))

    def beat(self, now: float) -> None:
        """Note that the watchdog runs at `now` (monotonic s); 0 before it runs."""
        HEARTBEAT.pack_into(self._page, HEARTBEAT_AT, now)

    @property
    def heartbeat(self) -> float:
        """Monotonic time in s at which the watchdog last ran, 0 before it runs."""
        return float(HEARTBEAT.unpack_from(self._page, HEARTBEAT_AT)[0])

    @property
    def owner(self) -> str:
        """Who owns the bus, for error messages."""
        return self._page[OWNER_AT : OWNER_AT + OWNER_LENGTH].rstrip(b"\0").decode(errors="replace")

    @owner.setter
    def owner(self, text: str) -> None:
        self._page[OWNER_AT : OWNER_AT + OWNER_LENGTH] = text.encode()[:OWNER_LENGTH].ljust(OWNER_LENGTH, b"\0")
