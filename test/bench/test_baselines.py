# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Controllers in place of the compensator, and laws without a model: what they cost, and what is measured of them."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest

from bench.baselines import __main__ as study
from bench.baselines import controllers, learned
from bench.baselines.controllers import HELD, INTEGRAL, STIFFNESS, Burden, Controlled, Feedforward, burden
from bench.baselines.growth import growth, sizes
from bench.effort.exertion import REACH
from exo_gravity.core import Tilt, gravity_torque
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS

MOTORS_OF_ARM = configured_arm().motors
POSE = (0.1, 0.9, 0.6, 0.7)
STILL = (0.0,) * 4
MOST = (9.0, 18.0, 9.0, 9.0)
SHORT = replace(REACH, poses=REACH.poses[:4])


def law(theta, pitch):
    return gravity_torque(DEFAULT_LINKS, theta, Tilt.of("right", pitch).direction).tolist()


def make_device():
    return SimulatedDevice(SimulatedArm(), [SimulatedMotor(motor) for motor in MOTORS_OF_ARM])


@pytest.fixture(scope="module")
def burdens():
    chosen = {
        "nothing": Feedforward(None, False),
        "PID": Feedforward(None, True),
        "law": Feedforward(law, False),
        "both": Feedforward(law, True),
        "upright law": Feedforward(lambda theta, _pitch: law(theta, 0.0), False),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(controllers, "RELEASED", 2.0)
        return {name: burden(make_device, MOTORS_OF_ARM, given, HELD[1:2], SHORT) for name, given in chosen.items()}


def test_a_pid_costs_the_wearer_far_more_than_an_arm_without_any_torque(burdens):
    assert burdens["PID"].exertion > 5.0 * burdens["nothing"].exertion > 5.0 * burdens["law"].exertion
    assert burdens["both"].exertion > 5.0 * burdens["law"].exertion


def test_a_pid_sags_until_its_integral_carries_the_arm_and_a_law_does_not(burdens):
    assert np.degrees(burdens["nothing"].sag) > 20.0 and np.degrees(burdens["PID"].sag) > 2.0
    assert np.degrees(burdens["law"].sag) < 0.1 and np.degrees(burdens["both"].sag) < 0.1


def test_a_law_that_takes_a_bowed_trunk_for_upright_lets_the_arm_sag(burdens):
    assert np.degrees(burdens["law"].sag_bowed) < 0.1
    assert np.degrees(burdens["upright law"].sag) < 0.1 and np.degrees(burdens["upright law"].sag_bowed) > 2.0


def test_a_slow_law_keeps_the_torque_of_an_earlier_pose_until_it_has_a_new_one():
    slow = Controlled(Feedforward(lambda theta, _: (theta[0], 0.0, 0.0, 0.0), False, 0.01), MOST)
    given = [slow.torque(0.004 * n, (float(n), 0.0, 0.0, 0.0), STILL)[0] for n in range(7)]
    assert given == [0.0, 0.0, 0.0, 3.0, 3.0, 3.0, 6.0]


def test_a_pid_pulls_towards_where_it_began_with_an_integral_that_ends_at_the_peak_torque():
    pid, below = Controlled(Feedforward(None, True), MOST), np.subtract(POSE, 0.1).tolist()
    assert pid.torque(0.0, POSE, STILL) == STILL
    pid.torque(0.5, below, STILL)
    assert pid.torque(1.0, below, STILL) == pytest.approx(0.1 * np.array(STIFFNESS) + 0.1 * np.array(INTEGRAL))
    for n in range(200):
        torque = pid.torque(1.0 + n, below, STILL)
    assert torque == pytest.approx(MOST)
    for n in range(2):
        torque = pid.torque(201.0 + n, np.add(POSE, 1.0).tolist(), STILL)
    assert max(torque) < 0.0


def test_the_torque_is_limited_to_what_the_motors_give():
    peaks = tuple(motor.peak_effort for motor in MOTORS_OF_ARM)
    strong = Controlled(Feedforward(lambda *_: [99.0, -99.0, 1.0, 0.0], False), peaks)
    assert strong.torque(0.0, POSE, STILL) == (peaks[0], -peaks[1], 1.0, 0.0)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """The rows of a study with few samples."""
    folder, asked = tmp_path_factory.mktemp("baselines"), []
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"SAMPLES": 300, "GAUSSIAN_SAMPLES": 80, "VERTICES": 3, "HELD_OUT": 100, "TIMED": 5}.items():
            patch.setattr(learned, name, value)
        few = {"hidden_layer_sizes": (16,), "solver": "lbfgs", "random_state": 0, "max_iter": 50}
        patch.setattr(learned, "network", lambda: learned.MLPRegressor(**few))
        patch.setattr(learned, "baseline_burden", lambda *given: asked.append(given) or Burden(1.0, 0.1, 0.2))
        study.measure_learned(configured_arm(), folder)
    for pitch in (0.0, 0.1):  # a law gets angles in rad
        poses = [given((0.1, 0.5, 0.6, 0.7), pitch) for given, *_ in asked if given]
        assert all(np.allclose(torque, poses[0], atol=0.5) for torque in poses)
    assert [feedback for _, feedback, _ in asked][:4] == [False, True, False, True]
    assert (folder / "baselines.png").exists()
    with (folder / "baselines.csv").open(encoding="utf-8") as file:
        return {row.pop("law"): {name: float(value) for name, value in row.items()} for row in csv.DictReader(file)}


