# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm carried in virtual time, on motors that a test chooses: what they caused is the truth of the device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.controllers import DirectController
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS, SimulatedArm
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.judge import Driven, driven
from exo_gravity.sim.motors.ak import SimulatedMotor
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


class CarriedArm(DirectController, VirtualArm):
    """The arm of a 75 kg wearer, hanging, in Zero-G. truth: since it was last cleared.

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
        VirtualArm.__init__(self, device, self, joints, limits, rate, wire)
        self.truth = device.truth = TruthRecords()

    def carry(self) -> None:
        """Enable the hanging arm, and run until it is carried."""
        self.enable()
        assert self.run_until(lambda: self.safety.state in (State.ACTIVE, State.FAULT), 30.0), self.safety.waiting_for
        assert self.safety.state is State.ACTIVE, self.safety.fault

    def raise_to(self, pose: list[float]) -> None:
        """Let the wearer bring the arm to a pose, and leave it to the motors."""
        script = TrialScript.parse({"name": "raise", "steps": [{"move": pose, "over": 2.0}]})
        self.device.start(VirtualWearer(script))
        self.run(3.0)
        assert self.safety.state is State.ACTIVE, self.safety.fault
        self.truth = self.device.truth = TruthRecords()

    def see_out(self) -> None:
        """Run after an event until the arm is down, for 12 s at most; one that is carried 4 s later is carried on."""
        self.run(4.0)
        if self.safety.state is not State.ACTIVE:
            self.run_until(lambda: self.loop.is_off, 8.0)

    @property
    def caused(self) -> Driven:
        """What the motors caused."""
        return driven(self.truth.records)


def cut(joints: tuple[int, ...], duration: float) -> Callable[[CarriedArm], None]:
    def act(arm: CarriedArm) -> None:
        for joint in joints:
            arm.device.unplug(joint, duration)

    return act


def stall(duration: float) -> Callable[[CarriedArm], None]:
    return lambda arm: arm.clock.stall(duration)


EVENTS = {
    "all motors restart in 20 ms": cut((0, 1, 2, 3), 0.02),
    "all motors restart in 80 ms": cut((0, 1, 2, 3), 0.08),
    "supply cut for 3 s": cut((0, 1, 2, 3), 3.0),
    "motor 2 restarts in 30 ms": cut((1,), 0.03),
    "motor 2 loses its power for 1 s": cut((1,), 1.0),
    **{f"loop stalls for {ms} ms": stall(ms / 1000.0) for ms in (20, 40, 60, 75, 120)},
}
