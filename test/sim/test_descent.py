# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The way down, judged by the simulated arm's true motion: slow, to the ground in time, and no drop at the end."""

from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core import Tilt, gravity_torque
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.core.motors.joint_motor import UNKNOWN, JointMotor
from exo_gravity.core.safety.drive import NO_EFFORTS, Send, State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor

from ..support.thorough import quick

MOTORS_OF_ARM = [JointMotor(MOTORS[name], n) for n, name in enumerate(("AK60-6", "AK80-9", "AK60-6", "AK60-6"), 1)]
LIMITS = Limits(("rotation", "abduction", "flexion", "elbow"))
RATE = 125.0
TOP_SPEED = 1.0  # rad/s
HORIZONTAL = (0.0, 1.5, 0.0, 0.3)
POSES = [HORIZONTAL, (0.0, 0.8, 0.6, 0.5), (0.0, 0.6, 0.9, 1.5), (1.5, 1.5, -0.7, 2.5), (0.0, 0.1, 2.3, 0.1)]


class Lowered:
    """An arm that its motors hold at `theta` until a fault lets it down. The speed is the arm's own, once a cycle.

    grounded: s until the joints that gravity moves stayed within 0.2 rad of where they ended. switched_off: s.
    top_speed, speed_after_exit: rad/s, the latter over the 3 s after EXIT. switched_on_again: whether a motor was taken
    for one that is off.
    """

    def __init__(self, theta, friction, body_mass=0.0, pitch=0.0, roll=0.0, motors=MOTORS_OF_ARM):
        self.motors = motors
        mass, cog = Wearer(body_mass).on_links((0.05, 0.13, 0.3, 0.3)) if body_mass else ((0.0,) * 4, (0.0,) * 4)
        config = ArmConfig(
            wearer_mass=mass, wearer_cog=cog, coulomb_friction=(friction,) * 4, viscous_friction=(0.0,) * 4
        )
        self.arm = SimulatedArm(config)
        self.device = SimulatedDevice(self.arm, [SimulatedMotor(motor) for motor in self.motors])
        self.device.pitch, self.device.roll = pitch, roll
        self.device.advance(0.001)
        self.arm.reset(theta)
        links = config.links.with_wearer(mass, cog)
        self.holding = gravity_torque(links, theta, Tilt.of("right", pitch, roll).direction)
        self.machine = SafetyMachine(LIMITS, 1.0 / RATE, self.motors)
        self.top_speed = self.speed_after_exit = 0.0
        self.switched_on_again = False
        self._samples = [UNKNOWN] * 4
        self._track = []
        self._now = 0.0
        self._lower()

    def _lower(self):
        for motor, effort in zip(self.motors, self.holding, strict=True):
            self.device.exchange(motor.can_id, motor.command(effort, 0.0))
            self._take(motor, self.device.exchange(motor.can_id, ENTER))
        self.machine.take_over(self.holding.tolist(), (0.0,) * 4, 0.0)
        while self._now < 60.0:
            drive = self.machine.step(self._now, tuple(self._samples), NO_EFFORTS)
            if self.machine.is_off:
                break
            self.switched_on_again = self.switched_on_again or Send.ENTER in drive.send
            for motor, effort, damping, send in zip(self.motors, *drive[:3], strict=True):
                data = EXIT if send is Send.EXIT else motor.command(effort, damping)
                self._take(motor, self.device.exchange(motor.can_id, data))
            self.top_speed = max(self.top_speed, self._advance(1.0 / RATE))
            self._track.append((self._now, *self.arm.positions))
        assert not self.device.powered
        self.switched_off = self._now
        track = np.array(self._track)[:, 2:]  # joint 1 turns about the vertical: it has no ground
        far = np.flatnonzero(np.abs(track - np.array(self.arm.positions[1:])).max(axis=1) > 0.2)
        self.grounded = self._track[far[-1]][0] if len(far) else 0.0
        self.speed_after_exit = self._advance(3.0)

    def _take(self, motor, reply):
        self._samples[motor.can_id - 1] = motor.sample(reply[1], self._now)

    def _advance(self, duration):
        fastest = 0.0
        for _ in range(round(duration * RATE)):
            self.device.advance(1.0 / RATE)
            fastest = max(fastest, *map(abs, self.arm.velocities))
        self._now += duration
        return fastest


WORN = [(0.01, 0.0), (0.5, 0.0), (0.05, 75.0)]


@pytest.mark.parametrize(("friction", "body_mass"), quick([WORN[0], WORN[2]], WORN))
def test_a_horizontal_arm_comes_down_slowly_in_15_s_and_does_not_drop_when_its_motors_are_switched_off(
    friction, body_mass
):
    lowered = Lowered(HORIZONTAL, friction, body_mass)
    assert lowered.top_speed < TOP_SPEED
    assert lowered.speed_after_exit < TOP_SPEED / 4
    assert lowered.grounded < 15.0
    assert lowered.machine.state is State.DISABLED


OTHERS = [(POSES[3], 0.4, -0.3, 0.01), (POSES[4], 0.0, 0.0, 0.2)]


@pytest.mark.parametrize(("theta", "pitch", "roll", "friction"), quick(OTHERS[:1], OTHERS))
def test_from_other_poses_and_on_a_tilted_trunk_it_comes_down_as_slowly(theta, pitch, roll, friction):
    lowered = Lowered(theta, friction, pitch=pitch, roll=roll)
    assert lowered.top_speed < TOP_SPEED
    assert lowered.speed_after_exit < TOP_SPEED / 4


def test_a_passive_arm_of_75_kg_comes_down_as_slowly_where_the_motors_can_hold_it():
    lowered = Lowered(POSES[2], 0.05, 75.0)
    assert np.all(np.abs(lowered.holding) <= [motor.peak_effort for motor in MOTORS_OF_ARM])
    assert lowered.top_speed < TOP_SPEED
    assert lowered.speed_after_exit < TOP_SPEED / 4


def test_an_arm_upright_overhead_is_not_left_to_fall():
    lowered = Lowered((0.0, 3.0, 0.0, 0.0), 0.0)
    assert lowered.top_speed < TOP_SPEED
    assert lowered.speed_after_exit < TOP_SPEED / 4
    assert abs(lowered.arm.positions[1]) < 0.2


def test_motors_that_apply_less_damping_than_asked_for_are_not_taken_for_motors_that_are_off():
    weak = [replace(motor, torque_scale=0.6) for motor in MOTORS_OF_ARM]  # kd_max is then 3 Nm s/rad at the joint
    lowered = Lowered(HORIZONTAL, 0.2, motors=weak)
    assert lowered.machine.fault is None and not lowered.switched_on_again
    assert lowered.top_speed < TOP_SPEED
