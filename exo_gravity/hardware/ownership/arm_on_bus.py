"""An arm on its bus or its buses: the ports of its motors, and the locks and notes of all buses together."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import can

from exo_gravity.core.motors.joint_motor import JointMotor, buses_of
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.drive import Drive
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.can.can_port import CanPort, open_bus
from exo_gravity.hardware.clock import Clock
from exo_gravity.hardware.ownership.bus_lock import Address, BusLock, bus_name


@dataclass(frozen=True)
class ArmOnBus:
    """An arm that may have to be let down, and how to reach it."""

    address: Address  #: Of its bus; of several, as the parameters `can` state them.
    motors: Sequence[JointMotor]  #: From shoulder to elbow.
    limits: Limits  #: That it must never exceed.
    period: float  #: s of a control cycle.
    joints: Sequence[int] = field(default=range(JOINT_COUNT), kw_only=True)  #: (0..3) That are to be let down.

    @property
    def name(self) -> str:
        """What is to be let down, in words."""
        return "the arm" if len(self.joints) == JOINT_COUNT else f"the part of the arm on {self.address[1]}"

    @property
    def parts(self) -> "list[ArmOnBus]":
        """The arm's part on each of its buses."""
        interface, channel, options = self.address
        return [
            replace(self, address=(interface, name, own), joints=[joint for joint in joints if joint in self.joints])
            for name, (joints, own) in buses_of(channel, options).items()
        ]

    def open(self, address: Address) -> can.BusABC:
        """Open one of its buses. Raises BusError."""
        return open_bus(*address)

    def ports(self, clock: Clock) -> list[CanPort | None]:
        """Open all buses; return the port of each joint's motor (4,), None for another's joint. Raises BusError."""
        ports: list[CanPort | None] = [None] * JOINT_COUNT
        with contextlib.ExitStack() as opened:
            for part in self.parts:
                port = CanPort(self.open(part.address), clock, partial(self.open, part.address))
                opened.callback(port.close)
                for joint in part.joints:
                    ports[joint] = port
            opened.pop_all()
        return ports


class ArmLock:
    """Exclusive ownership of every bus of `arm` until `release`, and the notes of the whole arm, as in `DriveNotes`.

    The buses are locked in the order of their names: two owners never wait for each other. `BusLock` explains the
    arguments. Raises BusError, and owns none, if one is held.
    """

    def __init__(self, arm: ArmOnBus, owner: str, patience: float, clock: Clock) -> None:
        self.clock = clock
        self.locks: list[tuple[BusLock, ArmOnBus]] = []  #: each with the part of the arm on its bus
        try:
            for part in sorted(arm.parts, key=lambda part: bus_name(part.address)):
                self.locks.append((BusLock(part.address, owner, patience, clock, asks=True), part))
        except BaseException:
            self.release()
            raise
        of = {joint: lock.notes for lock, part in self.locks for joint in part.joints}
        self._pages = [of[joint] for joint in range(JOINT_COUNT)]  # of each joint's bus

    def note(self, drive: Drive) -> None:
        """Note what the motors are about to receive, for each bus."""
        for lock, _ in self.locks:
            lock.notes.note(drive)

    @property
    def drive(self) -> Drive:
        """What the motors received last; a bus on which they may be on is enough for `powered`."""
        drives = [page.drive for page in self._pages]
        effort, damping = zip(*((drive.effort[i], drive.damping[i]) for i, drive in enumerate(drives)), strict=True)
        return Drive(effort, damping, any(drive.powered for drive in drives))

    def release(self) -> None:
        """Give up all buses."""
        for lock, _ in self.locks:
            lock.release()
