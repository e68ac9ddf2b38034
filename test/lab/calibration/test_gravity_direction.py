# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Gravity measured in a slightly wrong direction: what the poses say of it, and the corrected mounting of the IMU."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core.arm.tilt import SIDES, Tilt, gravity_in_trunk, rotation_matrix
from exo_gravity.lab.calibration.identification import identify
from exo_gravity.lab.calibration.imu import NO_HEADING, turn_in_trunk, turned, with_mounting
from exo_gravity.lab.calibration.tours import moments_from
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config

from ...support.calibration_device import PAPERS, Device

ARM = configured_arm(packaged_config("sim.yaml"))
DOWN = np.array(Tilt.of("right", 0.05, 0.21).direction)  # a stand that leans to the arm's side


def in_trunk(side, direction):
    """Return a direction in an arm's base frame in the trunk's axes; the right arm's base is a mirror image."""
    return turn_in_trunk(side, direction) * (1.0 if side == "left" else -1.0)


def leant(axis, angle):
    """Return DOWN turned by `angle` rad about the part of `axis` across it."""
    across = axis - (axis @ DOWN) * DOWN
    turn = np.cross(across / np.linalg.norm(across), DOWN) * angle + DOWN
    return turn / np.linalg.norm(turn)


@pytest.mark.parametrize("seed", range(4))
def test_an_imu_that_is_two_degrees_off_does_no_harm_and_is_found(seed):
    device = Device(seed)
    measured = leant(np.random.default_rng(seed).normal(size=3), np.radians(2.0))
    observations = [one._replace(direction=measured) for one in device.tour(tuple(DOWN), 8, 8)]
    found = identify(observations, PAPERS)
    error = np.abs(found.moments - device.moments)
    assert np.all(error < np.maximum(3.5 * found.error, 0.01 * device.moments.max()))
    direction = measured + np.cross(found.tilt, measured)
    assert np.linalg.norm(direction / np.linalg.norm(direction) - DOWN) < np.radians(0.3)


def test_the_corrected_mounting_is_the_old_one_after_the_turn():
    rng = np.random.default_rng(1)
    rotation = rng.normal(size=4)
    rotation /= np.linalg.norm(rotation)
    turn, vector = np.array((0.0, 0.0, 0.05)), rng.normal(size=3)
    x, y, z = rotation_matrix(rotation.tolist()) @ vector
    expected = x * np.cos(0.05) - y * np.sin(0.05), y * np.cos(0.05) + x * np.sin(0.05), z
    np.testing.assert_allclose(rotation_matrix(turned(rotation.tolist(), turn)) @ vector, expected, atol=1e-12)
    assert turned(rotation.tolist(), np.zeros(3)) == pytest.approx(tuple(rotation))


@pytest.mark.parametrize("side", SIDES)
def test_a_turn_in_the_arms_base_moves_gravity_as_in_the_trunk(side):
    turn, direction = np.array((0.01, -0.02, 0.03)), np.array(Tilt.of(side, 0.2, 0.1).direction)
    np.testing.assert_allclose(in_trunk(side, direction), gravity_in_trunk(0.2, 0.1), atol=1e-12)
    moved = np.cross(turn_in_trunk(side, turn), gravity_in_trunk(0.2, 0.1))
    np.testing.assert_allclose(moved, in_trunk(side, np.cross(turn, direction)), atol=1e-12)


HEADING = np.radians(4.0)
FILE = """
/imu: {ros__parameters: {rotation_trunk_from_imu: [0.0, 0.0, 0.0, 1.0]}}
"""


def tours(device, pitches):
    """Observations without and with the weight, at a pitch each, of an IMU whose heading is `HEADING` off."""
    observations = []
    for pitch, (bare, weighed) in zip(pitches, ((8, 0), (0, 8)), strict=True):
        down = Tilt.of("right", pitch, 0.2).direction
        x, y, z = down
        measured = np.array((x + HEADING * y, y - HEADING * x, z))  # turned by -HEADING about z
        measured /= np.linalg.norm(measured)
        observations += [one._replace(direction=measured) for one in device.tour(down, bare, weighed)]
    return observations


@pytest.mark.parametrize("seed", range(2))
def test_two_leans_of_the_stand_show_the_heading_of_the_imu_and_one_does_not(seed):
    device = Device(seed)
    one, two = (identify(tours(device, pitches), PAPERS) for pitches in ((0.07, 0.07), (0.07, -0.09)))
    error = np.sqrt(np.diag(two.tilt_covariance))
    assert abs(two.tilt[2] - HEADING) < 3.0 * error[2] and error[2] < np.radians(1.0)
    assert np.sqrt(one.tilt_covariance[2, 2]) > np.radians(2.0)


def test_the_heading_is_corrected_only_if_it_shows(tmp_path):
    params, arm = tmp_path / "exo.yaml", ARM
    params.write_text(FILE, encoding="utf-8")
    for pitches, is_shown in (((0.07, 0.07), False), ((0.07, -0.09), True)):
        observations = tours(Device(2), pitches)
        outcome = with_mounting(moments_from(arm, observations), params)
        (mounting,) = [change.value for change in outcome.changes if change.name == "rotation_trunk_from_imu"]
        for observation in observations[0], observations[-1]:
            pitch = pitches[bool(observation.load_mass)]
            moved = rotation_matrix(mounting) @ in_trunk("right", observation.direction)
            wrong = np.linalg.norm(moved - gravity_in_trunk(pitch, 0.2))
            assert wrong < np.radians(0.3)
        heading = np.arctan2(rotation_matrix(mounting)[1, 0], rotation_matrix(mounting)[0, 0])
        assert (abs(heading) > HEADING / 2.0) == is_shown
        assert (NO_HEADING in outcome.lines) != is_shown
