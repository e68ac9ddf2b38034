# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The mechanics of the simulated arm: weight, friction, stops, a moving base, elastic joints."""

import math

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.arm.interface import NO_LOAD, STANDARD_GRAVITY
from exo_gravity.sim import STEP, ArmConfig, SimulatedArm, SimulatedDevice
from exo_gravity.sim.arm import in_base
from exo_gravity.sim.trunk_motion import TrunkState

from ..support.calibration_device import off_axis_of
from ..support.simulated_device import make_device

RAISED = (0.3, 0.8, 0.7, 0.6)  # rad

FRICTIONLESS = {"coulomb_friction": (0.0,) * 4, "viscous_friction": (0.0,) * 4}


def test_stribeck_friction_holds_at_standstill_and_is_gone_in_motion():
    config = {"coulomb_friction": (0.1,) * 4, "viscous_friction": (0.0,) * 4, "stribeck_friction": (0.2,) * 4}
    arm = SimulatedArm(ArmConfig(**config))
    arm.reset(RAISED)
    arm.move_base((0.0, 0.0, 0.0))
    assert moved(arm, (0.0, 0.0, 0.0, 0.2), 0.2) < 0.01
    arm.data.qvel[3] = 0.5
    moved(arm, (0.0, 0.0, 0.0, 0.2), 0.2)
    assert arm.velocities[3] > 0.6


def moved(arm, torque, duration, start=RAISED):
    """Return by how many degrees a joint has left `start` after so many s of `torque`."""
    for _ in range(round(duration / STEP)):
        arm.step(torque)
    return np.degrees(np.abs(np.subtract(arm.positions, start)).max())


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_static_torque_agrees_with_the_exact_law_in_any_pose_and_tilt_of_links_with_any_centre_of_gravity(side):
    random = np.random.default_rng(1)
    for number in range(30):
        length, mass = random.uniform(0.02, 0.4, 4), random.uniform(0.1, 2, 4)
        cog_y, cog_z = random.uniform(-0.015, 0.015, (2, 4)) * (number % 2)
        cog = random.uniform(0, 1, 4) * length
        arm = SimulatedArm(ArmConfig(ArmModel(length, cog, mass), cog_y=cog_y, cog_z=cog_z))
        direction = Tilt.of(side, *random.uniform(-np.pi, np.pi, 2)).direction
        theta = random.uniform(-np.pi, np.pi, 4)
        arm.move_base(np.multiply(STANDARD_GRAVITY, direction))
        arm.reset(theta)
        expected = ArmModel(length, cog, mass, off_axis=off_axis_of(mass, cog_y, cog_z))
        np.testing.assert_allclose(arm.data.qfrc_bias, gravity_torque(expected, theta, direction), atol=1e-12)
        arm.data.qvel[:] = 3.0  # a moving arm weighs no more
        np.testing.assert_allclose(arm.weight, gravity_torque(expected, theta, direction), atol=1e-12)


@pytest.mark.parametrize(
    ("imbalance", "friction", "least", "most"),
    [
        (0.0, {}, 0.0, 1e-6),
        (0.05, {}, 0.0, 0.01),
        (-0.05, {}, 0.0, 0.01),
        (-0.5, {}, 5.0, 360.0),
        (0.05, FRICTIONLESS, 5.0, 360.0),
    ],
)
def test_the_exact_torque_holds_the_arm_and_an_imbalance_beyond_friction_moves_it(imbalance, friction, least, most):
    arm = SimulatedArm(ArmConfig(**friction))
    arm.reset(RAISED)
    torque = gravity_torque(arm.config.links, RAISED) + imbalance
    assert least <= moved(arm, torque, 1.0 if least else 10.0) < most


@pytest.mark.parametrize("joint", range(4))
@pytest.mark.parametrize(("side", "way"), [("position_min", -1.0), ("position_max", 1.0)])
def test_joint_stops_hold_against_the_motors_peak_torque(joint, side, way):
    arm, chosen = SimulatedArm(), np.arange(4) == joint
    stop = getattr(arm.config, side)[joint]
    arm.move_base((0.0, 0.0, 0.0))
    arm.reset(np.where(chosen, stop, np.clip(np.zeros(4), arm.config.position_min, arm.config.position_max)))
    moved(arm, np.where(chosen, np.multiply(way, (9.0, 18.0, 9.0, 9.0)), 0.0), 1.0)
    assert abs(np.degrees(arm.positions[joint] - stop)) < 1.0


