# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The laws offline: the paper's comparison by `validate`, and `train_anfis`, which learns one."""

import math
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest

from exo_gravity.core import gravity_torque
from exo_gravity.core.errors import DataError
from exo_gravity.lab import anfis_training as anfis
from exo_gravity.lab import comparison
from exo_gravity.lab.anfis import AnfisLaw, text_of
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.references import PAPER_ANFIS
from exo_gravity.tools import validate

from ..support import csv_rows
from ..support import synthetic_bags as made

BRIDGE, COMPENSATOR = "/right/can_bridge", "/right/compensator"
# validate


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Exit code, printed text, folder and parts of a run with few poses and short training."""
    folder, evaluate = tmp_path_factory.mktemp("validation"), comparison.evaluate
    lines, parts = [], []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validate, "QUICK_COUNT", 20)
        patch.setattr(comparison, "FIGURE_GRID", (8, 8, 3))
        patch.setattr(anfis, "MAX_EVALUATIONS", 4)
        patch.setattr(comparison, "evaluate", lambda *given: parts.append(evaluate(*given)) or parts[-1])
        patch.setattr("builtins.print", lambda *parts, sep=" ", **_: lines.append(sep.join(map(str, parts))))
        code = validate.main(["--quick", "--output", str(folder)])
    return code, "\n".join(lines), folder, parts


def test_all_checks_hold_on_the_packaged_arm_and_a_table_and_figures_are_written(quick):
    code, printed, folder, _ = quick
    assert code == 0 and "FAILED" not in printed and printed.count("\nheld") == 4
    for name in ("workspace.png", "tilt.png"):
        assert matplotlib.image.imread(folder / name)[..., :3].std() > 0.05
    rows = csv_rows(folder / "laws.csv")
    assert len(rows) == 2 * 6 * 4 * 2 * 4  # cases, laws, references, joints
    assert max(float(row["largest"]) for row in rows if row["law"] == "exact") < 1e-12
    static = [row for row in rows if (row["cog"], row["law"], row["joint"]) == ("as configured", "EQ2-EQ5", "2")]
    assert float(static[0]["rmse"]) > 0.1  # the paper's law assumes the centres at the link ends


def test_each_check_can_fail_and_a_failed_one_is_printed_and_ends_with_1(quick, monkeypatch, tmp_path, run_tool):
    ends, part = quick[3]

    def failed(first, second):
        (sentence,) = [sentence for held, sentence in comparison.checks(first, second) if not held]
        return sentence

    off = np.array((0.0, 0.0, 1e-9, 0.0))  # a billionth of a newton metre
    rows = [row._replace(largest=off) if row.law == "exact" else row for row in part.rows]
    assert failed(ends, replace(part, rows=rows)).startswith("exact law")
    for kind in ("training", "held_out"):  # worse than the paper's on one joint
        law = replace(ends.law, error={**ends.law.error, kind: [1e-6, 1.33e-3, 1e-6]})
        assert failed(replace(ends, law=law), part).startswith("ANFIS")
    parts = iter(quick[3])
    monkeypatch.setattr(comparison, "evaluate", lambda *_: next(parts))
    monkeypatch.setattr(comparison, "write", lambda *_: [])
    monkeypatch.setattr(comparison, "checks", lambda *_: [(True, "ANFIS"), (False, "exact law")])
    ended = run_tool("validate", "--output", tmp_path)
    assert ended.code == 1 and "FAILED exact law" in ended.out


# train_anfis

RNG = np.random.default_rng(1)
SPREAD = RNG.uniform((-1.0, 0.0, -0.5, 0.0), (1.0, 1.5, 1.5, 1.5), (45, 4))


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    recording = made.trial(SPREAD, hold=2.6, rate=40.0)
    return made.write_bag(tmp_path_factory.mktemp("bags") / "spread", made.messages(recording, script=False))


@pytest.fixture
def recorded(params_with):
    """A parameter file of the arm that `synthetic_bags` records."""
    robot = {"mass": made.ARM.mass.tolist(), "cog": made.ARM.cog.tolist()}
    values = {"joint_names": [*made.NAMES], "link_length": made.ARM.length.tolist(), "robot": robot}
    return params_with("sim.yaml", {COMPENSATOR: values, BRIDGE: {"joint_names": [*made.NAMES]}})


@pytest.mark.thorough
def test_on_the_papers_positions_it_errs_less_than_the_paper_and_holds_the_arm_as_the_exact_law_anywhere():
    configured = configured_arm()
    samples = anfis.from_gravload(configured)
    law, _ = anfis.train_law(samples, configured.robot)
    assert (len(samples.angle), len(samples.held_out_angle)) == (1053, 12 * 8 * 8)
    assert np.all(np.array(law.error["training"]) < np.array(PAPER_ANFIS) / 10)
    assert np.all(np.array(law.error["held_out"]) < PAPER_ANFIS)
    theta = np.random.default_rng(2).uniform(configured.low, configured.high, (2000, 4))
    assert law.torques(theta[:, 1:]) == pytest.approx(gravity_torque(configured.robot, theta)[:, 1:], abs=2e-3)
    again = AnfisLaw.load(text_of(law))  # the reported errors are those of the saved law
    held_out = np.sqrt(np.mean((again.torques(samples.held_out_angle) - samples.held_out_torque) ** 2, axis=0))
    assert again.error["held_out"] == pytest.approx(held_out)


def test_a_function_that_the_model_can_express_is_learned_and_moving_the_premises_helps_with_others():
    inputs = RNG.uniform(-1, 1, (300, 2))
    assert anfis.train(inputs[:100], 1.0 + 2.0 * inputs[:100, 0] - inputs[:100, 1], 2).rmse < 1e-9
    output = np.sin(4 * inputs[:, 0]) * np.cos(3 * inputs[:, 1])
    assert anfis.train(inputs, output, 3).rmse < anfis.train(inputs, output, 3, most=1).rmse / 2
    with pytest.raises(DataError, match="at least 256"):  # fewer samples than consequents
        anfis.train(np.zeros((200, 3)), np.zeros(200), 4)


def test_from_a_recording_the_command_learns_the_torques_that_were_measured_and_says_what_it_was_trained_on(
    bag, recorded, tmp_path, run_tool
):
    words = ("train_anfis", "--params", recorded, "--bag", bag, "--output")
    saved = tmp_path / "new" / "folder" / "law.json"
    ended = run_tool(*words, saved)
    law = AnfisLaw.load(saved.read_text(encoding="utf-8"))
    inside = np.random.default_rng(3).uniform(law.low, law.high, (500, 3))
    exact = gravity_torque(made.ARM, np.pad(inside, ((0, 0), (1, 0))))[:, 1:]
    assert np.all(np.sqrt(np.mean((law.torques(inside) - exact) ** 2, axis=0)) < 0.15)
    assert law.first_moment == made.ARM.first_moment[1:] and "spread" in law.source
    assert "45 holds" in ended.out and f"{law.error['held_out'][0]:.2e}" in ended.out
    unwritten = run_tool(*words, tmp_path)
    assert unwritten.code == 2 and str(tmp_path) in unwritten.err


def test_too_few_poses_a_tilted_trunk_a_part_of_the_box_without_a_pose_and_another_arms_joints_are_refused(
    bag, tmp_path, recorded
):
    own, few = configured_arm(recorded), list(made.messages(made.trial(SPREAD[:8], hold=2.6, rate=40.0), script=False))
    tilted = [*few, *(made.tilt(0.1 * k, math.radians(5.0)) for k in range(400))]
    refused = [
        (made.write_bag(tmp_path / "few", few), own, 2, r"record holds there|samples"),
        (made.write_bag(tmp_path / "tilted", tilted), own, 2, "0 holds with an upright trunk"),
        (bag, own, 6, r"theta_2 \d/6.*record holds there"),
        (bag, configured_arm(), 2, "right_shoulder_rotation"),
    ]
    for recording, arm, functions, said in refused:
        with pytest.raises(DataError, match=said):
            anfis.from_bag(recording, arm, functions)
