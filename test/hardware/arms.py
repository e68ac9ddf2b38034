# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arms of this folder: sim's `Rig`, on motors and buses that a test chooses, and a device in real time."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import can
import numpy as np

from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.frames import WireFormat
from exo_gravity.core.motors.joint_motor import Address, JointMotor, channels_of
from exo_gravity.core.safety.command import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.bus_lock import CommandNotes
from exo_gravity.hardware.can_port import ArmOnBus, CanPort, open_bus
from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.sim import ArmConfig, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS, SimulatedArm
from exo_gravity.sim.device import SimulatedDevice, TruthRecords
from exo_gravity.sim.rig import ACTS, Rig
from exo_gravity.sim.virtual_time import Wire

from ..support import PARTS
from ..support.copies import prepared
from ..support.ports import own_ports
from ..support.simulated_device import joints_of

RATE = 125.0  # Hz
REAL_RATE = 250.0  # Hz, of config/exo.yaml: how far a joint moves until a loss is seen depends on it
CYCLE = 1.0 / RATE  # s
MOTORS_OF_ARM = joints_of((MIT,) * 4)
RATED, PEAK = (3.0, 9.0, 3.0, 3.0), (9.0, 18.0, 9.0, 9.0)  # Nm
LIMITS = Limits(PARTS, max_effort=RATED)
CARRIED_IN = (0.0, 0.4, 0.2, 0.5)  # rad, in which the rated torques carry the arm of 75 kg
POSE = (0.0, 0.6, 0.3, 0.3)  # rad, of the arm without a wearer
SAFE_SPEED = 1.0  # rad/s
DRIVEN, ENERGY = 0.6, 0.3  # rad/s and J that motors may cause
AFTER_EXIT = 0.5  # s for which a joint that was dropped would turn
FIRST, SECOND = f"first{os.getpid()}", f"second{os.getpid()}"  # buses
ON_TWO = f"{FIRST},{FIRST},{SECOND},{SECOND}"  # motors 1 and 2 on the first bus, 3 and 4 on the second


class JudgedArm(Rig):
    """An arm whose motors are judged by its true motion. seen: rad/s, the largest speed that `look` has seen."""

    def forget(self) -> None:
        """Forget how the arm has moved so far."""
        super().forget()
        self.seen = 0.0

    def raise_to(self, pose: Sequence[float], over: float = 2.0, settle: float = 1.0) -> None:
        """Let the wearer bring the arm to a pose, leave it to the motors for `settle` s, and forget that."""
        super().raise_to(pose, over, settle)
        assert self.state is State.ACTIVE, self.safety.fault
        self.forget()

    @property
    def records(self) -> np.ndarray:
        """The true motion until now."""
        self.catch_up()
        return self.truth.records

    @property
    def fastest(self) -> float:
        """The largest true speed of a joint in rad/s."""
        return max(self.seen, float(np.abs(self.records["velocity"]).max(initial=0.0)))

    @property
    def motors_on(self) -> list[bool]:
        """Whether each motor is on."""
        return [motor.entered for motor in self.motors]

    def look(self) -> None:
        """Look at the present speed of the joints."""
        self.catch_up()
        self.seen = max(self.seen, *map(abs, self.device.arm.velocities))

    def assert_not_thrown(self, speed: float = DRIVEN, energy: float = ENERGY) -> None:
        """The motors caused less than `speed` rad/s and `energy` J."""
        caused = self.caused
        assert caused.speed < speed and caused.energy < energy, caused

    def assert_down(self) -> None:
        """The motors are off, and no joint turned fast, not even once nothing held it."""
        assert not self.device.powered
        self.clock.sleep(AFTER_EXIT)
        assert self.fastest < SAFE_SPEED and abs(self.device.arm.positions[1]) < 0.4

    def assert_let_down(self) -> None:
        """The loop lets the arm down."""
        assert self.run_until(lambda: self.loop.is_off), self.loop.failure or self.safety.fault
        self.assert_down()


