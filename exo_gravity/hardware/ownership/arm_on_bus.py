"""An arm on its bus, or on its buses: the ports of its motors, and the locks and notes of all buses together."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import can

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.joint_motor import JointMotor, buses_of
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.drive import Drive
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.can.can_port import CanPort, open_bus
from exo_gravity.hardware.clock import Clock
from exo_gravity.hardware.ownership.bus_lock import Address, BusLock, DriveNotes, bus_name


@dataclass(frozen=True)
class ArmOnBus:
    """An arm that may have to be let down, and how to reach it."""

    address: Address  #: Of its bus; of several, as the parameters `can` state them.
    motors: Sequence[JointMotor]  #: From shoulder to elbow.
    limits: Limits  #: That it must never exceed.
    period: float  #: s of a control cycle.
    joints: Sequence[int] = field(default=range(JOINT_COUNT), kw_only=True)  #: (0..3) That are to be reached.

    @property
    def parts(self) -> "list[ArmOnBus]":
        """The arm's part on each of its buses."""
        interface, channel, options = self.address
        buses = buses_of(channel, options).items()
        parts = ((name, own, [joint for joint in on if joint in self.joints]) for name, (on, own) in buses)
        return [replace(self, address=(interface, name, own), joints=joints) for name, own, joints in parts if joints]

    def open(self, address: Address) -> can.BusABC:
        """Open one of its buses. Raises BusError."""
        return open_bus(*address)

    def ports(self, clock: Clock, failures: list[BusError] | None = None) -> list[CanPort | None]:
        """Open its buses; return the port of each joint's motor (4,), None for one that is not to be reached.

        failures: receives the error of each bus that cannot be opened, instead of its ports. Without it, raises
        BusError.
        """
        ports: list[CanPort | None] = [None] * JOINT_COUNT
        for part in self.parts:
            try:
                port = CanPort(self.open(part.address), clock, partial(self.open, part.address))
            except BusError as error:
                if failures is None:
                    for opened in filter(None, ports):
                        opened.close()
                    raise
                failures.append(error)
                continue
            for joint in part.joints:
                ports[joint] = port
        return ports


class ArmNotes:
    """The notes of all buses of an arm as one. pages: of the bus of each joint's motor (4,).

    joints: (0..3) on whose buses to note. Every bus has the notes of the whole arm.
    """

    def __init__(self, pages: Sequence[DriveNotes], joints: Sequence[int] = range(JOINT_COUNT)) -> None:
        self.clock = pages[0].clock
        self._pages = pages
        self._noted = list({id(pages[joint]): pages[joint] for joint in joints}.values())

    def of(self, joints: Sequence[int]) -> "ArmNotes":
        """Return the notes of the buses of these joints alone."""
        return ArmNotes(self._pages, joints)

    def note(self, drive: Drive) -> None:
        """Note what the motors are about to receive."""
        for page in self._noted:
            page.note(drive)

    @property
    def drive(self) -> Drive:
        """What the motors received last; powered if they may be on on one bus."""
        drives = [page.drive for page in self._pages]
        effort, damping = zip(*((drive.effort[i], drive.damping[i]) for i, drive in enumerate(drives)), strict=True)
        return Drive(effort, damping, any(drive.powered for drive in drives))

    @property
    def time(self) -> float:
        """S, of the last note."""
        return max(page.time for page in self._noted)

    @property
    def heartbeat(self) -> float:
        """S, at which the watchdog last ran; 0 before it runs."""
        return self._pages[0].heartbeat

    @heartbeat.setter
    def heartbeat(self, now: float) -> None:
        for page in self._noted:
            page.heartbeat = now

    @property
    def owner(self) -> str:
        """Who owns the buses, for error messages."""
        return self._pages[0].owner

    @owner.setter
    def owner(self, text: str) -> None:
        for page in self._noted:
            page.owner = text


class ArmLock:
    """Exclusive ownership of every bus of `arm` until `release`. `BusLock` explains the arguments.

    The buses are locked in the order of their names: two owners never wait for each other. Raises BusError, and owns
    none, if one is held.
    """

    def __init__(self, arm: ArmOnBus, owner: str, patience: float, clock: Clock) -> None:
        self.locks: list[BusLock] = []  #: of the buses
        own: dict[int, BusLock] = {}
        try:
            for part in sorted(arm.parts, key=lambda part: bus_name(part.address)):
                self.locks.append(BusLock(part.address, owner, patience, clock, asks=True))
                own |= dict.fromkeys(part.joints, self.locks[-1])
        except BaseException:
            self.release()
            raise
        self.of_joints = [own[joint] for joint in range(JOINT_COUNT)]  #: (4,) of the bus of each joint's motor
        self.notes = ArmNotes([lock.notes for lock in self.of_joints])

    def release(self) -> None:
        """Give up all buses: they are free once the watchdog has ended, too."""
        for lock in self.locks:
            lock.release()
