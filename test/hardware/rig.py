# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A simulated arm on a CAN bus, and the truth about it: how fast its joints really turn, and which motors are on."""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import can

from exo_gravity.core.arm.gravity import NO_TORQUE, gravity_torque
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.frames import WireFormat
from exo_gravity.core.motors.joint_motor import JointSample, channels_of
from exo_gravity.core.safety.drive import Drive, Efforts, State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.can.can_port import Address, ArmOnBus
from exo_gravity.hardware.clock import Clock
from exo_gravity.hardware.control_loop import Controller, NoController
from exo_gravity.hardware.ownership.bus_lock import ArmNotes, BusLock, DriveNotes
from exo_gravity.hardware.ownership.owned_bus import let_down
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.virtual_arm import VirtualArm
from exo_gravity.sim.virtual_time import TICK, Played, Wire

from ..support.copies import prepared
from ..support.simulated_device import drive_of, joints_of, make_device

MOTORS_OF_ARM = joints_of((MIT,) * 4)
LIMITS = Limits(("a", "b", "c", "d"), (-1.6,) * 4, (3.1,) * 4, (6.0,) * 4, (3.0, 9.0, 3.0, 3.0))
QUICK = replace(LIMITS, sign_check_torque=0.0)
CYCLE = 0.008  # s
POSE = (0.0, 0.6, 0.3, 0.3)  # rad
SAFE_SPEED = 1.0  # rad/s
FIRST, SECOND = f"first{os.getpid()}", f"second{os.getpid()}"  # buses
AFTER_EXIT = 0.5  # s for which a joint that was dropped would turn


class Rig:
    """A simulated arm at rest in `pose`. carried: its motors are on and hold it, as if a dead process had left them.

    carrying: (4,) Nm, what holds it in `POSE`. top_speed: rad/s, the largest true speed of a joint so far.
    """

    def __init__(
        self, friction: float, pose: Sequence[float], carried: bool, clock: Clock, wire_format: WireFormat = MIT
    ) -> None:
        config = ArmConfig(coulomb_friction=(friction,) * 4)
        self.clock = clock
        self.motors = joints_of((wire_format,) * 4)
        self.device = make_device(config=config, formats=(wire_format,) * 4)
        self.device.arm.reset(pose)
        self.links = config.links
        self.carrying = tuple(gravity_torque(self.links, POSE))
        self.top_speed = 0.0
        if carried:
            for joint, torque in zip(self.motors, self.carrying, strict=True):
                self.device.exchange(joint.command_id, joint.command(torque, 0.0))
                for frame in joint.enter:
                    self.device.exchange(*frame)

    @property
    def motors_on(self) -> list[bool]:
        """Whether each motor is on."""
        return [motor.entered for motor in self.device.motors]

    def note_speed(self, _now: float = 0.0) -> None:
        self.top_speed = max(self.top_speed, *map(abs, self.device.arm.velocities))

    def assert_let_down(self) -> None:
        """The motors are off, and no joint turned fast, not even once nothing held it."""
        assert self.motors_on == [False] * 4
        self.clock.sleep(AFTER_EXIT)
        assert self.top_speed < SAFE_SPEED
        assert abs(self.device.arm.positions[1]) < 0.4  # from 0.6


@dataclass(frozen=True)
class ArmOnWires(ArmOnBus):
    """An arm whose buses are wires in virtual time, by the name of their channel."""

    wires: dict[str, Wire]

    def open(self, address: Address) -> can.BusABC:
        return self.wires[address[1]].open()


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
        self.wire.play(self.device, self.note_speed, CYCLE)
        name = f"of process {os.getpid()}"
        self.arm: ArmOnBus = ArmOnWires(("wire", name, {}), self.motors, LIMITS, CYCLE, {name: self.wire})

    def loop_with(self, controller: Controller | None = None, limits: Limits = LIMITS, **options: Any) -> VirtualArm:
        """Return the arm with a control loop; by default its controller asks for nothing."""
        ports = self.arm.ports(self.clock)
        return VirtualArm(
            self.device, controller or NoController(), self.motors, limits, 1.0 / CYCLE, self.wire, ports, **options
        )

    @property
    def drive(self) -> Drive:
        """What holds the arm in `POSE`."""
        return drive_of(self.carrying)

    @property
    def is_raised(self) -> bool:
        """Whether the arm is in `POSE`, nearly at rest."""
        arm = self.device.arm
        return math.dist(arm.positions, POSE) < 0.1 and max(map(abs, arm.velocities)) < 0.1

    def switch_supply(self, on: bool) -> None:
        """Switch the supply of all motors; they come back switched off."""
        for motor in self.device.motors:
            motor.unplugged = not on

    def notes_of(self, drive: Drive | None = None) -> DriveNotes:
        """Return notes in memory, as a bridge has them that applies `drive`; by default what holds the arm."""
        notes = DriveNotes.from_buffer(bytearray(ctypes.sizeof(DriveNotes)))
        notes.clock = self.clock
        notes.note(drive or self.drive)
        return notes

    def leave_on(self) -> None:
        """Leave the notes of a bridge that died with its watchdog, on each bus; of other buses they know nothing."""
        for part in self.arm.parts:
            lock = BusLock(part.address, "a dead bridge")
            own = [torque if joint in part.joints else 7.0 for joint, torque in enumerate(self.carrying)]
            lock.notes.note(drive_of(own))
            lock.release()

    def let_down(
        self, drive: Drive | None = None, is_wanted: bool = False, log: Callable[[str], None] = lambda text: None
    ) -> bool:
        """Let down the arm that a dead process left with `drive` (default: what holds it); return whether it is off."""
        self.notes = self.notes_of(drive)
        return let_down(self.arm, ArmNotes([self.notes] * 4), log, lambda: is_wanted)