@dataclass(frozen=True)
class ArmOnWires(ArmOnBus):
    """An arm whose buses are wires in virtual time, by the name of their channel."""

    wires: dict[str, Wire]

    def open(self, address: Address) -> can.BusABC:
        """Open one of them."""
        return self.wires[address[1]].open()


class CarriedArm(JudgedArm):
    """The paper's arm, hanging, and the bridge that carries it. settings: of the compensator, not as for Zero-G.

    joints, motors: as the parameters have them, and as they are. peak: (n,) Nm, `max_effort`.
    channel: of its bus, or those of its motors. bitrate: bit/s of a wire with arbitration; 0: frames take no time.
    echoes, is_fd: whether the bus returns each frame to its sender, and carries CAN FD.
    stiffness, play: of all joints, Nm/rad and rad; 0: rigid. The compensator knows the stiffness.
    friction: Nm of each joint. has_wearer: whether the arm of a 75 kg wearer is in the device, as the compensator is
    told. limits: those that are not as usual.

    on_bus, wires: how the bridge reaches it. notes: what the motors receive, as the bridge's watchdog reads it.
    """

    def __init__(
        self,
        joints: Sequence[JointMotor] = MOTORS_OF_ARM,
        motors: Sequence[SimulatedMotor] = (),
        peak: Sequence[float] = RATED,
        rate: float = RATE,
        channel: str = FIRST,
        bitrate: int = 0,
        echoes: bool = False,
        is_fd: bool = False,
        stiffness: float = 0.0,
        play: float = 0.0,
        friction: float = 0.1,
        has_wearer: bool = True,
        limits: dict[str, Any] | None = None,
        **settings: Any,
    ) -> None:
        mass, cog = Wearer(75.0).on_links(DEFAULT_LINKS.length)
        worn: dict[str, Any] = {"wearer_mass": mass, "wearer_cog": cog}
        elastic: dict[str, Any] = {"joint_stiffness": (stiffness,) * len(joints)}
        config = ArmConfig(
            coulomb_friction=(friction,) * len(joints),
            rotor_inertia=[joint.spec.rotor_inertia for joint in joints],
            backlash=(play,) * len(joints),
            **elastic,
            **(worn if has_wearer else {}),
        )
        device = SimulatedDevice(SimulatedArm(config), motors or [SimulatedMotor(joint) for joint in joints])
        device.is_fd = (is_fd,) * len(joints)
        given = {"mode": "zero_g", "support": 1.0, "max_effort": peak, "use_imu": False, **worn, **elastic, **settings}
        tolerance = tuple(joint.spec.home_tolerance for joint in joints)
        channels = channels_of(channel, len(joints))
        usual = {"max_effort": peak, "home_tolerance": tolerance, "channels": channels}
        kept = Limits(PARTS, **{**usual, **(limits or {})})
        wire = Wire(start=0.0, bitrate=bitrate, echoes=echoes)
        self.wires = {name: wire if name == channels[0] else Wire(wire.clock) for name in dict.fromkeys(channels)}
        self.on_bus = ArmOnWires(("wire", channel, {"fd": True} if is_fd else {}), joints, kept, 1.0 / rate, self.wires)
        self.notes = CommandNotes.from_buffer(bytearray(ctypes.sizeof(CommandNotes)))
        self.notes.clock = wire.clock
        played = None
        for name, end in self.wires.items():
            own = [joint for joint, of_joint in enumerate(channels) if of_joint == name]
            played = end.play(device, tick=None, joints=own, first=played)
        bus = MotorBus(self.on_bus.ports(wire.clock), joints, note=self.notes.note, clock=wire.clock)
        own_settings = Settings("right", DEFAULT_LINKS, **given)
        super().__init__(device, own_settings, joints, kept, rate, wire, bus=bus, played=played)

    def leave(self) -> CarriedArm:
        """Let the bridge die: its motors keep what it noted."""
        self.bus.close()
        return self


