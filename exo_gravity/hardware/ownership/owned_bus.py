"""A bus that this process owns: its lock, its watchdog, and what a previous owner left behind."""

from __future__ import annotations

from collections.abc import Callable

from exo_gravity.core.errors import BusError
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.ownership.bus_lock import ATTEMPT_TIME, BusLock
from exo_gravity.hardware.ownership.handover import ArmOnBus, let_down
from exo_gravity.hardware.ownership.watchdog import Watchdog


class OwnedBus:
    """The bus of `arm`, locked for `owner` (shown to others who want the bus) until `close`.

    If the previous owner and its watchdog ended while the motors were on, that arm is let down first. log: called with
    what happens then. Raises BusError if the bus is held or cannot be opened, or if that arm cannot be let down.
    """

    def __init__(self, arm: ArmOnBus, owner: str, log: Callable[[str], None], clock: Clock = COMPUTER_CLOCK) -> None:
        self._arm = arm
        self._clock = clock
        self._lock = _take(arm, owner, log, ATTEMPT_TIME, clock)
        #: What the motors receive, for a process that outlives this one.
        self.notes = self._lock.notes
        try:
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
) -> None:
    """Let down an arm that a dead owner left with its motors on, and release the bus.

    patience: s for the dead owner's watchdog to do so first. Raises BusError if the bus is still held then or cannot be
    opened, or if a motor does not reply.
    """
    _take(arm, owner, log, patience, clock).release()


def _take(arm: ArmOnBus, owner: str, log: Callable[[str], None], patience: float, clock: Clock) -> BusLock:
    """Lock the bus, and let down the arm that its last owner left with its motors on.

    If it cannot be reached, a watchdog stays and keeps trying, until the next owner asks for the bus. Raises BusError.
    """
    lock = BusLock(arm.address, owner, patience, clock, asks=True)
    try:
        drive = lock.notes.drive
        if lock.problem:
            log(f"it is not known what the motors apply, they may be on ({lock.problem}): letting the arm down")
        elif drive.powered:
            log("the last can_bridge on this bus and its watchdog ended with the motors on: letting the arm down")
        if drive.powered:
            if not let_down(arm, drive, lock.notes.note, log, is_endless=False, clock=clock):
                Watchdog(lock, arm, clock).close()
                raise BusError(f"CAN bus {arm.address[1]}: a motor that may be powered does not reply")
            log("the arm is down, its motors are off")
        return lock
    except BaseException:
        lock.release()
        raise
