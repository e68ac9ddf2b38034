# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Arms carried in virtual time, on motors that a test chooses: what these caused is the truth of the device."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.inputs.arms import carried_arm, node_values
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS, SimulatedArm
from exo_gravity.sim.controllers import DirectController
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.judge import Driven, driven
from exo_gravity.sim.motors.ak import SimulatedMotor
from exo_gravity.sim.params import device_of, simulator_table
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.truth import TruthRecords
from exo_gravity.sim.virtual_arm import VirtualArm
from exo_gravity.sim.virtual_time import Wire
from exo_gravity.sim.virtual_wearer import VirtualWearer

RATE = 125.0  # Hz
REAL_RATE = 250.0  # Hz, of config/exo.yaml: how far a joint moves until a loss is seen depends on it
POSE = [0.0, 0.5, 0.4, 0.6]  # rad
WORN_MASS, WORN_COG = Wearer(75.0).on_links(DEFAULT_LINKS.length)
DRIVEN, ENERGY = 0.6, 0.3  # rad/s and J that motors may cause
# While a motor has no power and it is not yet known, the others push on with the torque of the pose before.
UNKNOWN_LOSS = 1.9, 0.5  # rad/s and J


class JudgedArm(VirtualArm):
    """An arm whose motors are judged by its true motion. truth: since it was last forgotten."""

    def __init__(self, device: SimulatedDevice, *args: Any, **options: Any) -> None:
        super().__init__(device, *args, **options)
        self.forget()

    def forget(self) -> None:
        """Forget what the motors did so far."""
        self.truth = self.device.truth = TruthRecords()

    def carry(self) -> None:
        """Enable the hanging arm, and run until it is carried."""
        self.enable()
        assert self.run_until(lambda: self.safety.state in (State.ACTIVE, State.FAULT), 90.0), self.safety.waiting_for
        assert self.safety.state is State.ACTIVE, self.safety.fault

    def raise_to(self, pose: Sequence[float], over: float = 2.0, hold: float = 1.0) -> None:
        """Let the wearer bring the arm to a pose in `over` s, and leave it to the motors for `hold` s."""
        script = TrialScript.parse({"name": "raise", "steps": [{"move": list(pose), "over": over}]})
        self.device.start(VirtualWearer(script))
        self.run(over + hold)
        assert self.safety.state is State.ACTIVE, self.safety.fault
        self.forget()

    def let_down(self) -> None:
        """Let the arm down until its motors are off."""
        self.safety.disable(self.now)
        assert self.run_until(lambda: self.loop.is_off, 60.0)
        assert not self.device.powered

    @property
    def caused(self) -> Driven:
        """What the motors caused."""
        return driven(self.truth.records, [motor.joint.spec for motor in self.device.motors])

    @property
    def fastest(self) -> float:
        """The largest true speed of a joint in rad/s."""
        return float(np.abs(self.truth.records["velocity"]).max())

    def assert_not_thrown(self, speed: float = DRIVEN, energy: float = ENERGY) -> None:
        """The motors caused less than `speed` rad/s and `energy` J."""
        caused = self.caused
        assert caused.speed < speed and caused.energy < energy, caused

    def go_through(self, event: Callable[[JudgedArm], None], is_loss: bool) -> None:
        """Run through `event` until the arm is down, or carried on 4 s later: it is not thrown.

        is_loss: whether motors lose their power, which is not known at once.
        """
        event(self)
        self.run(4.0)
        if self.safety.state is not State.ACTIVE:
            self.run_until(lambda: self.loop.is_off, 11.0)
        self.assert_not_thrown(*(UNKNOWN_LOSS if is_loss else (DRIVEN, ENERGY)))


