# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The torque as a linear function of eight moments, against the closed form, vectors and Pinocchio."""

from __future__ import annotations

import numpy as np
import pytest

from bench.calibration.random_device import off_axis_of
from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.gravity import moments_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.lab.inputs.references import ALPHA, OFFSET
from exo_gravity.lab.moments import load_moments, regressor

ROUNDING = 1e-12  # Nm
LENGTH = (0.05, 0.13, 0.30, 0.30)


def random_arm(rng):
    """A random arm, and its centres of gravity off the links' axes: along y and z of Table 1."""
    length, mass = rng.uniform(0.03, 0.5, 4), rng.uniform(0.1, 3.0, 4)
    beside = rng.uniform(-0.05, 0.05, (2, 4))
    arm = ArmModel(length, length * rng.uniform(0.0, 1.0, 4), mass, off_axis=off_axis_of(mass, *beside))
    return arm, beside


def random_poses(rng, count=50):
    direction = rng.normal(size=(count, 3))
    return rng.uniform(-np.pi, np.pi, (count, 4)), direction / np.linalg.norm(direction, axis=1, keepdims=True)


def rotation(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array({"z": ((c, -s, 0), (s, c, 0), (0, 0, 1)), "x": ((1, 0, 0), (0, c, -s), (0, s, c))}[axis])


def test_the_regressor_times_the_moments_is_the_exact_law():
    rng = np.random.default_rng(2)
    arm, _ = random_arm(rng)
    theta, direction = random_poses(rng)
    torque = regressor(theta, direction, arm.gravity) @ moments_of(arm)
    np.testing.assert_allclose(torque, gravity_torque(arm, theta, direction), atol=ROUNDING)
    one = regressor(theta[:1], direction[0]) @ moments_of(arm)
    np.testing.assert_allclose(one[0], gravity_torque(arm, theta[0], direction[0]), atol=ROUNDING)


def test_centres_of_gravity_off_the_links_axes_agree_with_pinocchio():
    pin = pytest.importorskip("pinocchio")
    rng = np.random.default_rng(3)
    for _ in range(5):
        arm, beside = random_arm(rng)
        model, parent, placement = pin.Model(), 0, pin.SE3.Identity()
        for joint in range(4):
            parent = model.addJoint(parent, pin.JointModelRZ(), placement, f"joint_{joint + 1}")
            turned = pin.SE3(rotation("z", OFFSET[joint]), np.zeros(3))
            frame = pin.SE3(rotation("z", OFFSET[joint]) @ rotation("x", ALPHA[joint]), np.zeros(3))
            at = frame * pin.SE3(np.eye(3), np.array((arm.cog[joint], *beside[:, joint])))
            model.appendBodyToJoint(parent, pin.Inertia(float(arm.mass[joint]), np.zeros(3), np.zeros((3, 3))), at)
            far_end = pin.SE3(rotation("x", ALPHA[joint]), np.array((arm.length[joint], 0.0, 0.0)))
            placement = turned * far_end
        data, (theta, direction) = model.createData(), random_poses(rng)
        for pose, down in zip(theta, direction, strict=True):
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
