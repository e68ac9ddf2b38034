# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arm's inertia against Pinocchio's rnea and crba; the torque that turns it with its base against MuJoCo."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import exo_gravity.sim.arm
from exo_gravity.core import ArmModel
from exo_gravity.core.arm.chain import least_inertia
from exo_gravity.lab.inputs.references import OFFSET, pinocchio_model
from exo_gravity.sim import ArmConfig, SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS, in_base

from .test_gravity_oracles import random_arm

ROUNDING = 1e-10  # Nm; torques reach 100 Nm
NO_ROTORS = (0.0,) * 4
ON_LINKS = np.zeros((4, 2))  # m


def with_moments_across(arm: ArmModel, beside: np.ndarray) -> ArmModel:
    """Return the arm with the moments across its links that `beside` (4, 2) m of `with_rods` make."""
    (m1, m2, m3, m4), ((w1, _), (z2, w2), (y3, z3), (y4, z4)) = arm.mass.tolist(), beside.tolist()
    across = (m1 * w1 + m2 * w2, -m2 * z2 + m3 * z3 + m4 * z4, m3 * y3, m4 * y4)
    return ArmModel(arm.length, arm.cog, arm.mass, off_axis=across)


def with_rods(arm: ArmModel, beside: np.ndarray = ON_LINKS) -> tuple[Any, Any, Any]:
    """Return Pinocchio, and the arm as its model of thin rods without gravity.

    beside: (4, 2) m of each centre of gravity from its link, along the joint's axis x the link and along the axis.
    """
    pin, model = pinocchio_model(arm)
    for n in range(4):
        across = float(arm.mass[n] * arm.length[n] ** 2 / 12.0)
        at_cog = pin.SE3(pin.utils.rotate("z", OFFSET[n]), np.zeros(3)) * pin.SE3(
            np.eye(3), np.array((arm.cog[n], *beside[n]))
        )
        model.inertias[n + 1] = at_cog.act(pin.Inertia(float(arm.mass[n]), np.zeros(3), np.diag((0.0, across, across))))
    model.gravity.linear = np.zeros(3)
    return pin, model, model.createData()


@pytest.mark.parametrize("beside", [0.0, 0.05])  # m of centres of gravity off their links, where links share a place
def test_torque_mass_matrix_and_momentum_agree_with_pinocchio_for_random_arms_and_motions(beside):
    rng = np.random.default_rng(7)
    for _ in range(8):
        bare, (w, z, y3, y4) = random_arm(rng), rng.uniform(-beside, beside, 4)
        places = np.array(((w, 0.0), (-z, w), (y3, z), (y4, z)))
        pin, model, data = with_rods(bare, places)
        links = (with_moments_across(bare, places) if beside else bare).links._replace(rotors=NO_ROTORS)
        for theta, velocity, acceleration in rng.uniform(-3.0, 3.0, (20, 3, 4)):
            expected = pin.rnea(model, data, theta, velocity, acceleration)
            assert links.torque(theta, velocity, acceleration) == pytest.approx(expected, abs=ROUNDING)
            upper = np.triu(pin.crba(model, data, theta))
            mass = upper + np.triu(upper, 1).T
            assert links.matrix(theta) == pytest.approx(mass, abs=ROUNDING)
            momentum, change = links.momentum(theta, velocity)
            assert momentum == pytest.approx(mass @ velocity, abs=ROUNDING)
            coriolis = pin.computeCoriolisMatrix(model, data, theta, velocity)
            assert change == pytest.approx(coriolis.T @ velocity, abs=ROUNDING)


