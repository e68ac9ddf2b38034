# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Identification from held poses: right on random devices, with stated errors, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.tilt import SIDES, Tilt, gravity_in_trunk, rotation_matrix
from exo_gravity.core.errors import DataError
from exo_gravity.lab.calibration.identification import Places, identify
from exo_gravity.lab.calibration.imu import NO_HEADING, turn_in_trunk, turned, with_mounting
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.tours import moments_from
from exo_gravity.lab.calibration.tracking import Observation
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.inputs.references import ALPHA, OFFSET, pinocchio_model
from exo_gravity.sim.arm import DEFAULT_LINKS

from ...support.calibration_device import (
    CANDIDATES,
    CODE,
    LEANING,
    PAPERS,
    UPRIGHT,
    Device,
    best,
)
from ...support.thorough import quick


@pytest.fixture(scope="module")
def devices():
    """Sixteen devices, and the result of a tour of each."""
    return [(device, identify(device.tour(), PAPERS)) for device in map(Device, range(100, 116))]


def share_covered(found_of_devices):
    """Return the share of moments and scales that lie within two of their standard errors."""
    size = [
        np.append(
            (found.value.moment - device.moments) / found.error.moment,
            (found.value.scale - device.scale) / found.error.scale,
        )
        for device, found in found_of_devices
    ]
    return np.mean(np.abs(size) < 2.0)


def test_moments_of_random_devices_and_torques_in_new_poses_are_right_to_2_percent_and_errors_cover_95_percent(devices):
    theta = np.random.default_rng(7).uniform((-1.0, 0.0, -0.5, 0.0), (1.0, 2.8, 2.0, 2.6), (500, 4))
    for device, found in devices:
        true = device.effort(theta, LEANING)
        off = PAPERS.rows(theta, LEANING) @ found.value.moment / found.value.scale + found.value.offset - true
        assert np.all(np.sqrt(np.mean(off**2, axis=0)) < 0.02 * np.abs(true).max(axis=0))
        wrong = np.abs(found.value.moment - device.moments)
        assert np.all((wrong < 2.0 * found.error.moment) | (wrong < 0.02 * device.moments.max()))
        np.testing.assert_allclose(found.friction, device.friction / device.scale, atol=0.015)
    share = np.abs([(found.value.moment - device.moments)[1:4] / device.moments[1:4] for device, found in devices])
    assert np.median(share) < 0.01 and share.max() < 0.04
    assert 0.90 <= share_covered(devices) <= 0.99


def test_the_prediction_of_a_pose_is_that_of_a_fit_without_it_and_nearly_as_good_as_its_measurement(devices):
    for _, found in devices:
        assert np.nanmax(np.abs(found.held_out)) < 0.15
    observations = Device(1).tour()
    found, without = identify(observations, PAPERS), identify(observations[1:], PAPERS)
    direction, theta = LEANING + np.cross(without.value.tilt, LEANING), np.array([observations[0].theta])
    rows = (PAPERS.along_axes(theta) + PAPERS.turned(theta) @ without.value.turn.ravel())[0] @ direction
    torque = rows @ without.value.moment + without.value.spring * theta[0]
    predicted = torque / without.value.scale + without.value.offset
    np.testing.assert_allclose(found.held_out[0], observations[0].effort - predicted, atol=2e-3)


def test_without_a_weight_moments_and_scales_are_relative_but_the_commanded_torque_is_right():
    device = Device(3)
    found = identify(device.tour(bare=12, weighed=0), PAPERS)
    assert found.relative and "common factor" in found.unknown[0]
    weighed = identify(Device(3).tour(), PAPERS)
    assert not weighed.relative and "common factor" not in weighed.unknown[0]
    assert np.prod(found.value.scale[1:]) == pytest.approx(1.0, abs=1e-5)
    factor = found.value.moment[1] / device.moments[1]
    assert factor == pytest.approx(np.prod(device.scale[1:]) ** (-1.0 / 3.0), rel=0.01)
    np.testing.assert_allclose(found.value.moment / factor, device.moments, atol=0.004)
    np.testing.assert_allclose(found.value.scale / factor, device.scale, rtol=0.03)


def test_with_an_upright_stand_joint_1_is_not_known_and_said_to_be_and_of_equal_poses_the_first_is_chosen():
    assert {pose[0] for pose in best(UPRIGHT, 8)} == {CANDIDATES[0, 0]}  # its angle changes nothing
    device = Device(4)
    found = identify(device.tour(UPRIGHT), PAPERS)
    assert "M1, W, torque scale 1: joint 1 carries nothing" in found.unknown[0]
    seen = [name not in ("M1", "W") for name in PAPERS.names]
    assert np.isfinite(found.error.moment).tolist() == seen and np.isinf(found.error.scale[0])
    assert np.all(np.abs(found.value.moment - device.moments)[seen] < 4.0 * found.error.moment[seen])


