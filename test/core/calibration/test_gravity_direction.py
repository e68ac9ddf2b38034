"""Gravity measured in a slightly wrong direction: what the poses say of it, and the corrected mounting of the IMU."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core.calibration.identification import identify
from exo_gravity.core.tilt import SIDES, Tilt, gravity_in_trunk, rotation_matrix
from exo_gravity.tools.calibration import gravity_direction
from exo_gravity.tools.calibration.gravity_direction import corrected

from ...support.random_device import LENGTH, Device

DOWN = np.array(Tilt.of("right", 0.05, 0.21).direction)  # a stand that leans to the arm's side


def turned(axis, angle):
    """Return DOWN turned by `angle` rad about the part of `axis` across it."""
    across = axis - (axis @ DOWN) * DOWN
    turn = np.cross(across / np.linalg.norm(across), DOWN) * angle + DOWN
    return turn / np.linalg.norm(turn)


@pytest.mark.parametrize("seed", range(4))
def test_an_imu_that_is_two_degrees_off_does_no_harm_and_is_found(seed):
    device = Device(seed)
    measured = turned(np.random.default_rng(seed).normal(size=3), np.radians(2.0))
    observations = [one._replace(direction=measured) for one in device.tour(tuple(DOWN), 8, 8)]
    found = identify(observations, LENGTH)
    error = np.abs(found.moments - device.moments)
    assert np.all(error < np.maximum(3.0 * found.error, 0.01 * device.moments.max()))
    direction = measured + np.cross(found.tilt, measured)
    assert np.linalg.norm(direction / np.linalg.norm(direction) - DOWN) < np.radians(0.3)
    assert any("off what the IMU says" in sentence for sentence in found.unknown)


@pytest.mark.parametrize("side", SIDES)
def test_a_direction_in_the_arms_base_is_that_of_the_trunk(side):
    direction = np.array(Tilt.of(side, 0.2, 0.1).direction)
    np.testing.assert_allclose(gravity_direction._in_trunk(side, direction), gravity_in_trunk(0.2, 0.1), atol=1e-12)


def test_the_corrected_mounting_turns_the_measured_gravity_to_the_true_one():
    rng = np.random.default_rng(1)
    rotation = rng.normal(size=4)
    rotation /= np.linalg.norm(rotation)
    measured, true = turned(rng.normal(size=3), 0.05), DOWN
    angle, new = corrected(rotation.tolist(), measured, true)
    in_imu = rotation_matrix(rotation.tolist()).T @ measured
    np.testing.assert_allclose(rotation_matrix(new) @ in_imu, true, atol=1e-12)
    assert angle == pytest.approx(0.05, abs=1e-3)
    assert corrected(rotation.tolist(), true, true)[1] == pytest.approx(tuple(rotation))