WORN = {"wearer_mass": (0.0, 0.0, 2.0, 1.7), "wearer_cog": (0.0, 0.0, 0.16, 0.2)}


@pytest.fixture(scope="module")
def on_trunk():
    """Inverse dynamics: the torque (4,) of the left arm on a trunk that slides, pitches about y and rolls about x.

    The world has the axes of the arm's base: the trunk's y, x and -z.
    """
    spec = ArmConfig(**FRICTIONLESS, **WORN).bodies(NO_LOAD)
    base = spec.worldbody.first_body()
    base.mass, base.inertia, base.explicitinertial = 1.0, (1.0, 1.0, 1.0), True
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    x, y, z = (0, 1, 0), (1, 0, 0), (0, 0, -1)
    for kind, axis in ((slide, x), (slide, y), (slide, z), (hinge, y), (hinge, x)):
        base.add_joint(type=kind, axis=axis)
    model = spec.compile()
    model.dof_armature[5:] = ArmConfig().rotor_inertia
    data = mujoco.MjData(model)
    model.opt.gravity[:] = 0, 0, STANDARD_GRAVITY

    def torque(state, theta, velocity, acceleration):
        data.qpos[:] = 0, 0, 0, state.pitch, state.roll, *theta
        data.qvel[:] = 0, 0, 0, state.pitch_rate, state.roll_rate, *velocity
        moving = Rotation.from_euler("xyz", (state.roll, state.pitch, 0.0)).apply(state.acceleration)
        data.qacc[:] = *moving, state.pitch_acceleration, state.roll_acceleration, *acceleration
        mujoco.mj_inverse(model, data)
        return data.qfrc_inverse[5:].copy()

    return torque


def accelerate(arm, state, theta, velocity, torque):
    """Return the joint accelerations (4,) of the simulated left arm under `torque`."""
    arm.reset(theta)
    arm.data.qvel[:] = velocity
    arm.move_base(*arm.config.felt("left", state))
    arm.step(torque)
    return arm.data.qacc.copy()


def test_an_arm_on_a_base_that_begins_moves_and_stops_accelerates_as_one_on_a_trunk_with_joints(on_trunk):
    rng, arm = np.random.default_rng(3), SimulatedArm(ArmConfig(**FRICTIONLESS, **WORN))
    for n in range(100):
        moving = TrunkState(*rng.uniform(-1.5, 1.5, 2), *rng.uniform(-4, 4, 4), tuple(rng.uniform(-10, 10, 3)))
        theta, velocity = rng.uniform((-1.5, 0, -0.5, 0), (1.5, 3, 2, 3)), rng.uniform(-4, 4, 4)
        torque = rng.uniform(-3, 3, 4)
        for state in (moving, TrunkState()) if n % 2 else (moving,):  # under the same torque
            acceleration = accelerate(arm, state, theta, velocity, torque)
            np.testing.assert_allclose(on_trunk(state, theta, velocity, acceleration), torque, atol=1e-8)


def test_the_right_arm_feels_the_mirror_image():
    assert in_base("right", (0.3, -0.5, 0.8), turning=True) == in_base("left", (-0.3, -0.5, -0.8))
    for side in ("left", "right"):
        pitch, roll = 0.4, -0.3
        down = math.sin(pitch), -math.sin(roll) * math.cos(pitch), -math.cos(roll) * math.cos(pitch)
        np.testing.assert_allclose(in_base(side, down), Tilt.of(side, pitch, roll).direction, atol=1e-12)


STUCK = {"coulomb_friction": (10.0,) * 4, "viscous_friction": (0.0,) * 4}


def test_one_elastic_joint_leaves_the_others_rigid_and_a_motor_reports_its_own_angle() -> None:
    config = ArmConfig(joint_stiffness=(0.0, 0.0, 150.0, 0.0), **STUCK)
    device: SimulatedDevice = make_device(config=config)
    device.arm.reset(RAISED)
    device.advance(0.5)
    sag = np.subtract(device.arm.motor_positions, device.arm.positions)
    assert sag[2] > 0.005
    assert not np.any(np.delete(sag, 2))
