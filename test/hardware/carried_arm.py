# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Arms carried in virtual time, on motors that a test chooses: what these caused is the truth of the device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS, Compensation
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.inputs.arms import node_values, read_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS, SimulatedArm
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.events import ACTS
from exo_gravity.sim.motors.ak import SimulatedMotor
from exo_gravity.sim.params import device_of, simulator_table
from exo_gravity.sim.rig import Rig
from exo_gravity.sim.virtual_time import Wire

from ..support.active_wearer import Behaviour, attach
from ..support.copies import prepared
from ..support.simulated_device import joints_of

RATE = 125.0  # Hz
REAL_RATE = 250.0  # Hz, of config/exo.yaml: how far a joint moves until a loss is seen depends on it
POSE = [0.0, 0.5, 0.4, 0.6]  # rad
WORN_MASS, WORN_COG = Wearer(75.0).on_links(DEFAULT_LINKS.length)
DRIVEN, ENERGY = 0.6, 0.3  # rad/s and J that motors may cause
# While a motor has no power and it is not yet known, the others push on with the torque of the pose before.
UNKNOWN_LOSS = 1.9, 0.5  # rad/s and J
RATED, PEAK = (3.0, 9.0, 3.0, 3.0), (9.0, 18.0, 9.0, 9.0)  # Nm


class JudgedArm(Rig):
    """An arm whose motors are judged by its true motion."""

    def raise_to(self, pose: Sequence[float], over: float = 2.0, settle: float = 1.0) -> None:
        """Let the wearer bring the arm to a pose, leave it to the motors for `settle` s, and forget that."""
        super().raise_to(pose, over, settle)
        assert self.state is State.ACTIVE, self.safety.fault
        self.forget()

    def lead(self, hand: Behaviour) -> None:
        """Let a hand act on the arm from now on."""
        self.catch_up()
        attach(self.device, hand)

    @property
    def answer(self) -> Compensation:
        """The compensator's newest one."""
        return self.direct.answer

    @property
    def fastest(self) -> float:
        """The largest true speed of a joint in rad/s."""
        return float(np.abs(self.truth.records["velocity"]).max())

    @property
    def fastest_driven(self) -> float:
        """The largest true speed of a joint along its motor's torque in rad/s."""
        records = self.truth.records
        return float(np.abs(records["velocity"][records["velocity"] * records["torque"] > 0.0]).max(initial=0.0))

    @property
    def largest_step(self) -> float:
        """The largest change of a motor's torque within 2 ms, in Nm."""
        return float(np.abs(np.diff(self.truth.records["torque"][::2], axis=0)).max())

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


