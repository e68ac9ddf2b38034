"""Late efforts, in virtual time: the arm is carried on under rising damping, judged by the arm's true motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from exo_gravity.core.model.gravity import gravity_torque
from exo_gravity.core.model.wearer import Wearer
from exo_gravity.core.motors.joint_motor import peaks_of
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.control_loop import NO_COMMAND, ControlLoop, EffortCommand
from exo_gravity.sim import ArmConfig, VirtualWearer
from exo_gravity.sim.arm import DEFAULT_LINKS

from ..support.simulated_device import make_device
from .simulated_rig import LIMITS, MOTORS_OF_ARM
from .virtual_time import Wire

CYCLE = 0.004  # s
MASS, COG = Wearer(75.0).on_links(DEFAULT_LINKS.length)
RAISED, ZERO_G = (0.0, 1.3, 0.0, 0.3), (0.3, 0.45, 0.10, 0.4)  # rad
SPEED = 0.6  # rad/s
STEP = 0.35  # Nm within 2 ms: a frame may change the torque by 0.2, and the hand moves the damped joint


class RidingArm:
    """A simulated arm that the loop carries in `pose` by the efforts that gravity takes; `gap` makes them late.

    records: of each step of the device since the start: angle, speed and Nm of the motors, (4,) each.
    """

    def __init__(self, pose: Sequence[float] = RAISED, wearer: bool = False) -> None:
        passive = {"wearer_mass": MASS, "wearer_cog": COG} if wearer else {}
        self.device = make_device(config=ArmConfig(coulomb_friction=(0.1,) * 4, **passive))
        self.links = DEFAULT_LINKS.with_wearer(MASS, COG) if wearer else DEFAULT_LINKS
        self.wire = Wire()
        self.clock = self.wire.clock
        self.is_late = False
        self.is_withdrawn = False
        self.is_held = False
        self.records: list[tuple[list[float], ...]] = []
        self.wire.play(self.device, self._look)
        limits = replace(LIMITS, sign_check_torque=0.0, max_velocity=(6.0,) * 4)
        self.safety = SafetyMachine(limits, CYCLE, peaks_of(MOTORS_OF_ARM))
        bus = MotorBus(self.wire.open(), MOTORS_OF_ARM, clock=self.clock, reopen=self.wire.open)
        self.loop = ControlLoop(bus, self.safety, CYCLE, get_efforts=self._efforts)
        self._command = NO_COMMAND
        self.safety.enable(self.clock.monotonic())
        self.run(2.6)
        self.move(pose, 2.0)
        self.run(2.5)
        assert self.safety.state is State.ACTIVE, self.safety.fault
        assert np.abs(np.subtract(self.device.arm.positions, pose)).max() < 0.1
        self.records.clear()

    def move(self, pose: Sequence[float], duration: float) -> None:
        """Let the wearer's hand move the arm."""
        steps = [{"move": list(pose), "over": duration}]
        self.device.start(VirtualWearer(TrialScript.parse({"name": "move", "steps": steps})))

    def run(self, duration: float) -> None:
        end = self.clock.monotonic() + duration
        while self.clock.monotonic() < end:
            self.loop.cycle()

    def run_while(self, state: State) -> None:
        while self.safety.state is state:
            self.loop.cycle()

    def gap(self, duration: float) -> None:
        self.is_late = True
        self.run(duration)
        self.is_late = False

    def _efforts(self, latest: float) -> EffortCommand:
        samples = self.loop.samples
        if not self.is_late and min(joint.time for joint in samples) > 0.0:
            effort = tuple(gravity_torque(self.links, [joint.position for joint in samples]))
            self._command = EffortCommand(effort, min(joint.time for joint in samples), held=self.is_held)
        return self._command._replace(effort=None) if self.is_withdrawn else self._command

    def _look(self) -> None:
        arm = self.device.arm
        position, velocity = arm.positions, arm.velocities
        joints = zip(self.device.motors, position, velocity, strict=True)
        torque = [motor.torque(angle, speed) for motor, angle, speed in joints]
        self.records.append((position, velocity, torque))

    @property
    def top_speed(self) -> float:
        return float(np.abs([velocity for _, velocity, _ in self.records]).max())

    @property
    def largest_step(self) -> float:
        """Nm of a motor between two looks, 2 ms."""
        return float(np.abs(np.diff([torque for *_, torque in self.records], axis=0)).max())

    @property
    def felt(self) -> float:
        """The largest torque beyond what gravity takes, in Nm."""
        positions, _, torques = map(np.array, zip(*self.records, strict=True))
        return float(np.abs(torques - gravity_torque(self.links, positions)).max())


