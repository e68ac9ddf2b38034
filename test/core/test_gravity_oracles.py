# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The gravity laws against Pinocchio, the Robotics Toolbox, and the paper's equations copied by hand."""

import math
from math import cos, sin

import numpy as np
import pytest

from exo_gravity.core import ArmModel, Tilt, gravity_torque, paper_mobile_torque, paper_static_torque
from exo_gravity.core.arm.paper import mobile_torque, static_torque
from exo_gravity.lab.inputs.references import gravload, pinocchio

from ..support.thorough import quick

ROUNDING = 1e-12  # Nm


def random_arm(rng, at_link_ends=False):
    length = rng.uniform(0.03, 0.5, 4)
    cog = length if at_link_ends else length * rng.uniform(0.0, 1.0, 4)
    return ArmModel(length, cog, rng.uniform(0.1, 3.0, 4), rng.uniform(0.0, 2.0, 4), rng.uniform(1.0, 20.0))


def random_poses(rng, count=200):
    return rng.uniform(-math.pi, math.pi, (count, 4))


def random_directions(rng, count=200):
    direction = rng.normal(size=(count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def upright(rng, count=200):
    """Poses with the paper's theta_1, the angle between joint 1's axis and gravity, equal to 0."""
    return random_poses(rng, count) * (0.0, 1.0, 1.0, 1.0)


@pytest.mark.parametrize("reference", quick([pinocchio], [pinocchio, gravload]))
def test_the_exact_law_agrees_for_random_arms_poses_and_gravity_directions_with(reference):
    rng = np.random.default_rng(1)
    for _ in range(4):
        arm, theta, direction = random_arm(rng), random_poses(rng, 50), random_directions(rng, 50)
        expected = reference(arm)(theta, direction)
        assert gravity_torque(arm, theta, direction) == pytest.approx(expected, abs=ROUNDING)


@pytest.mark.parametrize(
    "law", [paper_static_torque, lambda arm, theta: paper_mobile_torque(arm, theta, 0.0, 0.0)], ids=("static", "mobile")
)
def test_a_paper_law_equals_the_exact_law_at_link_ends_and_upright(law):
    rng = np.random.default_rng(4)
    arm, theta = random_arm(rng, at_link_ends=True), upright(rng)
    assert law(arm, theta) == pytest.approx(gravity_torque(arm, theta), abs=ROUNDING)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("law", [ArmModel.torque, static_torque, mobile_torque])
def test_a_single_pose_in_plain_floats_agrees_with_the_arrays(law, side):
    rng = np.random.default_rng(5)
    arm = random_arm(rng)
    for theta, (pitch, roll) in zip(random_poses(rng, 100), rng.uniform(-1.5, 1.5, (100, 2)), strict=True):
        tilt = Tilt.of(side, pitch, roll)
        on_axis = np.array((tilt.axis_angle, *theta[1:]))
        arrays = {
            ArmModel.torque: lambda theta=theta, tilt=tilt: gravity_torque(arm, theta, tilt.direction),
            static_torque: lambda on_axis=on_axis: paper_static_torque(arm, on_axis),
            mobile_torque: lambda on_axis=on_axis, tilt=tilt: paper_mobile_torque(arm, on_axis, tilt.beta, tilt.phi),
        }
        assert law(arm, theta.tolist(), tilt) == pytest.approx(arrays[law](), abs=ROUNDING)


def eq2_to_eq5(arm, t1, t2, t3, t4):
    (_, l2, l3, l4), (d1, d2, d3, d4) = arm.length, arm.cog
    (m1, m2, m3, m4), (c1, c2, c3, c4), g = arm.mass, arm.gain, arm.gravity
    return (
        c1 * g * (d1 * (m1 + m2 + m3 + m4) + l2 * (m2 + m3 + m4) * sin(t2)
                  + l3 * (m3 + m4) * cos(t3) + l4 * m4 * cos(t3 + t4)) * sin(t1),
        c2 * g * (d2 * (m2 + m3 + m4) + l3 * (m3 + m4) * cos(t3) + l4 * m4 * cos(t3 + t4)) * sin(t2),
        c3 * g * (d3 * (m3 + m4) * sin(t3) + l4 * m4 * sin(t3 + t4)) * cos(t2),
        c4 * g * d4 * m4 * sin(t3 + t4) * cos(t2),
    )  # fmt: skip


def eq1m_to_eq4m(arm, t1, t2, t3, t4, beta, phi):
    (_, l2, l3, l4), (d1, d2, d3, d4) = arm.length, arm.cog
    (m1, m2, m3, m4), (c1, c2, c3, c4), g = arm.mass, arm.gain, arm.gravity
    return (
        c1 * g * (d1 * (m1 + m2 + m3 + m4) + l2 * (m2 + m3 + m4) * sin(t2 + phi) + l3 * (m3 + m4) * cos(t3 + beta)
                  + l4 * m4 * cos(t3 + t4 + beta)) * sin(t1) * cos(phi) * cos(beta),
        c2 * g * (d2 * (m2 + m3 + m4) + l3 * (m3 + m4) * cos(t3 + beta) + l4 * m4 * cos(t3 + t4 + beta))
        * sin(t2 + phi) * cos(t1) * cos(phi) * cos(beta),
        c3 * g * (d3 * (m3 + m4) * sin(t3 + beta) + l4 * m4 * sin(t3 + t4 + beta))
        * cos(t2 + phi) * cos(t1) * cos(phi) * cos(beta),
        c4 * g * d4 * m4 * sin(t3 + t4 + beta) * cos(t2 + phi) * cos(t1) * cos(phi) * cos(beta),
    )  # fmt: skip


def test_the_static_law_is_eq2_to_eq5_of_the_paper_word_for_word():
    rng = np.random.default_rng(6)
    arm, theta = random_arm(rng), random_poses(rng)
    expected = np.array([eq2_to_eq5(arm, *pose) for pose in theta])
    assert paper_static_torque(arm, theta) == pytest.approx(expected, abs=ROUNDING)


def test_the_mobile_law_is_eq1m_to_eq4m_of_the_paper_word_for_word():
    rng = np.random.default_rng(7)
    arm, theta, tilt = random_arm(rng), random_poses(rng), rng.uniform(-1.0, 1.0, (200, 2))
    expected = np.array([eq1m_to_eq4m(arm, *pose, *angles) for pose, angles in zip(theta, tilt, strict=True)])
    assert paper_mobile_torque(arm, theta, *tilt.T) == pytest.approx(expected, abs=ROUNDING)