def test_the_exact_law_is_exact_inside_and_outside_the_box_and_needs_no_training(rows):
    exact = rows["exact law"]
    assert max(exact["inside_largest"], exact["outside_largest"]) < 1e-12
    assert exact["memory"] < 2_000 and len(rows) == 8


@pytest.mark.parametrize("law", ["cube map", "neural network", "Gaussian process", "gradient boosting"])
def test_a_law_without_a_model_is_worse_outside_its_box_than_inside(rows, law):
    row = rows[law]
    assert 1e-4 < row["inside_rmse"] < row["outside_rmse"] < row["outside_largest"]
    assert row["memory"] > 1_000 and row["pose_time"] > 0.0 and row["training_time"] > 0.0


def test_the_box_is_within_the_joint_limits_and_outside_is_beyond_it():
    configured, space = configured_arm(), learned.Workspace(configured_arm())
    inside, outside = (
        space.middle[:4] + space.half[:4] * draw(1000, 0)[:, :4] for draw in (space.inside, space.outside)
    )
    assert np.all(np.abs(space.outside(1000, 0)).max(axis=1) > 1.0)
    share = np.ptp(inside, axis=0) / (configured.high - configured.low)
    np.testing.assert_allclose(share, learned.SHARE, atol=0.01)
    assert np.all((outside >= configured.low) & (outside <= configured.high))


def test_the_cube_map_is_exact_at_its_vertices_and_constant_beyond_the_box():
    space = learned.Workspace(configured_arm())
    model, _ = learned.cube_map(space)
    corners = np.array([[1.0, -1.0, 0.5, 0.0, -0.5, 1.0], [0.0] * 6])
    np.testing.assert_allclose(model(corners), space.torque(corners), atol=1e-12)
    np.testing.assert_allclose(model(1.5 * np.ones((1, 6))), model(np.ones((1, 6))))


def test_growth_is_measured_from_2_to_6_inputs_with_rules_parameters_and_positions_of_each():
    assert {inputs for _, inputs in sizes()} == {2, 3, 4, 5, 6}
    row = growth(configured_arm(), 2, 3)
    assert (row.rules, row.parameters, row.positions) == (8, 8 * 4 + 2 * 3 * 2, 5**3)
    assert row.training_time > 0 and row.inference_time > 0 and 0 < row.held_out_rmse < 1
