# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Training an ANFIS: it converges, beats the paper, learns from a recording, and refuses too little of one."""

import math

import numpy as np
import pytest
import yaml

from exo_gravity.core import gravity_torque
from exo_gravity.core.arm.anfis import AnfisLaw
from exo_gravity.core.errors import DataError
from exo_gravity.lab.anfis_file import text_of
from exo_gravity.lab.anfis_training import RIDGE, Projection, from_bag, from_gravload, train, train_law
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.references import PAPER_ANFIS
from exo_gravity.tools.train_anfis import main

from ..support import synthetic_bags as made

RNG = np.random.default_rng(1)
SPREAD = RNG.uniform((-1.0, 0.0, -0.5, 0.0), (1.0, 1.5, 1.5, 1.5), (45, 4))


def params_file(folder):
    """A parameter file of the arm that `synthetic_bags` records."""
    values = {"side": "right", "joint_names": list(made.NAMES), "link_length": made.ARM.length.tolist()}
    values["robot"] = {"mass": made.ARM.mass.tolist(), "cog": made.ARM.cog.tolist()}
    path = folder / "arm.yaml"
    bridge = {"can": {"interface": "virtual", "channel": "test"}}
    content = {"/right/compensator": {"ros__parameters": values}, "/right/can_bridge": {"ros__parameters": bridge}}
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def learned():
    """The packaged arm's samples and the law trained on them."""
    configured = configured_arm()
    samples = from_gravload(configured)
    return configured, samples, train_law(samples, configured.robot)[0]


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    recording = made.trial(SPREAD, hold=2.6, rate=40.0)
    return made.write_bag(tmp_path_factory.mktemp("bags") / "spread", made.messages(recording, script=False))


@pytest.fixture
def recorded(tmp_path):
    return configured_arm(params_file(tmp_path))


@pytest.mark.thorough
def test_on_the_papers_positions_it_errs_less_than_the_paper_and_holds_the_arm_as_the_exact_law_anywhere(learned):
    configured, samples, law = learned
    assert (len(samples.angle), len(samples.held_out_angle)) == (1053, 12 * 8 * 8)
    assert np.all(np.array(law.error["training"]) < np.array(PAPER_ANFIS) / 10)
    assert np.all(np.array(law.error["held_out"]) < PAPER_ANFIS)
    theta = np.random.default_rng(2).uniform(configured.low, configured.high, (2000, 4))
    assert law.torques(theta[:, 1:]) == pytest.approx(gravity_torque(configured.robot, theta)[:, 1:], abs=2e-3)
    again = AnfisLaw.load(text_of(law))  # the reported errors are those of the saved law
    held_out = np.sqrt(np.mean((again.torques(samples.held_out_angle) - samples.held_out_torque) ** 2, axis=0))
    assert again.error["held_out"] == pytest.approx(held_out)


def test_the_projected_gradient_is_that_of_finite_differences():
    inputs = RNG.uniform(-1, 1, (60, 2))
    problem = Projection(inputs, np.sin(3 * inputs[:, 0]) * inputs[:, 1], 3, RIDGE)
    premises = np.concatenate((RNG.uniform(-1, 1, 6), RNG.uniform(-0.3, 0.3, 6)))

    def cost(at):
        return 0.5 * np.sum(problem.residual(at) ** 2)

    numeric = [(cost(premises + step) - cost(premises - step)) / 2e-6 for step in 1e-6 * np.eye(12)]
    gradient = problem.jacobian(premises).T @ problem.residual(premises)
    assert gradient == pytest.approx(np.array(numeric), rel=1e-4, abs=1e-8)


def test_a_function_that_the_model_can_express_is_learned_and_moving_the_premises_helps_with_others():
    inputs = RNG.uniform(-1, 1, (300, 2))
    assert train(inputs[:100], 1.0 + 2.0 * inputs[:100, 0] - inputs[:100, 1], 2).rmse < 1e-9
    output = np.sin(4 * inputs[:, 0]) * np.cos(3 * inputs[:, 1])
    assert train(inputs, output, 3).rmse < train(inputs, output, 3, max_evaluations=1).rmse / 2
    with pytest.raises(DataError, match="at least 256"):  # fewer samples than consequents
        train(np.zeros((200, 3)), np.zeros(200), 4)


def test_gains_of_the_arm_do_not_change_what_is_learned(tmp_path):
    content = yaml.safe_load(params_file(tmp_path).read_text(encoding="utf-8"))
    content["/right/compensator"]["ros__parameters"]["gain"] = [0.0, 0.5, 1.0, 2.0]
    (tmp_path / "gain.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    with_gain, without = (from_gravload(configured_arm(tmp_path / name)) for name in ("gain.yaml", "arm.yaml"))
    assert np.array_equal(with_gain.torque, without.torque)


def test_from_a_recording_it_learns_the_torques_that_were_measured(bag, recorded):
    law, _ = train_law(from_bag(bag, recorded, 2), recorded.robot, 2, ridge=0.03)
    inside = np.random.default_rng(3).uniform(law.low, law.high, (500, 3))
    exact = gravity_torque(made.ARM, np.pad(inside, ((0, 0), (1, 0))))[:, 1:]
    assert np.all(np.sqrt(np.mean((law.torques(inside) - exact) ** 2, axis=0)) < 0.15)


def test_the_box_is_that_of_the_poses_held_and_every_fifth_hold_is_kept_for_the_check(bag, recorded):
    samples = from_bag(bag, recorded, 2)
    assert samples.low == pytest.approx(SPREAD[:, 1:].min(axis=0), abs=0.01)
    assert samples.high == pytest.approx(SPREAD[:, 1:].max(axis=0), abs=0.01)
    assert (len(samples.angle), len(samples.held_out_angle)) == (36, 9)


def test_too_few_poses_a_part_of_the_box_without_one_and_another_arms_joints_are_refused(bag, tmp_path, recorded):
    few = made.messages(made.trial(SPREAD[:8], hold=2.6, rate=40.0), script=False)
    with pytest.raises(DataError, match=r"record holds there|samples"):
        from_bag(made.write_bag(tmp_path / "few", few), recorded, 2)
    with pytest.raises(DataError, match=r"theta_2 \d/6.*record holds there"):
        from_bag(bag, recorded, 6)
    with pytest.raises(DataError, match="right_shoulder_rotation"):
        from_bag(bag, configured_arm(), 2)


def test_holds_on_a_tilted_trunk_are_left_out(tmp_path, recorded):
    states = made.messages(made.trial(SPREAD[:8], hold=2.6, rate=40.0), script=False)
    tilted = [made.tilt(0.1 * k, math.radians(5.0)) for k in range(400)]
    folder = made.write_bag(tmp_path / "tilted", [*states, *tilted])
    with pytest.raises(DataError, match="0 holds with an upright trunk"):
        from_bag(folder, recorded, 2)


def test_the_command_saves_a_law_that_loads_and_says_what_it_was_trained_on(bag, tmp_path, capsys):
    saved, words = tmp_path / "new" / "folder" / "law.json", ["--params", str(params_file(tmp_path)), "--bag", str(bag)]
    main([*words, "--output", str(saved)])
    law = AnfisLaw.load(saved.read_text(encoding="utf-8"))
    printed = capsys.readouterr().out
    assert law.first_moment == made.ARM.first_moment[1:] and "spread" in law.source
    assert "45 holds" in printed and f"{law.error['held_out'][0]:.2e}" in printed
    assert main([*words, "--output", str(tmp_path)]) == 2  # it cannot be written
    assert str(tmp_path) in capsys.readouterr().err
