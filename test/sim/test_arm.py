# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The mechanics of the simulated arm, against the exact law and the energy balance."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.arm.arm_data import STANDARD_GRAVITY
from exo_gravity.core.errors import ParameterError
from exo_gravity.sim import STEP, ArmConfig, SimulatedArm

from ..support.calibration_device import off_axis_of

UPRIGHT = (0.0, 0.0, 1.0)
RAISED = (0.3, 0.8, 0.7, 0.6)  # rad
FRICTIONLESS = {"coulomb_friction": (0.0,) * 4, "viscous_friction": (0.0,) * 4}


def simulate(arm, torque, duration):
    for _ in range(round(duration / STEP)):
        arm.step(torque)


def moved(arm, start):
    """Return the largest angle in degrees by which a joint has left `start`."""
    return np.degrees(np.abs(np.subtract(arm.positions, start)).max())


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_static_torque_agrees_with_the_exact_law_in_any_pose_and_tilt(side):
    random = np.random.default_rng(1)
    for _ in range(100):
        length = random.uniform(0.02, 0.4, 4)
        links = ArmModel(length, random.uniform(0, 1, 4) * length, random.uniform(0.1, 2, 4))
        arm = SimulatedArm(ArmConfig(links))
        direction = Tilt.of(side, *random.uniform(-np.pi, np.pi, 2)).direction
        theta = random.uniform(-np.pi, np.pi, 4)
        arm.move_base(np.multiply(STANDARD_GRAVITY, direction))
        arm.reset(theta)
        np.testing.assert_allclose(arm.data.qfrc_bias, gravity_torque(links, theta, direction), atol=1e-12)
        arm.data.qvel[:] = 3.0  # a moving arm weighs no more
        np.testing.assert_allclose(arm.weight, arm.data.qfrc_bias, atol=1e-12)


def test_centres_of_gravity_off_the_links_axes_add_the_torques_of_their_moments():
    rng = np.random.default_rng(2)
    links = SimulatedArm().config.links
    for _ in range(20):
        cog_y, cog_z = rng.uniform(-0.015, 0.015, (2, 4))
        arm = SimulatedArm(ArmConfig(links, cog_y=cog_y, cog_z=cog_z))
        theta, direction = rng.uniform(-3.0, 3.0, 4), Tilt.of("right", *rng.uniform(-1.0, 1.0, 2)).direction
        arm.move_base(np.multiply(STANDARD_GRAVITY, direction))
        arm.reset(theta)
        expected = ArmModel(links.length, links.cog, links.mass, off_axis=off_axis_of(links.mass, cog_y, cog_z))
        np.testing.assert_allclose(arm.data.qfrc_bias, gravity_torque(expected, theta, direction), atol=1e-12)


def test_stribeck_friction_holds_at_standstill_and_is_gone_in_motion():
    config = {"coulomb_friction": (0.1,) * 4, "viscous_friction": (0.0,) * 4, "stribeck_friction": (0.2,) * 4}
    push = np.array((0.0, 0.0, 0.0, 0.2))
    arms = SimulatedArm(ArmConfig(**config)), SimulatedArm(ArmConfig(**config))
    for arm, speed in zip(arms, (0.0, 0.5), strict=True):
        arm.reset(RAISED)
        arm.move_base((0.0, 0.0, 0.0))
        arm.data.qvel[3] = speed
        simulate(arm, push, 0.2)
    assert moved(arms[0], RAISED) < 0.01
    assert arms[1].velocities[3] > 0.6


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
    simulate(arm, gravity_torque(arm.config.links, RAISED) + imbalance, 1.0 if least else 10.0)
    assert least <= moved(arm, RAISED) < most


def test_a_frictionless_fall_conserves_energy():
    arm = SimulatedArm(ArmConfig(**FRICTIONLESS))
    arm.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    arm.reset((0.0, 0.3, 0.8, 0.6))
    start = arm.data.energy.sum()
    simulate(arm, (0.0,) * 4, 0.25)
    potential, kinetic = arm.data.energy
    assert kinetic > 0.5
    assert potential + kinetic == pytest.approx(start, abs=0.01 * kinetic)


@pytest.mark.parametrize("rotor", [0.0, 0.01])
def test_the_elbow_has_the_inertia_of_its_tube_and_of_the_rotor(rotor):
    arm = SimulatedArm(ArmConfig(rotor_inertia=(0.0, 0.0, 0.0, rotor)))
    column = np.zeros(4)
    mujoco.mj_mulM(arm.model, arm.data, column, np.array((0.0, 0.0, 0.0, 1.0)))
    links, radius = arm.config.links, 0.03
    length, mass, cog = links.length[3], links.mass[3], links.cog[3]
    assert column[3] == pytest.approx(mass * (length**2 / 12 + radius**2 / 2 + cog**2) + rotor)


@pytest.mark.parametrize("joint", range(4))
@pytest.mark.parametrize("side", ["position_min", "position_max"])
def test_joint_stops_hold_against_the_motors_peak_torque(joint, side):
    arm = SimulatedArm()
    stop = getattr(arm.config, side)[joint]
    theta = np.clip(np.zeros(4), arm.config.position_min, arm.config.position_max)
    theta[joint] = stop
    arm.move_base((0.0, 0.0, 0.0))
    arm.reset(theta)
    torque = np.zeros(4)
    torque[joint] = (9.0, 18.0, 9.0, 9.0)[joint] * (-1 if side == "position_min" else 1)
    simulate(arm, torque, 1.0)
    assert abs(np.degrees(arm.positions[joint] - stop)) < 1.0


def test_reset_puts_the_arm_at_rest_in_a_pose():
    arm = SimulatedArm()
    arm.reset(RAISED)
    simulate(arm, (0.0,) * 4, 0.3)
    arm.reset(RAISED)
    assert arm.positions == list(RAISED)
    assert arm.velocities == [0.0] * 4


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"coulomb_friction": (0.2, 0.2, 0.2)}, "coulomb_friction"),
        ({"viscous_friction": (-0.1, 0, 0, 0)}, "viscous_friction"),
        ({"rotor_inertia": (float("nan"), 0, 0, 0)}, "rotor_inertia"),
        ({"wearer_mass": (0, 0, 2000, 0)}, "wearer_mass"),
        ({"wearer_cog": (0, 0, 0.31, 0)}, "wearer_cog"),
        ({"position_min": (2.0, 0, 0, 0)}, "position_min"),
        ({"cog_y": (0, 0, 0.2, 0)}, "cog_y"),
        ({"stribeck_friction": (0, 0, -0.1, 0)}, "stribeck_friction"),
        ({"links": ArmModel.from_moments((0.05, 0.13, 0.3, 0.3), (0.1,) * 4)}, "robot.first_moment"),
        ({"links": ArmModel((0.05, 0.13, 0.3, 0.3), (0,) * 4, (0.5, 0.5, 0.0, 0.2))}, "links.mass"),
    ],
)
def test_an_impossible_configuration_is_rejected_by_name(change, name):
    with pytest.raises(ParameterError) as caught:
        ArmConfig(**change)
    assert caught.value.name == name