def test_a_gap_while_the_arm_is_held_moves_nothing_and_one_too_long_lets_it_down_and_one_press_carries_it_on():
    arm = RidingArm(pose=ZERO_G, wearer=True)
    arm.gap(0.15)
    arm.run(0.3)
    assert arm.safety.state is State.ACTIVE and arm.safety.ride.rides == 1
    assert arm.top_speed < 0.02 and arm.felt < 0.05 and arm.largest_step < 0.05
    arm.gap(0.25)
    assert (arm.safety.state, arm.safety.fault.code) == (State.LETTING_DOWN, FaultCode.COMMAND_STALE)
    arm.run_while(State.LETTING_DOWN)
    assert arm.safety.state is State.FAULT
    assert arm.top_speed < SPEED
    arm.records.clear()
    assert arm.safety.resume(arm.clock.monotonic())
    arm.run(2.4)
    assert arm.safety.state is State.ACTIVE
    assert arm.top_speed < SPEED and arm.largest_step < STEP


def test_a_wearer_who_moves_is_slowed_gently_while_efforts_are_late():
    arm = RidingArm()
    position = arm.device.arm.positions
    arm.move(np.add(position, (0.0, -0.5, 0.0, 0.5)).tolist(), 1.25)
    arm.run(0.45)
    assert max(map(abs, arm.device.arm.velocities)) > 0.9
    arm.records.clear()
    arm.gap(0.1)
    arm.run(0.4)
    assert arm.safety.state is State.ACTIVE and arm.safety.ride.rides == 1
    assert arm.top_speed < 1.1 and arm.felt < 1.8 and arm.largest_step < STEP


def test_efforts_of_a_late_tilt_are_damped_at_once_and_withdrawn_ones_let_the_arm_down_at_once():
    arm = RidingArm()
    arm.is_held = True
    arm.run(2 * CYCLE)
    assert arm.safety.state is State.ACTIVE
    assert all(motor.damping > 0.0 for motor in arm.device.motors)
    arm.is_held = False
    arm.run(0.5)
    assert not any(motor.damping for motor in arm.device.motors)
    arm.is_withdrawn = True
    arm.run(2 * CYCLE)
    assert arm.safety.state is State.LETTING_DOWN
    assert all(motor.damping > 0.0 for motor in arm.device.motors)


def test_a_bus_that_is_silent_for_a_moment_lets_the_arm_down_and_one_press_carries_it_on():
    arm = RidingArm()
    arm.device.bus_silent = True
    arm.run(0.08)
    arm.device.bus_silent = False
    arm.run(0.1)
    assert (arm.safety.state, arm.safety.fault.code) == (State.LETTING_DOWN, FaultCode.MOTOR_SILENT)
    arm.run_while(State.LETTING_DOWN)
    assert arm.safety.resume(arm.clock.monotonic()), arm.safety.why_not_resumed
    arm.run(2.4)
    assert arm.safety.state is State.ACTIVE
    assert arm.top_speed < SPEED


def test_a_loop_that_stood_still_for_longer_than_the_time_out_carries_on():
    arm = RidingArm()
    for _ in range(10):
        arm.clock.stall(0.06)
        arm.run(0.3)
    assert arm.safety.state is State.ACTIVE
    assert arm.top_speed < 0.02
