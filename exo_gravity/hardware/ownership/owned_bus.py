"""A bus that this process owns: its lock, its watchdog, and what a previous owner left behind."""

from __future__ import annotations

from collections.abc import Callable

from exo_gravity.core.errors import BusError
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.ownership.bus_lock import BusLock
from exo_gravity.hardware.ownership.drive_notes import DriveNotes
from exo_gravity.hardware.ownership.handover import Charge, let_down
from exo_gravity.hardware.ownership.watchdog import Watchdog


class OwnedBus:
    """The bus of the arm `charge`, locked for `owner` (shown to others who want the bus) until `close`.

    If the previous owner and its watchdog died while the motors were on, that arm is let down first. log: called with
    what happens then. Raises BusError if the bus is held or cannot be opened, or if that arm cannot be let down.
    """

    def __init__(self, charge: Charge, owner: str, log: Callable[[str], None]) -> None:
        self._charge = charge
        self._lock = BusLock(charge.address, owner)
        try:
            _let_down(charge, self._lock.notes, log)
            self.watchdog = Watchdog(self._lock, charge)
        except BaseException:
            self._lock.release()
            raise

    def open(self) -> MotorBus:
        """Open the bus. Raises BusError if it cannot be opened, or if another host commands the motors."""
        reopen = self._charge.open
        bus = MotorBus(reopen(), self._charge.motors, note=self._lock.notes.note, reopen=reopen)
        try:
            bus.listen()
        except BusError:
            bus.close()
            raise
        return bus

    def close(self) -> None:
        """End the watchdog and release the bus, after the motors were switched off."""
        self.watchdog.close()
        self._lock.release()


def recover(charge: Charge, owner: str, log: Callable[[str], None], patience: float) -> bool:
    """Let down an arm that a dead owner left with its motors on, and release the bus; return whether they are off.

    patience: s for the dead owner's watchdog to do so first. Raises BusError if the bus is still held then or cannot be
    opened, or if a motor does not reply.
    """
    lock = BusLock(charge.address, owner, patience)
    try:
        _let_down(charge, lock.notes, log)
        return not lock.notes.drive.powered
    finally:
        lock.release()


def _let_down(charge: Charge, notes: DriveNotes, log: Callable[[str], None]) -> None:
    drive = notes.drive
    if not drive.powered:
        return
    log("the last can_bridge on this bus and its watchdog died while the motors were on: letting the arm down")
    if not let_down(charge, drive, notes.note, log, is_endless=False):
        raise BusError(f"CAN bus {charge.address[1]}: a motor that may be powered does not reply")
    log("the arm is down, its motors are off")
