# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arm on a moving base, against MuJoCo's inverse dynamics of the same arm on a trunk that has joints."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.sim import ArmConfig, SimulatedArm
from exo_gravity.sim.arm import _mjcf, felt_in_base, in_base
from exo_gravity.sim.trunk_motion import TrunkState

from ..support.trunk import orientation

G = 9.80665
FRICTIONLESS = {"coulomb_friction": (0.0,) * 4, "viscous_friction": (0.0,) * 4}
WORN = {"wearer_mass": (0.0, 0.0, 2.0, 1.7), "wearer_cog": (0.0, 0.0, 0.16, 0.2)}
# The trunk slides along the world's axes, pitches about y and rolls about x; the left arm's base is fixed to it.
TRUNK = """
<worldbody><body>
  <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>
  <joint axis="0 1 0"/><joint axis="1 0 0"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
  <body xyaxes="0 1 0 1 0 0">"""


@pytest.fixture(scope="module")
def on_trunk():
    """Inverse dynamics: the arm's torque (4,) on a trunk that moves like this."""
    xml = _mjcf(ArmConfig(**FRICTIONLESS, **WORN))  # the trunk goes around the arm, and MuJoCo joins no two models
    xml = xml.replace("<worldbody>", TRUNK).replace("</worldbody>", "</body></body></worldbody>")
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    model.opt.gravity[:] = 0, 0, -G

    def torque(state, theta, velocity, acceleration):
        data.qpos[:] = 0, 0, 0, state.pitch, state.roll, *theta
        data.qvel[:] = 0, 0, 0, state.pitch_rate, state.roll_rate, *velocity
        moving = orientation(state) @ state.acceleration
        data.qacc[:] = *moving, state.pitch_acceleration, state.roll_acceleration, *acceleration
        mujoco.mj_inverse(model, data)
        return data.qfrc_inverse[5:].copy()

    return torque


def random_state(rng):
    return TrunkState(*rng.uniform(-1.5, 1.5, 2), *rng.uniform(-4, 4, 4), tuple(rng.uniform(-10, 10, 3)))


def accelerate(arm, state, theta, velocity, torque):
    """Return the joint accelerations (4,) of the simulated left arm under `torque`."""
    arm.reset(theta)
    arm.data.qvel[:] = velocity
    arm.move_base(*felt_in_base("left", state, G))
    arm.step(torque)
    return arm.data.qacc.copy()


def test_an_arm_on_a_moving_base_accelerates_as_one_on_a_trunk_with_joints(on_trunk):
    rng, arm = np.random.default_rng(3), SimulatedArm(ArmConfig(**FRICTIONLESS, **WORN))
    for _ in range(100):
        state, torque = random_state(rng), rng.uniform(-3, 3, 4)
        theta, velocity = rng.uniform((-1.5, 0, -0.5, 0), (1.5, 3, 2, 3)), rng.uniform(-4, 4, 4)
        acceleration = accelerate(arm, state, theta, velocity, torque)
        np.testing.assert_allclose(on_trunk(state, theta, velocity, acceleration), torque, atol=1e-8)


def test_a_base_that_stops_turning_leaves_no_forces_behind(on_trunk):
    arm = SimulatedArm(ArmConfig(**FRICTIONLESS, **WORN))
    moving = TrunkState(pitch_rate=2.0, roll_acceleration=5.0, acceleration=(1.0, 2.0, 3.0))
    theta, still = (0.3, 0.8, 0.7, 0.6), (0.0,) * 4
    accelerate(arm, moving, theta, still, still)
    acceleration = accelerate(arm, TrunkState(), theta, still, still)
    np.testing.assert_allclose(on_trunk(TrunkState(), theta, still, acceleration), still, atol=1e-8)


def test_the_right_arm_feels_the_mirror_image():
    x, y, z = 0.3, -0.5, 0.8
    assert in_base("right", (x, y, z)) == in_base("left", (x, -y, z))
    assert in_base("right", (x, y, z), turning=True) == in_base("left", (-x, y, -z))
    for side in ("left", "right"):
        pitch, roll = 0.4, -0.3
        down = math.sin(pitch), -math.sin(roll) * math.cos(pitch), -math.cos(roll) * math.cos(pitch)
        np.testing.assert_allclose(in_base(side, down), Tilt.of(side, pitch, roll).direction, atol=1e-12)
