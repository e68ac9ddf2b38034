"""A bus that this process owns: its lock, its watchdog, and what a previous owner left behind."""

from __future__ import annotations

from collections.abc import Callable

from exo_gravity.core.errors import BusError
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.ownership.bus_lock import BusLock, DriveNotes
from exo_gravity.hardware.ownership.handover import ArmOnBus, let_down
from exo_gravity.hardware.ownership.watchdog import Watchdog


class OwnedBus:
    """The bus of `arm`, locked for `owner` (shown to others who want the bus) until `close`.

    If the previous owner and its watchdog died while the motors were on, that arm is let down first. log: called with
    what happens then. Raises BusError if the bus is held or cannot be opened, or if that arm cannot be let down.
    """

    def __init__(self, arm: ArmOnBus, owner: str, log: Callable[[str], None], clock: Clock = COMPUTER_CLOCK) -> None:
        self._arm = arm
        self._clock = clock
        self._lock = BusLock(arm.address, owner, clock=clock)
        #: What the motors receive, for a process that outlives this one.
        self.notes = self._lock.notes
        try:
            _let_down(arm, self.notes, log, clock)
            self.watchdog = Watchdog(self._lock, arm, clock)
        except BaseException:
            self._lock.release()
            raise

    def open(self) -> MotorBus:
        """Open the bus. Raises BusError if it cannot be opened, or if another host commands the motors."""
        arm = self._arm
        bus = MotorBus(arm.open(), arm.motors, note=self.notes.note, reopen=arm.open, clock=self._clock)
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


def recover(
    arm: ArmOnBus, owner: str, log: Callable[[str], None], patience: float, clock: Clock = COMPUTER_CLOCK
) -> bool:
    """Let down an arm that a dead owner left with its motors on, and release the bus; return whether they are off.

    patience: s for the dead owner's watchdog to do so first. Raises BusError if the bus is still held then or cannot be
    opened, or if a motor does not reply.
    """
    lock = BusLock(arm.address, owner, patience, clock)
    try:
        _let_down(arm, lock.notes, log, clock)
        return not lock.notes.drive.powered
    finally:
        lock.release()


def _let_down(arm: ArmOnBus, notes: DriveNotes, log: Callable[[str], None], clock: Clock) -> None:
    drive = notes.drive
    if not drive.powered:
        return
    log("the last can_bridge on this bus and its watchdog died while the motors were on: letting the arm down")
    if not let_down(arm, drive, notes.note, log, is_endless=False, clock=clock):
        raise BusError(f"CAN bus {arm.address[1]}: a motor that may be powered does not reply")
    log("the arm is down, its motors are off")