class HalfPlayed(Played):
    """Some motors of a device whose others are played on another wire. strays: frames to those that came here."""

    def __init__(self, wire: Wire, rig: VirtualRig, joints: tuple[int, ...], other: HalfPlayed | None = None) -> None:
        self._joints, self._other = joints, other
        self.strays: list[can.Message] = []
        super().__init__(wire, rig.device, rig.note_speed, TICK)

    def deliver(self, message: can.Message) -> None:
        if (message.arbitration_id & 0xFF) - 1 in self._joints:
            super().deliver(message)
        else:
            self.strays.append(message)

    def catch_up(self) -> None:
        if self._other:
            self._other.catch_up()
        else:
            super().catch_up()

    def _report(self, joint: int) -> None:
        if joint in self._joints:
            super()._report(joint)


class TwoBusRig(VirtualRig):
    """Motors 1 and 2 are on the first bus, 3 and 4 on the second."""

    def connect(self) -> None:
        self.wires = {FIRST: self.wire, SECOND: Wire(self.clock)}
        self.first, self.second = self.wires.values()
        near = HalfPlayed(self.first, self, (0, 1))
        self.halves = near, HalfPlayed(self.second, self, (2, 3), near)
        address: Address = ("wire", f"{FIRST},{FIRST},{SECOND},{SECOND}", {})
        limits = replace(LIMITS, channels=channels_of(address[1], 4))
        self.arm = ArmOnWires(address, self.motors, limits, CYCLE, self.wires)

    @property
    def damping(self) -> list[float]:
        return [motor.damping for motor in self.device.motors]


class OnWatch:
    """Notes on the clock of `rig` whether a motor was on since."""

    def __init__(self, rig: VirtualRig) -> None:
        self.was_on = False
        self._rig = rig
        self.end = rig.clock.every(0.002, self._look)

    def _look(self) -> None:
        self.was_on |= any(self._rig.motors_on)


class Raising:
    """Raises the arm of `rig` to `POSE`, and holds it there once `is_raised` is set.

    is_carried: returns whether the arm is carried; before that it is asked for nothing.
    failures: exceptions that `efforts` and `take` raise from now on.
    """

    def __init__(self, rig: VirtualRig) -> None:
        self.is_raised = False
        self.is_carried: Callable[[], bool] = lambda: True
        self.failures: dict[str, Exception] = {}
        self._rig = rig

    def efforts(self, _latest: float) -> Efforts:
        self._fail("efforts")
        rig, arm, effort = self._rig, self._rig.device.arm, self._rig.carrying
        if not self.is_carried():
            effort = (0.0,) * len(effort)
        elif not self.is_raised:
            columns = zip(gravity_torque(rig.links, arm.positions), POSE, arm.positions, arm.velocities, strict=True)
            effort = tuple(torque + 4.0 * (to - angle) - 1.0 * speed for torque, to, angle, speed in columns)
        return Efforts(effort, rig.clock.monotonic(), False, False)

    def take(self, _now: float, _samples: Sequence[JointSample]) -> None:
        self._fail("take")

    def _fail(self, where: str) -> None:
        if where in self.failures:
            raise self.failures[where]


class CarriedArm:
    """An arm that a control loop carries in `POSE`, ACTIVE; options: those of the loop. drives: all that were noted."""

    def __init__(
        self, echoes: bool = False, wire_format: WireFormat = MIT, kind: type[VirtualRig] = VirtualRig, **options: Any
    ) -> None:
        self.rig = kind(pose=NO_TORQUE, carried=False, echoes=echoes, wire_format=wire_format)
        self.drives: list[Drive] = []
        self.controller = Raising(self.rig)
        self._arm = arm = self.rig.loop_with(
            self.controller,
            replace(self.rig.arm.limits, sign_check_torque=0.0),
            note=self._note,
            **options,
        )
        self.clock, self.wire, self.bus, self.safety, self.loop = arm.clock, arm.wire, arm.bus, arm.safety, arm.loop
        self.run = arm.run
        self.controller.is_carried = self._is_carried
        arm.enable()
        self.run_until(lambda: self.safety.fault or (self.rig.is_raised and self.safety.state is State.ACTIVE))
        assert self.safety.state is State.ACTIVE, self.safety.fault
        self.controller.is_raised = True
        self.rig.top_speed = 0.0

    def _note(self, drive: Drive) -> None:
        self.drives.append(drive)

    def _is_carried(self) -> bool:
        return self.safety.state in (State.RAMPING_IN, State.ACTIVE)

    def run_until(self, condition: Callable[[], object], timeout: float = 60.0) -> None:
        """Run the loop until `condition()` holds."""
        assert self._arm.run_until(condition, timeout), self.loop.failure or "the condition did not hold in time"

    def assert_let_down(self) -> None:
        self.run_until(lambda: self.loop.is_off)
        self.rig.assert_let_down()


raised_arm = prepared(CarriedArm)