@pytest.mark.parametrize(
    ("seed", "tilt", "error"),
    [(30, (0.05, 0.05), 0.002), pytest.param(31, (0.003, 0.002), 0.02, marks=pytest.mark.thorough)],
)
def test_the_first_moment_is_never_negative_and_its_error_stays_honest(seed, tilt, error):
    device = Device(seed)
    device.moments[0] = -0.003
    found = identify(device.tour(Tilt.of("right", *tilt).direction), PAPERS)
    assert (
        0.0 <= found.value.moment[0] < device.moments[0] + 2.0 * found.error.moment[0]
        and found.error.moment[0] >= error
    )


def test_a_zero_that_is_off_looks_like_a_moment_across_the_link_and_the_torque_is_right_all_the_same():
    device, off = Device(5), np.array((0.0, 0.0, 0.0, np.radians(5.0)))
    observations = [o._replace(theta=np.subtract(o.theta, off)) for o in device.tour()]
    found = identify(observations, PAPERS)
    turned = np.arctan2(*(device.moments[[7, 3]])) + off[3]
    assert np.arctan2(found.value.moment[7], found.value.moment[3]) + found.value.turn[3, 0] == pytest.approx(
        turned, abs=0.02
    )
    assert any("Y4 of link 4 from an error of joint 4's zero" in sentence for sentence in found.unknown)


def askew_torque(turn, theta, direction):
    """Return the torque (m, 4) in Nm by Pinocchio of an arm whose axes are turned; turn: (4, 2) rad, about x and y."""
    pin, model = pinocchio_model(DEFAULT_LINKS)
    for joint, (x, y) in enumerate(turn, start=1):
        model.jointPlacements[joint] = model.jointPlacements[joint] * pin.SE3(
            pin.exp3(np.array((x, y, 0.0))), np.zeros(3)
        )
    data, model.gravity.linear = model.createData(), STANDARD_GRAVITY * np.asarray(direction)
    return np.array([pin.computeGeneralizedGravity(model, data, np.array(pose)) for pose in theta])