def usual_arm(
    pose: Sequence[float] = CARRIED_IN, rate: float = REAL_RATE, wire_format: WireFormat = MIT, **options: Any
) -> CarriedArm:
    """Return the arm on the usual motors, carried without a check of the signs, raised to `pose` rad."""
    arm = CarriedArm(joints_of((wire_format,) * 4), rate=rate, limits={"sign_check_torque": 0.0}, **options)
    arm.carry()
    arm.raise_to(pose, settle=0.5)
    return arm


def bare_arm(**options: Any) -> CarriedArm:
    """Return the arm without a wearer, raised to `POSE`, whose motion is only looked at until it is next forgotten."""
    arm = usual_arm(POSE, RATE, has_wearer=False, mode="one_g", **options)
    arm.device.truth = None  # every step of the physics takes longer than to carry the arm
    arm.clock.every(CYCLE, arm.look)
    return arm


raised_usual_arm, raised_arm = prepared(usual_arm), prepared(bare_arm)


class Responder:
    """Answers each frame on `wire` with those that `answer` returns, at once. received: all frames."""

    def __init__(self, wire: Wire, answer: Callable[[can.Message], list[can.Message]] = lambda message: []) -> None:
        self.received: list[can.Message] = []
        self._wire, self._answer = wire, answer
        wire.ends.append(self)

    def deliver(self, message: can.Message) -> None:
        """Receive a frame, and answer it."""
        self.received.append(message)
        for reply in self._answer(message):
            self._wire.carry(self, reply)


def motor_bus(wire: Wire, joints: Sequence[JointMotor]) -> MotorBus:
    """Return the bridge's end of a bus with all these motors."""
    return MotorBus([CanPort(wire.open(), wire.clock)] * len(joints), joints, clock=wire.clock)


def cut(duration: float, *joints: int) -> Callable[[Rig], None]:
    """Return the event that the motors of `joints`, by default of all, have no power for `duration` s."""

    def act(arm: Rig) -> None:
        for joint in joints or range(len(arm.motors)):
            ACTS["unplugged"](arm, joint, duration)

    return act


def lose_bus(arm: CarriedArm, name: str = FIRST) -> None:
    """Make a bus fail so that it cannot be reopened."""
    arm.wires[name].refusal = BusError("no such device")
    arm.wires[name].break_down(can.CanOperationError("No buffer space available"))


class SimulatedRig:
    """A simulated arm on a separate bus, in real time.

    interface: 'udp_multicast' to share it with processes. carrying: Nm that hold the arm where it is.
    """

    def __init__(self, device: SimulatedDevice, interface: str = "virtual") -> None:
        sys.setswitchinterval(2e-4)  # as in nodes/ros/run.py: with 5 ms the threads here would delay each other
        port = next(own_ports())
        channel, options = f"simulated_rig_{port}", {}
        if interface == "udp_multicast":
            channel, options = "239.74.163.2", {"port": port, "hop_limit": 0}
        self.device, self.carrying = device, [motor.torque(0.0, 0.0) for motor in device.motors]
        self.truth = device.truth = TruthRecords()
        self.arm = ArmOnBus((interface, channel, options), MOTORS_OF_ARM, LIMITS, 0.004)
        self._stop = threading.Event()
        self._bus = open_bus(*self.arm.address)
        self._thread = threading.Thread(target=device.run, args=(self._bus, self._stop.is_set))
        self._thread.start()

    @property
    def motors_on(self) -> list[bool]:
        """Whether each motor is on."""
        return [motor.entered for motor in self.device.motors]

    def assert_down(self) -> None:
        """The motors are off, and no joint turned fast, not even once nothing held it."""
        time.sleep(AFTER_EXIT)
        assert not self.device.powered
        assert np.abs(self.truth.records["velocity"]).max() < SAFE_SPEED

    def close(self) -> None:
        """Stop the device."""
        self._stop.set()
        self._thread.join()
        self._bus.shutdown()


class NoWatchdog:
    """In place of the watchdog of a bridge in this process, which a real one would kill on a busy machine."""

    alive, is_starting = True, False

    def __init__(self, *_: object) -> None:
        pass

    def hand_over(self, reason: str) -> bool:
        """Take nothing over."""
        return False

    def close(self) -> None:
        """Do nothing."""