class CarriedArm(JudgedArm):
    """The arm of a 75 kg wearer, hanging, in Zero-G. settings: of the compensator, what differs from that.

    joints: the motors as the parameters have them.
    motors: as they are.
    peak: (n,) Nm, `max_effort`.
    remembered: Nm that another tool has left in the motors' memory.
    bitrate: bit/s of a wire with arbitration; 0: frames take no time.
    is_fd: whether frames are those of CAN FD.
    stiffness, play: of all joints, Nm/rad and rad; 0: rigid. The compensator knows the stiffness.
    rate: cycles of the loop per s.
    proves_signs: whether the start pushes each joint.
    friction: Nm of each joint.
    has_wearer: whether the wearer's arm is in the device; the compensator believes so.
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
        friction: float = 0.1,
        has_wearer: bool = True,
        **settings: Any,
    ) -> None:
        worn = {"wearer_mass": WORN_MASS, "wearer_cog": WORN_COG}
        elastic = {"joint_stiffness": (stiffness,) * len(joints)}
        config = ArmConfig(
            coulomb_friction=(friction,) * len(joints),
            rotor_inertia=[joint.spec.rotor_inertia for joint in joints],
            backlash=(play,) * len(joints),
            **elastic,
            **(worn if has_wearer else {}),
        )
        device = SimulatedDevice(SimulatedArm(config), motors)
        device.is_fd = (is_fd,) * len(joints)
        for joint in joints if remembered else ():
            for frame in (*joint.enter, (joint.command_id, joint.command(remembered, 0.0)), *joint.exit):
                device.exchange(*frame)
        given = {"mode": "zero_g", "support": 1.0, "max_effort": peak, "use_imu": False, **worn, **elastic, **settings}
        tolerance = tuple(joint.spec.home_tolerance for joint in joints)
        limits = Limits(JOINTS, max_effort=peak, home_tolerance=tolerance)
        if not proves_signs:
            limits = replace(limits, sign_check_torque=0.0)
        wire = Wire(start=0.0, bitrate=bitrate)
        super().__init__(device, Settings("right", DEFAULT_LINKS, **given), joints, limits, rate, wire)


def usual_arm(
    pose: Sequence[float] = (0.0, 0.4, 0.2, 0.5), peak: Sequence[float] = RATED, rate: float = REAL_RATE, **options: Any
) -> CarriedArm:
    """Return the arm on the usual motors, carried, raised to `pose` rad, in which the rated torques carry it."""
    joints = joints_of((MIT,) * 4)
    motors = [SimulatedMotor(joint) for joint in joints]
    arm = CarriedArm(joints, motors, peak, rate=rate, proves_signs=False, **options)
    arm.carry()
    arm.raise_to(pose, settle=0.5)
    return arm


raised_usual_arm = prepared(usual_arm)


class ShippedArm(JudgedArm):
    """The simulated arm of a file in config, without an IMU. kinds: of motors, by joint (0..), not as in the file."""

    def __init__(self, name: str, rate: float, kinds: dict[int, type[SimulatedMotor]] | None = None) -> None:
        nodes = load(packaged_config(f"{name}.yaml"))
        arm = read_arm(nodes, "/right")
        given = device_of(node_values(nodes, "/right/simulator", simulator_table(nodes["/right/simulator"])))
        kinds = kinds or {}
        motors = [kinds[n](motor.joint) if n in kinds else motor for n, motor in enumerate(given.motors)]
        settings = replace(arm.settings, use_imu=False)
        super().__init__(SimulatedDevice(given.arm, motors), settings, arm.motors, arm.limits, rate)


def assert_switched_on_and_off_without_a_collision(arm: CarriedArm) -> None:
    """An arm on a wire with a bit rate is switched on, held, and switched off."""
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state is State.PROVING and arm.safety.waiting_for == "", 5.0)
    arm.run(0.5)
    assert arm.device.powered
    assert arm.let_down(1.0)
    assert arm.wire.collisions == arm.wire.bus_offs == 0


def assert_held_and_let_down(arm: JudgedArm) -> None:
    """A raised arm stays where it is, and comes down gently."""
    arm.run(3.0)
    assert arm.caused.speed < 0.05
    assert arm.let_down()
    arm.assert_not_thrown()


def cut(duration: float, *joints: int) -> Callable[[JudgedArm], None]:
    """Return the event that the motors of `joints`, by default of all, have no power for `duration` s."""

    def act(arm: JudgedArm) -> None:
        for joint in joints or range(len(arm.motors)):
            ACTS["unplugged"](arm, joint, duration)

    return act


def stall(duration: float) -> Callable[[JudgedArm], None]:
    return lambda arm: arm.clock.stall(duration)


EVENTS = {
    "all motors restart in 20 ms": cut(0.02),
    "all motors restart in 80 ms": cut(0.08),
    "supply cut for 3 s": cut(3.0),
    "motor 2 restarts in 30 ms": cut(0.03, 1),
    "motor 2 loses its power for 1 s": cut(1.0, 1),
    "motor 1 loses its power for 1 s": cut(1.0, 0),
    **{f"loop stalls for {ms} ms": stall(ms / 1000.0) for ms in (20, 40, 60, 75, 120, 300)},
}