def test_centres_of_gravity_anywhere_beside_the_links_leave_a_third_of_the_error_without_them():
    rng, errors = np.random.default_rng(8), []
    arm = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
    for _ in range(20):
        beside = rng.uniform(-0.015, 0.015, (4, 2)) * ((1.0, 0.0), (1.0, 1.0), (1.0, 1.0), (1.0, 1.0))
        pin, model, data = with_rods(arm, beside)
        theta, velocity = rng.uniform(-1.5, 1.5, (2, 4))
        mass = np.triu(pin.crba(model, data, theta))
        momentum = (mass + np.triu(mass, 1).T) @ velocity
        expected = momentum, pin.computeCoriolisMatrix(model, data, theta, velocity).T @ velocity
        both = (each.links._replace(rotors=NO_ROTORS) for each in (with_moments_across(arm, beside), arm))
        errors.append([np.subtract(links.momentum(theta, velocity), expected) for links in both])
    (momentum, coriolis), (momentum_without, coriolis_without) = np.linalg.norm(errors, axis=(0, 3))
    assert momentum < 0.5 * momentum_without and coriolis < 0.5 * coriolis_without


def test_each_rotor_turns_with_its_own_joint():
    arm, theta, acceleration = random_arm(np.random.default_rng(2)), (0.1, 0.2, 0.3, 0.4), (1.0, -2.0, 3.0, 5.0)
    rotors = (0.1, 0.2, 0.3, 0.4)
    with_rotors, without = (
        arm.links._replace(rotors=each).torque(theta, NO_ROTORS, acceleration) for each in (rotors, NO_ROTORS)
    )
    assert np.subtract(with_rotors, without) == pytest.approx(np.multiply(rotors, acceleration))


def test_the_least_inertia_is_below_that_of_any_pose():
    arm = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
    links, rng = arm.links, np.random.default_rng(3)
    poses = rng.uniform((-1.6, 0.0, 0.0, 0.0), (1.6, 2.6, 2.5, 2.6), (300, 4))
    felt = np.array([1.0 / np.diag(np.linalg.inv(links.matrix(pose))) for pose in poses])
    assert np.all(felt > 0.97 * np.array(least_inertia(links)))


FREE = {name: (0.0,) * 4 for name in ("coulomb_friction", "viscous_friction", "rotor_inertia")}


def left_behind(side, angular_acceleration, theta, torque):
    """Return by how much (4,) rad/s^2 the arm's joints accelerate on a base that turns, without gravity."""
    arm = SimulatedArm(ArmConfig(**FREE))
    arm.reset(theta)
    arm.move_base((0.0,) * 3, (0.0,) * 3, in_base(side, angular_acceleration, turning=True))
    arm.step(torque)
    return arm.data.qacc.copy()


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_torque_takes_an_arm_of_slender_rods_along_with_its_base(side, monkeypatch):
    monkeypatch.setattr(exo_gravity.sim.arm, "_TUBE_RADIUS", 1e-4)  # no parameter: the device has tubes
    rng = np.random.default_rng(5)
    for _ in range(30):
        theta, turning = rng.uniform((-1.5, 0, -0.7, 0), (1.5, 3, 2, 3)), rng.uniform(-3, 3, 3)
        torque = DEFAULT_LINKS.turning_torque(side, theta, turning)
        np.testing.assert_allclose(left_behind(side, turning, theta, torque), 0.0, atol=1e-4)


def test_an_arm_given_by_its_moments_needs_about_the_same():
    arm = ArmModel.from_moments(DEFAULT_LINKS.length, DEFAULT_LINKS.first_moment)
    rng = np.random.default_rng(6)
    theta, turning = rng.uniform(0.0, 1.5, (30, 4)), rng.uniform(-3, 3, (30, 3))
    exact, guessed = (
        np.array([links.turning_torque("left", *row) for row in zip(theta, turning, strict=True)])
        for links in (DEFAULT_LINKS, arm)
    )
    assert np.sqrt(np.mean((guessed - exact) ** 2)) < 0.15 * np.sqrt(np.mean(exact**2))


def test_the_gains_scale_the_torque():
    half = ArmModel(DEFAULT_LINKS.length, DEFAULT_LINKS.cog, DEFAULT_LINKS.mass, (0.5,) * 4)
    pose, turning = (0.1, 0.4, 0.5, 1.0), (1.0, 2.0, 0.0)
    whole = DEFAULT_LINKS.turning_torque("left", pose, turning)
    np.testing.assert_allclose(half.turning_torque("left", pose, turning), 0.5 * np.array(whole))
