# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The torque as a linear function of eight moments, against the closed form, vectors and Pinocchio."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.gravity import moments_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.lab.moments import load_moments, regressor

from .test_gravity_oracles import random_arm, random_directions, random_poses
from .test_kinematics import with_moments_across, with_rods

ROUNDING = 1e-12  # Nm
LENGTH = (0.05, 0.13, 0.30, 0.30)


def test_the_regressor_times_the_moments_is_the_exact_law():
    rng = np.random.default_rng(2)
    arm = with_moments_across(random_arm(rng), rng.uniform(-0.05, 0.05, (4, 2)))
    theta, direction = random_poses(rng, 50), random_directions(rng, 50)
    torque = regressor(theta, direction, arm.gravity) @ moments_of(arm)
    np.testing.assert_allclose(torque, gravity_torque(arm, theta, direction), atol=ROUNDING)
    one = regressor(theta[:1], direction[0]) @ moments_of(arm)
    np.testing.assert_allclose(one[0], gravity_torque(arm, theta[0], direction[0]), atol=ROUNDING)


def test_centres_of_gravity_off_the_links_axes_agree_with_pinocchio():
    rng = np.random.default_rng(3)
    for _ in range(5):
        bare, beside = random_arm(rng), rng.uniform(-0.05, 0.05, (4, 2))
        arm, (pin, model, data) = with_moments_across(bare, beside), with_rods(bare, beside)
        for pose, down in zip(random_poses(rng, 50), random_directions(rng, 50), strict=True):
            model.gravity.linear = arm.gravity * down
            expected = pin.computeGeneralizedGravity(model, data, pose)
            np.testing.assert_allclose(gravity_torque(arm, pose, down), expected, atol=ROUNDING)


def test_a_weight_on_link_4_adds_the_moments_of_a_wearer_of_that_mass():
    arm = ArmModel(LENGTH, (0.02, 0.1, 0.2, 0.1), (0.5, 0.4, 0.6, 0.2))
    loaded = arm.with_wearer((0, 0, 0, 1.0), (0, 0, 0, 0.25))
    np.testing.assert_allclose(moments_of(arm) + load_moments(LENGTH, 1.0, 0.25), moments_of(loaded), rtol=1e-12)


@pytest.mark.parametrize(
    ("mass", "lever", "name"), [(1000, 0.3, "load_mass"), (1, 300, "load_lever"), (1, -0.1, "lever")]
)
def test_a_weight_in_grams_and_a_lever_in_millimetres_are_rejected_by_name(mass, lever, name):
    with pytest.raises(ParameterError, match=name):
        load_moments(LENGTH, mass, lever)
