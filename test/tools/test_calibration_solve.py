# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""From what a tour or a recording shows to the values of the new parameter file, or the reason for having none."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import pinocchio
import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.gravity import moments_of
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import settings_of
from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.numbers import COVER
from exo_gravity.core.params import values_of
from exo_gravity.lab.calibration import live
from exo_gravity.lab.calibration.tour import CALIBRATOR, tour_of
from exo_gravity.lab.calibration.tours import calibrate_scale, friction_from, moments_from
from exo_gravity.lab.calibration.wearer import wearer_from
from exo_gravity.lab.calibration.wearer_fit import fit_wearer
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.moments import load_moments, regressor
from exo_gravity.sim import ArmConfig, SimulatedArm

from ..support.chains import random_chain

ARM = configured_arm(packaged_config("sim.yaml"))
DOWN = Tilt.of("right", 0.3, -0.2).direction  # a tilted stand: joint 1 carries something too
POSES = np.random.default_rng(5).uniform((-1.0, 0.2, -0.3, 0.2), (1.0, 1.6, 1.5, 1.8), (12, 4))
TRUTH = ArmModel(
    ARM.robot.length, ARM.robot.cog * 0.9, ARM.robot.mass * (1.2, 0.9, 1.1, 0.8), gravity=ARM.robot.gravity
)
SCALES = np.array((0.9, 1.1, 0.85, 1.2))
NOISE = 0.003  # Nm
WORN = replace(ARM, compensator={**ARM.compensator, "wearer.body_mass": 70.0})
STILL = (0.0,) * 4
# Upper arm and forearm 3 and 2 cm beside the links, springs in joints 1, 3 and 4.
PERSON = ArmConfig(
    ArmModel(ARM.robot.length, ARM.robot.cog, ARM.robot.mass), wearer_mass=(0.0, 0.0, 2.1, 1.5),
    wearer_cog=(0.0, 0.0, 0.15, 0.2), wearer_cog_y=(0.0, 0.0, 0.03, -0.02), wearer_cog_z=(0.0, 0.0, -0.02, 0.02),
    wearer_stiffness=(1.5, 0.0, 0.8, 1.0), wearer_rest=(0.2, 0.0, 0.3, 0.9),
)  # fmt: skip
RANGE = (-0.3, 0.0, -0.4, 0.0), (0.5, 1.1, 1.2, 1.6)
WORN_POSES = np.random.default_rng(6).uniform(*RANGE, (8, 4))
WORN_POSES = np.vstack((WORN_POSES, WORN_POSES[:2]))
OTHER_POSES = np.random.default_rng(7).uniform(*RANGE, (30, 4))


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


def relaxed(config, carried=0.0):
    """Observations of a worn arm by MuJoCo, whose wearer carries a share of their arm."""
    arms = (config, replace(config, wearer_mass=STILL, wearer_stiffness=STILL), replace(config, wearer_stiffness=STILL))
    worn, bare, passive = (SimulatedArm(one) for one in arms)
    seen = []
    for number, theta in enumerate(WORN_POSES):
        weight = holding(passive, theta) - holding(bare, theta)
        effort = holding(worn, theta) - carried * weight + np.random.default_rng(number).normal(0.0, 0.05, 4)
        seen.append(Observation(theta, np.array((0.0, 0.0, 1.0)), effort, np.full(4, 0.2), np.full(4, NOISE)))
    return seen


def holding(arm, theta):
    """Return the torque (4,) in Nm that holds an arm upright, by MuJoCo."""
    arm.reset(theta)
    return arm.data.qfrc_bias - arm.data.qfrc_passive


def settings_from(result):
    """Return the compensator's settings with a result, for a wearer who is carried in full."""
    found = {change.name: change.value for change in result.changes}
    return settings_of({**WORN.compensator, "mode": "zero_g", "support": 1.0, **found})


def test_the_wearers_moments_and_springs_hold_their_arm_in_poses_that_were_not_measured():
    result = wearer_from(WORN, relaxed(PERSON), 0.0)
    settings, arm = settings_from(result), SimulatedArm(PERSON)
    weight = holding(arm, OTHER_POSES[0])
    assert result.refusals == () and value(result, "model_error.wearer") == 0.0
    assert "largest_moment [" in result.lines[-1] and "largest_addition " in result.lines[-1]
    unsure = np.hypot(0.05, value(result, "model_error.wearer_torque"))
    for pose in OTHER_POSES:
        off = settings.torque(pose, Tilt.of("right"))[0] - holding(arm, pose)
        assert np.all(np.abs(off) < 3.0 * unsure) and np.abs(off).max() < 0.04 * np.abs(weight).max()
    stiffness = value(result, "wearer.joint_stiffness")
    assert stiffness[:2] == pytest.approx((1.5, 0.0), abs=0.2) and stiffness[3] == pytest.approx(1.0, abs=0.3)


def test_a_wearer_who_carries_a_constant_share_looks_lighter_and_the_band_contains_it():
    result, relaxed_one = (wearer_from(WORN, relaxed(PERSON, share)) for share in (0.18, 0.0))
    assert result.refusals == ()  # nothing shows it
    light, true = (np.array(value(one, "wearer.first_moment"))[2:] for one in (result, relaxed_one))
    assert light == pytest.approx(0.82 * true, rel=0.05)
    assert np.all(true - light < COVER * value(result, "model_error.wearer") * light)


def test_an_implausible_wearer_and_too_few_poses_are_refused():
    with pytest.raises(DataError, match="4 different poses were measured, must be at least 5"):
        wearer_from(WORN, relaxed(PERSON)[:4])
    heavy = wearer_from(WORN, relaxed(replace(PERSON, wearer_mass=(0.0, 0.0, 3.8, 3.3))))
    assert any("implausible" in refusal for refusal in heavy.refusals)


def test_the_springs_of_an_arm_of_any_number_of_joints_are_found_beside_the_moments_of_its_links():
    text, _ = random_chain(5, seed=3)
    model = pinocchio.buildModelFromXML(text)
    rng, data = np.random.default_rng(4), model.createData()
    theta = rng.uniform(-0.8, 0.8, (12, 5))
    columns = np.array(
        [pinocchio.computeJointTorqueRegressor(model, data, pose, np.zeros(5), np.zeros(5))[:, 30:34] for pose in theta]
    )  # of the mass and the first moments of link 4 alone
    load, stiffness, rest = np.array((1.4, 0.2, -0.03, 0.05)), np.array((0.0, 1.2, 0.0, 0.6, 0.0)), np.full(5, 0.3)
    torque = columns @ load + stiffness * (theta - rest) + rng.normal(0.0, 0.01, theta.shape)
    known = np.diag(1.0 / np.array((1.0, 0.3, 0.1, 0.1))), np.zeros(4)
    fit = fit_wearer(columns, theta, torque, np.full(theta.shape, 0.01), known)
    assert fit.stiffness == pytest.approx(stiffness, abs=0.12) and not fit.stiffness[[0, 2, 4]].any()
    assert np.abs(fit.remainder).max() < 0.1
    assert np.all(fit.torque_error(columns, theta) < 0.1)


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