def off_device(seed, model, leans, askew, zero):
    """Return what a tour of Pinocchio's arm leaves in new poses, (200, 4) Nm, its result, and the largest torque in Nm.

    Its axes are up to `askew` degrees askew, its zeros up to `zero` degrees off.
    """
    rng, tour = np.random.default_rng(seed), []
    angle = rng.uniform(0.0, 2.0 * np.pi, 4)
    turn = np.radians(askew) * rng.uniform(size=(4, 1)) * np.column_stack((np.cos(angle), np.sin(angle)))
    off = np.radians(zero) * rng.uniform(-1.0, 1.0, 4)
    for down in leans:
        for theta in best(down, 16 // len(leans)):
            effort = askew_torque(turn, [theta - off], down)[0] + rng.normal(0.0, CODE / 2.0, 4)
            spread = np.full(4, CODE / 2.0)
            tour.append(Observation(theta, np.array(down), effort, spread, spread))
    found = identify(tour, model)
    new = np.random.default_rng(9).uniform((-0.8, 0.3, -0.2, 0.2), (0.8, 1.3, 1.2, 1.4), (200, 4))
    mounted = np.array(UPRIGHT) + model.keeps_tilt * np.cross(found.value.tilt, UPRIGHT)
    rest = found.value.turn[:, 0] - found.value.offset * found.value.scale / np.maximum(found.value.spring, 1e-9)
    springs = found.value.spring * (new + off - rest)
    moments = np.where(np.isfinite(found.error.moment), found.value.moment, model.moments)
    joints = new + off + found.value.turn[:, 0]  # as the new zeros show them
    law = (PAPERS.rows(joints, mounted / np.linalg.norm(mounted)) @ moments + springs) / found.value.scale
    true = askew_torque(turn, new, UPRIGHT)
    return np.abs(law - true), found, float(np.abs(true).max())


def test_zeros_and_axes_that_are_off_leave_little():
    model, leans = MomentModel(DEFAULT_LINKS, True), (LEANING, Tilt.of("right", -0.1, 0.25).direction)
    for seed in range(2):
        wrong, found, peak = off_device(seed, model, leans, 1.5, 1.5)
        assert wrong.max() < 0.02 * peak  # with zeros held 2.9 %
        assert np.max(found.torque_error) < 0.015 * peak


def with_point(model, link, place):
    """Put a point of 1 kg on a link of Pinocchio's model of the paper's arm; place: (3,) m in its frame of Table 1."""
    pin, _ = pinocchio_model(DEFAULT_LINKS)
    frame = pin.utils.rotate("z", OFFSET[link]) @ pin.utils.rotate("x", ALPHA[link])
    point = pin.Inertia(1.0, frame @ place, np.zeros((3, 3)))
    model.appendBodyToJoint(link + 1, point, pin.SE3.Identity())


def test_the_papers_derivatives_by_turns_are_pinocchios():
    pin, model = pinocchio_model(DEFAULT_LINKS)
    moments, changed = MomentModel(DEFAULT_LINKS, True), np.zeros(8)
    moments.fitted_turns = 3
    for index, (link, way) in enumerate(moments.base[4:], start=4):  # W, Z, Y3 and Y4
        with_point(model, link, 0.05 * way)
        changed += DEFAULT_LINKS.with_wearer(np.eye(4)[link], np.zeros(4)).moments - DEFAULT_LINKS.moments
        changed[index] += 0.05
    data, theta, step = model.createData(), np.array((0.4, 0.9, -0.3, 0.8)), 1e-5
    down = np.array((0.2, -0.3, 0.93))
    model.gravity.linear[:] = 9.80665 * down
    shown = np.einsum("nkat,a,k->tn", moments.turned(theta[None])[0], down, moments.moments + changed)
    for number, derivative in enumerate(shown):
        joint, way = 1 + number // 3, np.eye(3)[(2, 0, 1)[number % 3]]
        place, ends = model.jointPlacements[joint].copy(), []
        for sign in (1.0, -1.0):
            model.jointPlacements[joint] = place * pin.SE3(pin.exp3(sign * step * way), np.zeros(3))
            ends.append(pin.computeGeneralizedGravity(model, data, theta).copy())
        model.jointPlacements[joint] = place
        np.testing.assert_allclose(derivative, (ends[0] - ends[1]) / (2.0 * step), atol=1e-6)


def test_friction_that_grows_with_the_torque_widens_the_band():
    tour = Device(6).tour()
    assert np.all(
        identify([one._replace(friction=one.friction + 0.1 * np.abs(one.effort)) for one in tour], PAPERS).torque_error
        > identify(tour, PAPERS).torque_error
    )


def test_zeros_of_a_jig_are_kept():
    found = identify(Device(5).tour(), PAPERS, Places(zero=0.0))
    assert (
        np.abs(found.value.turn[:, 0]).max() < 1e-4 < np.abs(identify(Device(5).tour(), PAPERS).value.turn[:, 0]).max()
    )


def test_the_next_pose_shows_more_than_a_repeated_or_a_random_one():
    rng = np.random.default_rng(16)
    device = Device(16)

    def uncertain(poses):
        return np.log(identify([device.observe(theta) for theta in poses], PAPERS).error.moment).sum()

    chosen = uncertain(best(LEANING, 10))
    drawn = [uncertain(rng.permutation(CANDIDATES)[:10]) for _ in range(5)]
    assert chosen < np.median(drawn)


def test_a_pose_with_a_slip_or_a_hand_stands_out_and_the_errors_contain_it():
    device = Device(6)
    observations = device.tour(bare=10)
    observations[5] = observations[5]._replace(effort=np.add(observations[5].effort, (0.0, -0.5, 0.0, 0.0)))
    found, untouched = identify(observations, PAPERS), identify(Device(6).tour(bare=10), PAPERS)
    assert np.unravel_index(np.abs(found.held_out).argmax(), found.held_out.shape) == (5, 1)
    assert np.all(found.torque_error > untouched.torque_error)
    assert np.all(np.abs(found.value.moment - device.moments) < 4.0 * found.error.moment)


def test_poses_that_do_not_fit_one_arm_are_refused_together():
    observations = Device(7).tour(bare=8)
    for k, one in enumerate(observations[:12:2]):
        observations[2 * k] = one._replace(effort=one.effort + np.eye(4)[k % 4] * (-1) ** k)  # Nm
    with pytest.raises(DataError, match=r"the poses do not fit one arm: .*off in half of the poses.*touched"):
        identify(observations, PAPERS)


def test_too_few_poses_are_refused_with_the_pose_that_is_missing_and_accepted_with_it():
    device = Device(8)
    observations = [device.observe(theta) for theta in best(LEANING, 2)]
    with pytest.raises(DataError, match="2 poses do not show"):
        identify(observations, PAPERS)
    for _ in range(4):
        try:
            found = identify(observations, PAPERS)
            break
        except DataError as error:
            assert "poses do not show" in str(error)
            degrees = str(error).split("add the pose [")[1].split("]")[0].split(",")
            observations.append(device.observe(np.radians([float(angle) for angle in degrees])))
    assert np.all(np.abs(found.value.moment[1:4]) > found.error.moment[1:4])


ARM = configured_arm(packaged_config("sim.yaml"))

DOWN = np.array(Tilt.of("right", 0.05, 0.21).direction)  # a stand that leans to the arm's side


def leant(axis, angle):
    """Return DOWN turned by `angle` rad about the part of `axis` across it."""
    across = axis - (axis @ DOWN) * DOWN
    turn = np.cross(across / np.linalg.norm(across), DOWN) * angle + DOWN
    return turn / np.linalg.norm(turn)


@pytest.mark.parametrize("seed", quick([2], range(4)))
def test_an_imu_that_is_two_degrees_off_does_no_harm_and_is_found(seed):
    device = Device(seed)
    measured = leant(np.random.default_rng(seed).normal(size=3), np.radians(2.0))
    observations = [one._replace(direction=measured) for one in device.tour(tuple(DOWN), 8, 8)]
    found = identify(observations, PAPERS)
    error = np.abs(found.value.moment - device.moments)
    assert np.all(error < np.maximum(3.5 * found.error.moment, 0.01 * device.moments.max()))
    direction = measured + np.cross(found.value.tilt, measured)
    assert np.linalg.norm(direction / np.linalg.norm(direction) - DOWN) < np.radians(0.3)


def test_the_corrected_mounting_is_the_old_one_after_the_turn():
    rng = np.random.default_rng(1)
    rotation = rng.normal(size=4)
    rotation /= np.linalg.norm(rotation)
    turn, vector = np.array((0.0, 0.0, 0.05)), rng.normal(size=3)
    x, y, z = rotation_matrix(rotation.tolist()) @ vector
    expected = x * np.cos(0.05) - y * np.sin(0.05), y * np.cos(0.05) + x * np.sin(0.05), z
    np.testing.assert_allclose(rotation_matrix(turned(rotation.tolist(), turn)) @ vector, expected, atol=1e-12)


@pytest.mark.parametrize("side", SIDES)
def test_a_turn_in_the_arms_base_moves_gravity_as_in_the_trunk(side):
    turn, gravity = np.array((0.01, -0.02, 0.03)), gravity_in_trunk(0.2, 0.1)
    direction = np.array(Tilt.of_gravity(side, gravity).direction)
    moved = Tilt.of_gravity(side, gravity + np.cross(turn_in_trunk(PAPERS, side, turn), gravity)).direction
    np.testing.assert_allclose(np.cross(moved, direction + np.cross(turn, direction)), 0.0, atol=1e-12)


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


def test_the_heading_is_corrected_only_if_it_shows(tmp_path):
    params, arm = tmp_path / "exo.yaml", ARM
    params.write_text(FILE, encoding="utf-8")
    for pitches, is_shown in (((0.07, 0.07), False), ((0.07, -0.09), True)):
        observations = tours(Device(2), pitches)
        outcome = with_mounting(moments_from(arm, observations), params)
        (mounting,) = [change.value for change in outcome.changes if change.name == "rotation_trunk_from_imu"]
        for observation in observations[0], observations[-1]:
            pitch = pitches[bool(observation.load_mass)]
            left, forward, down = observation.direction * (-1.0, 1.0, -1.0)  # of a right arm's base, a mirror image
            moved = rotation_matrix(mounting) @ (forward, left, down)
            assert np.linalg.norm(moved - gravity_in_trunk(pitch, 0.2)) < np.radians(0.3)
        heading = np.arctan2(rotation_matrix(mounting)[1, 0], rotation_matrix(mounting)[0, 0])
        assert (abs(heading) > HEADING / 2.0) == is_shown
        assert (NO_HEADING in outcome.lines) != is_shown


def scaled(*factors):
    """Return observations of joints with these factors in their efforts: reversed, silent, or of another firmware."""
    return [one._replace(effort=np.multiply(one.effort, factors)) for one in Device(10).tour()]


@pytest.mark.parametrize(
    ("observations", "words"),
    [
        *(
            (lambda factor=factor: scaled(1, 1, factor, 1), "scale 3|do not fit|joint 3 needs")
            for factor in (-1.0, 0.0, 0.2, 5.0)
        ),
        (
            lambda: [
                *Device(11).tour(weighed=0),
                *(Device(11).observe(theta, weight=(0.002, 0.1)) for theta in best(LEANING, 4)),
            ],
            "a heavier one",
        ),
        (lambda: [*Device(12).tour()[:1], *scaled(1, np.nan, 1, 1)], "pose 2: effort"),
        (list, "no pose"),
    ],
)
def test_impossible_observations_are_refused_with_what_to_check(observations, words):
    with pytest.raises(DataError, match=words):
        identify(observations(), PAPERS)
