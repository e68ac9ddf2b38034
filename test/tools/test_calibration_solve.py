"""From what a tour or a recording shows to the values of the new parameter file, or the reason why there are none."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.calibration.identification import Observation
from exo_gravity.core.calibration.params import CALIBRATOR, tour_of
from exo_gravity.core.compensation.params import wearer_of
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.model.moments import load_moments, moments_of, regressor
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.params import values_of
from exo_gravity.core.trial.recording import Recording
from exo_gravity.tools.calibration import live, recorded
from exo_gravity.tools.calibration.tours import calibrate_scale, friction_from, moments_from
from exo_gravity.tools.calibration.wearer import wearer_from, worn_arm
from exo_gravity.tools.inputs.arms import configured_arm
from exo_gravity.tools.inputs.parameter_file import load, packaged_config

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


def test_gravity_gives_moments_and_scales_up_to_a_common_factor():
    result = moments_from(ARM, observed())
    assert result.refusals == () and result.identified.relative
    found, scales = np.array(value(result, "robot.first_moment")), np.array(value(result, "torque_scale"))
    factor = scales[1] / SCALES[1]
    np.testing.assert_allclose(scales, factor * SCALES, rtol=0.05)
    np.testing.assert_allclose(found, factor * np.array(TRUTH.first_moment), atol=0.01)
    assert any("weight" in line for line in result.lines)


def test_a_known_weight_gives_true_scales_and_kilograms():
    result = moments_from(ARM, observed() + observed(mass=1.0, lever=0.3, seed=2))
    assert result.refusals == () and not result.identified.relative
    np.testing.assert_allclose(value(result, "torque_scale"), SCALES, rtol=0.02)
    np.testing.assert_allclose(value(result, "robot.first_moment"), TRUTH.first_moment, atol=0.005)


def test_the_old_torque_scale_and_law_and_gain_of_the_file_are_taken_over():
    bridge = {**ARM.can_bridge, "torque_scale": [0.5, 1.0, 1.0, 1.0]}
    compensator = {**ARM.compensator, "law": "paper_static", "gain": [1.1, 1.0, 1.0, 1.0]}
    result = moments_from(
        replace(ARM, can_bridge=bridge, compensator=compensator), observed() + observed(mass=1.0, lever=0.3)
    )
    assert value(result, "torque_scale")[0] == pytest.approx(0.5 * SCALES[0], rel=0.02)
    assert value(result, "law") == "exact" and value(result, "gain") == [1.0] * 4


def test_an_impossible_torque_scale_is_refused_and_names_the_joint():
    bridge = {**ARM.can_bridge, "torque_scale": [1.0, 2.0, 1.0, 1.0]}
    result = moments_from(replace(ARM, can_bridge=bridge), observed() + observed(mass=1.0, lever=0.3))
    assert any("abduction: torque_scale" in refusal and "from 0.2 to 2" in refusal for refusal in result.refusals)


def test_too_few_poses_are_refused_and_the_trouble_of_the_tour_comes_first():
    result = moments_from(ARM, observed(poses=POSES[:2]), ("elbow: a hand.",))
    assert result.refusals[0] == "elbow: a hand." and len(result.refusals) == 2
    assert result.changes == () and len(result.observations) == 2


def test_friction_of_each_joint_is_fitted_and_noted_in_the_file():
    speeds = (0.02, 0.05, 0.1, 0.18, 0.3)
    (one,) = observed(poses=POSES[:1])
    slide = np.array((0.2, 0.4, 0.1, 0.3))
    measured = [one._replace(friction=slide + 0.05 * speed, speed=speed) for speed in speeds]
    result = friction_from(ARM, measured)
    assert result.refusals == () and len(result.curves) == 4
    assert [change.name for change in result.changes] == [""] * 4
    assert "Coulomb 0.400" in result.lines[1] and "viscous 0.050" in result.lines[1]
    assert friction_from(ARM, measured[:1]).refusals


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
    nobody = wearer_from(arm, observed(arm=ARM.robot, scales=np.ones(4), poses=POSES[:4]))
    assert nobody.refusals and nobody.changes == ()
    with pytest.raises(DataError, match="at least 3"):
        worn_arm(arm, observed(poses=POSES[:2]), np.array((0.16, 0.18)))


def sweep_recording(held=False):
    """A recording of slow sweeps there and back through poses with friction, and of held poses."""
    time, position, effort, now = [], [], [], 0.0
    for pose in POSES[:6]:
        for sign in (1.0, -1.0) if not held else (0.0,):
            way = np.linspace(-0.06, 0.06, 120) * sign if not held else np.zeros(300)
            angles = pose + way[:, None]
            torque = gravity_torque(TRUTH, angles, DOWN) + sign * np.array((0.2, 0.4, 0.2, 0.2))
            time.append(now + 0.01 * np.arange(len(way)))
            position.append(angles)
            effort.append(torque)
            now = time[-1][-1] + 0.01
        now += 5.0
    columns = [np.concatenate(rows) for rows in (position, effort)]
    nothing = np.full_like(columns[0], np.nan)
    return Recording("right", ARM.joint_names, np.concatenate(time), columns[0], nothing, columns[1], nothing)


def test_a_recording_of_slow_sweeps_gives_gravity_and_friction():
    upright = replace(ARM, compensator={**ARM.compensator, "use_imu": False})
    found = list(recorded._sweeps(sweep_recording(), upright, None))
    assert len(found) == 6
    torque = gravity_torque(TRUTH, [o.theta for o in found], DOWN)
    np.testing.assert_allclose([o.effort for o in found], torque, atol=0.005)
    np.testing.assert_allclose([o.friction for o in found], np.tile((0.2, 0.4, 0.2, 0.2), (6, 1)), atol=0.03)


def test_a_held_pose_is_as_uncertain_as_friction():
    upright = replace(ARM, compensator={**ARM.compensator, "use_imu": False})
    found = list(recorded._held(sweep_recording(held=True), upright, None, []))
    assert len(found) == 6
    assert np.min([o.spread for o in found]) > 0.2
    np.testing.assert_allclose([o.theta for o in found], POSES[:6], atol=1e-3)


def test_scale_needs_a_weight_that_shows():
    options = argparse.Namespace(mass=0.01, lever=0.3, bag=None)
    with pytest.raises(ParameterError, match="mass times lever"):
        calibrate_scale(options, ARM, print)


def test_the_calibrator_replaces_the_compensator_and_the_tour_takes_its_parameters():
    nodes = live.tour_parameters(packaged_config("sim.yaml"), ARM, {"tour.poses": 3})
    assert set(nodes) == {"/imu", "/right/can_bridge", "/right/simulator", "/right/calibrator"}
    given = nodes["/right/calibrator"]["ros__parameters"]
    assert given["max_effort"] == list(ARM.limits.max_effort) and given["tour.poses"] == 3
    tour = tour_of(values_of(CALIBRATOR, given))
    assert np.all(np.isfinite(tour.wait((0.1, 0.2, 0.3, 0.4), Tilt.of("right"))))
    assert "/right/compensator" in load(packaged_config("sim.yaml"))


def test_lines_of_the_calibrator_are_followed_and_observations_are_kept(tmp_path):
    record, said, tour = tmp_path / "new.jsonl", [], live.LiveTour()
    values = {"theta": [0.0] * 4, "direction": [0, 0, 1], "effort": [1.0] * 4, "friction": [0.1] * 4}
    values |= {"spread": [0.01] * 4, "load_mass": 0.0, "load_lever": 0.0, "speed": 0.1}
    for event in ({"progress": "pose 1"}, {"observation": values}, {"trouble": "elbow: a hand"}, {"done": True}):
        tour.follow(json.dumps(event), record, said.append)
    tour.follow('{"half": ', record, said.append)
    assert said == ["pose 1"] and tour.trouble == "elbow: a hand" and tour.done
    assert tour.measured[0].speed == 0.1 and json.loads(record.read_text())["observation"] == values
    (refusal,) = tour.refusals(record)
    assert "1 observations are kept" in refusal
