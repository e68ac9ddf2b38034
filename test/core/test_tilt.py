# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Trunk tilt against SciPy's Rotation, and the signs of pitch and roll."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import exact_torque, mobile_torque, static_torque
from exo_gravity.core.arm.tilt import Tilt, gravity_in_trunk, pitch_roll, rotation_matrix
from exo_gravity.core.errors import ParameterError


def random_tilts(count=500):
    rng = np.random.default_rng(3)
    return rng.uniform((-math.pi / 2, -math.pi), (math.pi / 2, math.pi), (count, 2))


def rotation(pitch, roll, heading=0.0):
    return Rotation.from_euler("xyz", (roll, pitch, heading))  # fixed axes: roll about x first, then pitch about y


def test_gravity_in_the_trunk_agrees_with_a_roll_then_a_pitch_about_fixed_axes():
    for pitch, roll in random_tilts():
        assert gravity_in_trunk(pitch, roll) == pytest.approx(rotation(pitch, roll).inv().apply((0, 0, -1)), abs=1e-12)


def test_bowing_forward_is_positive_pitch_and_leaning_to_the_right_positive_roll():
    assert gravity_in_trunk(0.3, 0.0)[0] > 0 > gravity_in_trunk(0.0, 0.3)[1]


def test_pitch_and_roll_are_recovered_from_gravity():
    for tilt in random_tilts():
        assert pitch_roll(gravity_in_trunk(*tilt)) == pytest.approx(tuple(tilt), abs=1e-6)


def test_gravity_straight_forward_is_a_pitch_of_90_degrees():
    assert pitch_roll((1.0, 0.0, 0.0))[0] == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("gravity", [(0, 0, 0), (math.nan, 0, 1), (math.inf, 0, 1)])
def test_gravity_without_a_direction_is_rejected(gravity):
    for function in (pitch_roll, lambda vector: Tilt.of_gravity("left", vector)):
        with pytest.raises(ParameterError, match="gravity_in_trunk"):
            function(gravity)


def test_the_right_arms_direction_is_the_left_arms_at_the_opposite_roll():
    for pitch, roll in random_tilts():
        assert Tilt.of("right", pitch, roll).direction == Tilt.of("left", pitch, -roll).direction


def test_the_axis_angle_is_the_angle_between_the_trunks_vertical_and_gravity():
    for pitch, roll in random_tilts():
        expected = math.acos(np.clip(rotation(pitch, roll).as_matrix()[2, 2], -1, 1))
        assert Tilt.of("left", pitch, roll).axis_angle == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize(("side", "phi"), [("left", 0.2), ("right", -0.2)])
def test_beta_is_minus_the_pitch_and_phi_is_the_outward_roll(side, phi):
    tilt = Tilt.of(side, 0.1, 0.2)
    assert (tilt.beta, tilt.phi) == (-0.1, phi)


@pytest.mark.parametrize("arguments", [("middle", 0, 0), ("left", math.nan, 0), ("left", 0, 4.0), ("left", None, 0)])
def test_an_impossible_tilt_is_rejected(arguments):
    with pytest.raises(ParameterError):
        Tilt.of(*arguments)


def test_the_rotation_matrix_agrees_with_scipy():
    for turn in Rotation.random(200, random_state=4):
        assert rotation_matrix(turn.as_quat()) == pytest.approx(turn.as_matrix(), abs=1e-12)


def test_a_quaternion_rounded_by_a_driver_is_normalised():
    quaternion = Rotation.from_euler("x", 0.4).as_quat()
    assert rotation_matrix(1.005 * quaternion) == pytest.approx(rotation_matrix(quaternion), abs=1e-12)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0, 0, 0, 1.1), (math.nan, 0, 0, 1), (0, 0, 1), (1, 1, 1, 1)])
def test_a_quaternion_that_is_not_a_unit_one_is_rejected_by_name(quaternion):
    with pytest.raises(ParameterError, match="rotation_trunk_from_imu"):
        rotation_matrix(quaternion, "rotation_trunk_from_imu")


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_tilt_of_a_gravity_vector_is_that_of_its_pitch_and_roll(side):
    for pitch, roll in np.random.default_rng(8).uniform(-1.5, 1.5, (50, 2)):
        by_angles, by_vector = Tilt.of(side, pitch, roll), Tilt.of_gravity(side, 3.0 * gravity_in_trunk(pitch, roll))
        for one, other in zip(by_angles, by_vector, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-12)


def test_the_laws_multiply_their_torque_by_the_magnitude_of_gravity():
    arm, theta = ArmModel((0.05, 0.13, 0.3, 0.3), (0.05, 0.1, 0.2, 0.1), (0.6, 0.5, 0.6, 0.2)), (0.2, 0.7, 0.6, 0.5)
    tilt = Tilt.of("left", 0.2, -0.1)
    for law in (exact_torque, static_torque, mobile_torque):
        felt = law(arm, theta, tilt._replace(magnitude=1.5))
        np.testing.assert_allclose(felt, 1.5 * np.array(law(arm, theta, tilt)))
