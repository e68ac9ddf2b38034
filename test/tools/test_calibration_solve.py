# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""From what a tour or a recording shows to the values of the new parameter file, or the reason for having none."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.gravity import load_moments, moments_of, regressor
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import wearer_of
from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.params import values_of
from exo_gravity.lab.calibration import live
from exo_gravity.lab.calibration.tour import CALIBRATOR, tour_of
from exo_gravity.lab.calibration.tours import calibrate_scale, friction_from, moments_from, wearer_from
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config

ARM = configured_arm(packaged_config("sim.yaml"))
DOWN = Tilt.of("right", 0.3, -0.2).direction  # a tilted stand: joint 1 carries something too
POSES = np.random.default_rng(5).uniform((-1.0, 0.2, -0.3, 0.2), (1.0, 1.6, 1.5, 1.8), (12, 4))
TRUTH = ArmModel(
    ARM.robot.length, ARM.robot.cog * 0.9, ARM.robot.mass * (1.2, 0.9, 1.1, 0.8), gravity=ARM.robot.gravity
)
SCALES = np.array((0.9, 1.1, 0.85, 1.2))
NOISE = 0.003  # Nm


def observed(arm=TRUTH, scales=SCALES, mass=0.0, lever=0.0, extra=0.0, seed=1, poses=POSES):
    """Observations of `arm` with motors of these true scales, a weight, and more moments."""
    load_of = load_moments(arm.length.tolist(), mass, lever) + extra
    torque = (regressor(poses, DOWN, arm.gravity) @ (moments_of(arm) + load_of)) / scales
    torque = torque + np.random.default_rng(seed).normal(0.0, NOISE, torque.shape)
    spread, slide = np.full(4, NOISE), np.array((0.2, 0.4, 0.2, 0.2))
    return [
        Observation(theta, np.array(DOWN), effort, slide, spread, mass, lever)
        for theta, effort in zip(poses, torque, strict=True)
    ]


def value(result, name):
    (found,) = [change.value for change in result.changes if change.name == name]
    return found


def test_the_old_torque_scale_and_law_and_gain_of_the_file_are_taken_over():
    bridge = {**ARM.can_bridge, "torque_scale": [0.5, 1.0, 1.0, 1.0]}
    compensator = {**ARM.compensator, "law": "paper_static", "gain": [1.1, 1.0, 1.0, 1.0]}
    result = moments_from(
        replace(ARM, can_bridge=bridge, compensator=compensator), observed() + observed(mass=1.0, lever=0.3)
    )
    assert value(result, "torque_scale")[0] == pytest.approx(0.5 * SCALES[0], rel=0.02)
    assert value(result, "law") == "exact" and value(result, "gain") == [1.0] * 4
    assert result.lines[-1].startswith("next best pose, if more is wanted: ")


def test_an_impossible_torque_scale_is_refused_and_names_the_joint():
    bridge = {**ARM.can_bridge, "torque_scale": [1.0, 2.0, 1.0, 1.0]}
    result = moments_from(replace(ARM, can_bridge=bridge), observed() + observed(mass=1.0, lever=0.3))
    assert any("abduction: torque_scale" in refusal and "from 0.2 to 2" in refusal for refusal in result.refusals)


def test_friction_of_each_joint_is_fitted_and_noted_in_the_file():
    speeds = (0.02, 0.05, 0.1, 0.18, 0.3)
    (one,) = observed(poses=POSES[:1])
    slide = np.array((0.2, 0.4, 0.1, 0.3))
    measured = [one._replace(friction=slide + 0.05 * speed, speed=speed) for speed in speeds]
    result = friction_from(ARM, measured)
    assert result.refusals == () and len(result.curves) == 4
    assert [change.name for change in result.changes] == [""] * 4
    assert "Coulomb 0.400" in result.changes[1].note and "viscous 0.050" in result.changes[1].note


def test_the_wearers_masses_are_what_the_robot_alone_does_not_explain():
    compensator = {**ARM.compensator, "wearer.body_mass": 70.0}
    arm = replace(ARM, compensator=compensator)
    mass, cog = (np.array(column) for column in wearer_of(compensator))
    worn = np.zeros(8)
    worn[:4] = ARM.robot.with_wearer(1.1 * mass, cog).first_moment
    worn[:4] -= ARM.robot.first_moment
    observations = observed(arm=ARM.robot, scales=np.ones(4), extra=worn, poses=POSES[:4])
    result = wearer_from(arm, observations)
    assert result.refusals == ()
    np.testing.assert_allclose(value(result, "wearer.mass"), 1.1 * mass, atol=0.05)
    assert any("110% of M3" in line for line in result.lines)


def test_an_implausible_wearer_is_refused():
    compensator = {**ARM.compensator, "wearer.body_mass": 70.0}
    arm = replace(ARM, compensator=compensator)
    with pytest.raises(DataError, match=r"is the arm relaxed|add a pose"):
        wearer_from(arm, observed(arm=ARM.robot, scales=np.ones(4), poses=POSES[:4]))
    with pytest.raises(DataError, match="at least 3"):
        wearer_from(arm, observed(poses=POSES[:2]))


def test_scale_needs_a_weight_that_shows():
    options = argparse.Namespace(mass=0.01, lever=0.3, bag=None)
    with pytest.raises(ParameterError, match="mass times lever"):
        calibrate_scale(options, ARM, print)


def test_the_calibrator_replaces_the_compensator_and_the_tour_takes_its_parameters():
    nodes = live.tour_parameters(packaged_config("sim.yaml"), ARM, {"tour.poses": 3})
    assert set(nodes) == {"/imu", "/right/can_bridge", "/right/simulator", "/right/calibrator"}
    given = nodes["/right/calibrator"]
    assert given["max_effort"] == list(ARM.limits.max_effort) and given["tour.poses"] == 3
    tour = tour_of(values_of(CALIBRATOR, given))
    assert np.all(np.isfinite(tour.wait((0.1, 0.2, 0.3, 0.4), Tilt.of("right"))))
    assert "/right/compensator" in load(packaged_config("sim.yaml"))