class CarriedArm(DirectController, JudgedArm):
    """The arm of a 75 kg wearer, hanging, in Zero-G.

    joints: the motors as the parameters have them.
    motors: as they are.
    peak: (n,) Nm, `max_effort`.
    remembered: Nm that another tool has left in the motors' memory.
    bitrate: bit/s of a wire with arbitration; 0: frames take no time.
    is_fd: whether frames are those of CAN FD.
    stiffness, play: of all joints, Nm/rad and rad; 0: rigid. The compensator knows the stiffness.
    rate: cycles of the loop per s.
    proves_signs: whether the start pushes each joint.
    """

    def __init__(
        self,
        joints: Sequence[JointMotor],
        motors: Sequence[SimulatedMotor],
        peak: Sequence[float],
        remembered: float = 0.0,
        bitrate: int = 0,
        is_fd: bool = False,
        stiffness: float = 0.0,
        play: float = 0.0,
        rate: float = RATE,
        proves_signs: bool = True,
    ) -> None:
        config = ArmConfig(
            wearer_mass=WORN_MASS,
            wearer_cog=WORN_COG,
            coulomb_friction=(0.1,) * len(joints),
            rotor_inertia=[joint.spec.rotor_inertia for joint in joints],
            joint_stiffness=(stiffness,) * len(joints),
            backlash=(play,) * len(joints),
        )
        device = SimulatedDevice(SimulatedArm(config), motors)
        device.is_fd = (is_fd,) * len(joints)
        for joint in joints if remembered else ():
            for frame in (*joint.enter, (joint.command_id, joint.command(remembered, 0.0)), *joint.exit):
                device.exchange(*frame)
        settings = Settings("right", DEFAULT_LINKS, mode="zero_g", support=1.0, max_effort=peak, use_imu=False,
                            wearer_mass=WORN_MASS, wearer_cog=WORN_COG,
                            joint_stiffness=(stiffness,) * len(joints))  # fmt: skip
        tolerance = tuple(joint.spec.home_tolerance for joint in joints)
        limits = Limits(JOINTS, max_effort=peak, home_tolerance=tolerance)
        if not proves_signs:
            limits = replace(limits, sign_check_torque=0.0)
        DirectController.__init__(self, Compensator(settings, JOINTS), limits)
        wire = Wire(start=0.0, bitrate=bitrate)
        JudgedArm.__init__(self, device, self, joints, limits, rate, wire)


class ShippedArm(JudgedArm):
    """The simulated arm of a file in config, without an IMU. kinds: of motors, by joint (0..), not as in the file."""

    def __init__(
        self, name: str, rate: float, kinds: Mapping[int, type[SimulatedMotor]] = MappingProxyType({})
    ) -> None:
        nodes = load(packaged_config(f"{name}.yaml"))
        arm = carried_arm(nodes, "/right")
        given = device_of(node_values(nodes, "/right/simulator", simulator_table(nodes["/right/simulator"])))
        motors = [kinds[n](motor.joint) if n in kinds else motor for n, motor in enumerate(given.motors)]
        settings = replace(arm.settings, use_imu=False)
        controller = DirectController(Compensator(settings, arm.limits.joint_names), arm.limits)
        super().__init__(SimulatedDevice(given.arm, motors), controller, arm.motors, arm.limits, rate)


def assert_switched_on_and_off_without_a_collision(arm: CarriedArm) -> None:
    """An arm on a wire with a bit rate is switched on, held, and switched off."""
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state is State.PROVING and arm.safety.waiting_for == "", 5.0)
    arm.run(0.5)
    assert arm.device.powered
    arm.safety.disable(arm.now)
    assert arm.run_until(lambda: arm.loop.is_off, 1.0)
    assert not arm.device.powered
    assert arm.wire.collisions == arm.wire.bus_offs == 0


def assert_held_and_let_down(arm: JudgedArm) -> None:
    """A raised arm stays where it is, and comes down gently."""
    arm.run(3.0)
    assert arm.caused.speed < 0.05
    arm.let_down()
    arm.assert_not_thrown()


def cut(duration: float, *joints: int) -> Callable[[JudgedArm], None]:
    """Return the event that the motors of `joints`, by default of all, have no power for `duration` s."""

    def act(arm: JudgedArm) -> None:
        for joint in joints or range(len(arm.device.motors)):
            arm.device.unplug(joint, duration)

    return act


def stall(duration: float) -> Callable[[JudgedArm], None]:
    return lambda arm: arm.clock.stall(duration)


EVENTS = {
    "all motors restart in 20 ms": cut(0.02),
    "all motors restart in 80 ms": cut(0.08),
    "supply cut for 3 s": cut(3.0),
    "motor 2 restarts in 30 ms": cut(0.03, 1),
    "motor 2 loses its power for 1 s": cut(1.0, 1),
    **{f"loop stalls for {ms} ms": stall(ms / 1000.0) for ms in (20, 40, 60, 75, 120)},
}
