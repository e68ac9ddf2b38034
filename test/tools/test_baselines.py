"""Laws without a model: what they are trained on, and what is measured of them."""

import csv
from functools import partial

import matplotlib.image
import numpy as np
import pytest

from exo_gravity.sim.baselines import Burden
from exo_gravity.tools.comparison import baselines
from exo_gravity.tools.comparison.tables import baseline_line
from exo_gravity.tools.comparison.validation import Validation
from exo_gravity.tools.inputs.arms import configured_arm


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The rows, the printed text and the folder of a study with few samples."""
    folder, rows, lines, asked = tmp_path_factory.mktemp("baselines"), [], [], []
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"SAMPLES": 300, "GAUSSIAN_SAMPLES": 80, "VERTICES": 3, "HELD_OUT": 100, "TIMED": 5}.items():
            patch.setattr(baselines, name, value)
        few = partial(baselines.MLPRegressor, max_iter=50)
        patch.setattr(baselines, "_network", lambda: few(hidden_layer_sizes=(16,), solver="lbfgs", random_state=0))
        burden = Burden(1.0, 0.1, 0.2)
        patch.setattr(baselines, "baseline_burden", lambda *given: asked.append(given) or burden)
        measure = baselines.baselines
        patch.setattr(baselines, "baselines", lambda arm: rows.extend(measure(arm)) or rows)
        patch.setattr("builtins.print", lambda *parts, **_: lines.append(" ".join(map(str, parts))))
        part = type("Part", (), {"configured": configured_arm()})
        written = Validation(part, part).measure_baselines(folder)
    assert written == ["baselines.csv", "baselines.png"]
    for pitch in (0.0, 0.1):  # a law gets angles in rad
        poses = [law((0.1, 0.5, 0.6, 0.7), pitch) for law, *_ in asked if law]
        assert all(np.allclose(torque, poses[0], atol=0.5) for torque in poses)
    assert [feedback for _, feedback, _ in asked][:4] == [False, True, False, True]
    return {row.law: row for row in rows}, "\n".join(lines), folder


def test_the_exact_law_is_exact_inside_and_outside_the_box_and_needs_no_training(study):
    exact = study[0]["exact law"]
    assert max(exact.inside_largest, exact.outside_largest) < 1e-12
    assert exact.training_time < 0.01 and exact.memory < 2_000


@pytest.mark.parametrize("law", ["cube map", "neural network", "Gaussian process", "gradient boosting"])
def test_a_law_without_a_model_is_worse_outside_its_box_than_inside(study, law):
    row = study[0][law]
    assert 1e-4 < row.inside_rmse < row.outside_rmse < row.outside_largest
    assert row.memory > 1_000 and row.pose_time > 0.0 and row.training_time > 0.0


def test_each_law_has_a_line_a_row_and_a_place_in_the_figure(study):
    rows, printed, folder = study
    assert all(baseline_line(row) in printed for row in rows.values())
    with (folder / "baselines.csv").open(encoding="utf-8") as file:
        assert [row["law"] for row in csv.DictReader(file)] == list(rows) and len(rows) == 8
    assert matplotlib.image.imread(folder / "baselines.png")[..., :3].std() > 0.05


def test_the_box_is_within_the_joint_limits_and_outside_is_beyond_it():
    configured, task = configured_arm(), baselines.Task(configured_arm())
    inside, outside = (task.middle[:4] + task.half[:4] * draw(1000, 0)[:, :4] for draw in (task.inside, task.outside))
    assert np.all(np.abs(task.outside(1000, 0)).max(axis=1) > 1.0)
    share = np.ptp(inside, axis=0) / (configured.high - configured.low)
    np.testing.assert_allclose(share, baselines.SHARE, atol=0.01)
    assert np.all((outside >= configured.low) & (outside <= configured.high))


def test_the_cube_map_is_exact_at_its_vertices_and_constant_beyond_the_box():
    task = baselines.Task(configured_arm())
    model, _ = baselines._cube_map(task)
    corners = np.array([[1.0, -1.0, 0.5, 0.0, -0.5, 1.0], [0.0] * 6])
    np.testing.assert_allclose(model(corners), task.torque(corners), atol=1e-12)
    np.testing.assert_allclose(model(1.5 * np.ones((1, 6))), model(np.ones((1, 6))))
