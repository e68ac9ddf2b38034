"""The torque that turns an arm with its base, against MuJoCo's arm on a base that turns."""

from __future__ import annotations

import numpy as np
import pytest

import exo_gravity.sim.arm
from exo_gravity.core import ArmModel
from exo_gravity.core.model.kinematics import turning_torque
from exo_gravity.sim import ArmConfig, SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.base_motion import rotation_in_base

FREE = {name: (0.0,) * 4 for name in ("coulomb_friction", "viscous_friction", "rotor_inertia")}


def left_behind(side, angular_acceleration, theta, torque):
    """Return by how much (4,) rad/s^2 the arm's joints accelerate on a base that turns, without gravity."""
    arm = SimulatedArm(ArmConfig(**FREE))
    arm.reset(theta)
    arm.move_base((0.0,) * 3, (0.0,) * 3, rotation_in_base(side, angular_acceleration))
    arm.step(torque)
    return arm.data.qacc.copy()


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_torque_takes_an_arm_of_slender_rods_along_with_its_base(side, monkeypatch):
    monkeypatch.setattr(exo_gravity.sim.arm, "_TUBE_RADIUS", 1e-4)
    rng = np.random.default_rng(5)
    for _ in range(30):
        theta, turning = rng.uniform((-1.5, 0, -0.7, 0), (1.5, 3, 2, 3)), rng.uniform(-3, 3, 3)
        torque = turning_torque(DEFAULT_LINKS, side, theta, turning)
        np.testing.assert_allclose(left_behind(side, turning, theta, torque), 0.0, atol=1e-4)


def test_without_the_torque_the_arm_is_left_behind():
    assert np.abs(left_behind("left", (1.0, 1.0, 0.0), (0.0, 0.4, 0.5, 1.0), (0.0,) * 4)).max() > 0.5


def test_an_arm_given_by_its_moments_needs_about_the_same():
    arm = ArmModel.from_moments(DEFAULT_LINKS.length, DEFAULT_LINKS.first_moment)
    rng = np.random.default_rng(6)
    theta, turning = rng.uniform(0.0, 1.5, (30, 4)), rng.uniform(-3, 3, (30, 3))
    exact, guessed = (
        np.array([turning_torque(links, "left", *row) for row in zip(theta, turning, strict=True)])
        for links in (DEFAULT_LINKS, arm)
    )
    assert np.sqrt(np.mean((guessed - exact) ** 2)) < 0.15 * np.sqrt(np.mean(exact**2))


def test_the_gains_scale_the_torque():
    half = ArmModel(DEFAULT_LINKS.length, DEFAULT_LINKS.cog, DEFAULT_LINKS.mass, (0.5,) * 4)
    pose, turning = (0.1, 0.4, 0.5, 1.0), (1.0, 2.0, 0.0)
    whole = turning_torque(DEFAULT_LINKS, "left", pose, turning)
    np.testing.assert_allclose(turning_torque(half, "left", pose, turning), 0.5 * np.array(whole))
