"""A simulated arm on a bus in virtual time, and a control loop that carries it."""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import can

from exo_gravity.core.arm.gravity import gravity_torque
from exo_gravity.core.motors.wire_formats import MIT, WireFormat
from exo_gravity.core.safety.drive import NOTHING, Drive, EffortCommand, State
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.hardware.can.can_port import Address, ArmOnBus
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.hardware.ownership.bus_lock import ArmNotes, DriveNotes
from exo_gravity.hardware.ownership.owned_bus import let_down

from .simulated_rig import LIMITS, POSE, Rig
from .virtual_time import Wire

CYCLE = 0.008  # s
QUICK = replace(LIMITS, sign_check_torque=0.0)


@dataclass(frozen=True)
class VirtualArm(ArmOnBus):
    """An arm whose bus is a wire in virtual time."""

    wire: Wire

    def open(self, address: Address) -> can.BusABC:
        return self.wire.open()


class VirtualRig(Rig):
    """A simulated arm on a wire in virtual time."""

    def __init__(
        self,
        friction: float = 0.1,
        pose: Sequence[float] = POSE,
        carried: bool = True,
        echoes: bool = False,
        wire_format: WireFormat = MIT,
    ) -> None:
        self.wire = Wire(echoes=echoes)
        super().__init__(friction, pose, carried, self.wire.clock, wire_format)
        self.connect()

    def connect(self) -> None:
        """Connect the device to its wire."""
        self.wire.play(self.device, self.note_speed)
        self.arm: ArmOnBus = VirtualArm(
            ("wire", f"of process {os.getpid()}", {}), self.motors, LIMITS, CYCLE, self.wire
        )

    @property
    def drive(self) -> Drive:
        """What holds the arm in `POSE`."""
        return Drive(self.carrying, NOTHING, True)

    @property
    def is_raised(self) -> bool:
        """Whether the arm is in `POSE`, nearly at rest."""
        arm = self.device.arm
        return math.dist(arm.positions, POSE) < 0.1 and max(map(abs, arm.velocities)) < 0.1

    def switch_supply(self, on: bool) -> None:
        """Switch the supply of all motors; they come back switched off."""
        for motor in self.device.motors:
            motor.unplugged = not on

    def let_down(
        self, drive: Drive | None = None, is_wanted: bool = False, log: Callable[[str], None] = lambda text: None
    ) -> bool:
        """Let down the arm that a dead process left with `drive` (default: what holds it); return whether it is off."""
        self.notes = DriveNotes.from_buffer(bytearray(ctypes.sizeof(DriveNotes)))
        self.notes.clock = self.clock
        self.notes.note(drive or self.drive)
        return let_down(self.arm, ArmNotes([self.notes] * 4), log, lambda: is_wanted)

    def raising(self) -> tuple[float, ...]:
        """Return the torque (4,) in Nm that carries the arm where it is, and moves it to `POSE`."""
        arm = self.device.arm
        carrying = gravity_torque(self.links, arm.positions)
        columns = zip(carrying, POSE, arm.positions, arm.velocities, strict=True)
        return tuple(effort + 4.0 * (to - angle) - 1.0 * speed for effort, to, angle, speed in columns)


class Carried:
    """An arm that a control loop carries in `POSE`, ACTIVE; options: those of the loop.

    drives: all that were noted. get_efforts: what the loop asks for efforts.
    """

    def __init__(
        self,
        echoes: bool = False,
        wire_format: WireFormat = MIT,
        kind: type[VirtualRig] = VirtualRig,
        **options: Callable[..., object],
    ) -> None:
        self.rig = kind(pose=NOTHING, carried=False, echoes=echoes, wire_format=wire_format)
        self.clock, self.wire = self.rig.clock, self.rig.wire
        self.drives: list[Drive] = []
        ports = self.rig.arm.ports(self.clock)
        self.motors = MotorBus(ports, self.rig.motors, note=self.drives.append, clock=self.clock)
        quick = replace(self.rig.arm.limits, sign_check_torque=0.0)
        self.safety = SafetyMachine(quick, CYCLE, self.rig.motors)
        self.failure_of_efforts: Exception | None = None
        self._is_raised = False
        self.get_efforts: Callable[[float], EffortCommand] = self._carrying
        self.loop = ControlLoop(
            self.motors, self.safety, CYCLE, get_efforts=lambda latest: self.get_efforts(latest), **options
        )
        self.safety.enable(self.clock.monotonic())
        self.run_until(lambda: self.safety.fault or self.rig.is_raised)
        assert self.safety.state is State.ACTIVE, self.safety.fault
        self._is_raised = True
        self.rig.top_speed = 0.0

    def _carrying(self, _latest: float) -> EffortCommand:
        if self.failure_of_efforts:
            raise self.failure_of_efforts
        efforts = self.rig.carrying if self._is_raised else self.rig.raising()
        return EffortCommand(efforts, self.clock.monotonic())

    def run(self, duration: float) -> None:
        """Run the loop for `duration` s."""
        end = self.clock.monotonic() + duration
        while self.clock.monotonic() < end:
            self.loop.cycle()

    def run_until(self, condition: Callable[[], object], timeout: float = 60.0) -> None:
        """Run the loop until `condition()` holds."""
        end = self.clock.monotonic() + timeout
        while not condition():
            assert self.clock.monotonic() < end, "the condition did not hold in time"
            assert self.loop.cycle(), self.loop.failure

    def assert_let_down(self) -> None:
        self.run_until(lambda: self.loop.is_off)
        self.rig.assert_let_down()
