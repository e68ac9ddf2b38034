# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The paper's comparison: references, cases, figures of merit, and the command from parameter file to exit code."""

import math
import sys
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
import yaml

from exo_gravity.core import ArmModel
from exo_gravity.core.errors import ParameterError
from exo_gravity.lab import anfis_training as anfis
from exo_gravity.lab import comparison
from exo_gravity.lab.inputs.arms import configured_arm, with_cog_at_link_ends
from exo_gravity.lab.inputs.references import REFERENCES
from exo_gravity.tools import validate

from ..support import csv_rows

DOWN = np.array(((0.0, 0.0, 1.0),))


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Exit code, printed text, folder and parts of a run with few poses and short training."""
    folder = tmp_path_factory.mktemp("validation")
    lines, parts, evaluate = [], [], comparison.evaluate
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validate, "QUICK_COUNT", 60)
        patch.setattr(comparison, "FIGURE_GRID", (8, 8, 3))
        patch.setattr(anfis, "MAX_EVALUATIONS", 4)
        patch.setattr(comparison, "evaluate", lambda *given: parts.append(evaluate(*given)) or parts[-1])
        patch.setattr("builtins.print", lambda *parts, sep=" ", **_: lines.append(sep.join(map(str, parts))))
        code = validate.main(["--quick", "--output", str(folder)])
    return code, "\n".join(lines), folder, parts


def write_params(folder, arm, bridge=None):
    """Write a parameter file of one arm: its compensator's parameters, and those of its bridge beyond the CAN bus."""
    bus = {"can": {"interface": "virtual", "channel": "test"}}
    content = {
        "/right/compensator": {"ros__parameters": arm},
        "/right/can_bridge": {"ros__parameters": {**bus, **(bridge or {})}},
    }
    path = folder / "arm.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


@pytest.mark.parametrize("name", list(REFERENCES))
def test_a_reference_gives_the_torque_of_a_straight_horizontal_arm_by_hand(name):
    arm = ArmModel((0.05, 0.13, 0.3, 0.3), (0.05, 0.1, 0.2, 0.15), (0.5, 0.4, 0.6, 0.2), gravity=10.0)
    sideways = np.array(((0.4, math.pi / 2, 0.0, 0.0),))
    elbow = 10.0 * 0.2 * 0.15
    shoulder = 10.0 * (0.4 * 0.1 + 0.6 * (0.13 + 0.2) + 0.2 * (0.13 + 0.3 + 0.15))
    assert REFERENCES[name](arm)(sideways, DOWN)[0] == pytest.approx((0.0, shoulder, 0.0, 0.0), abs=1e-12)
    forward = np.array(((0.4, 0.0, math.pi / 2, 0.0),))
    assert REFERENCES[name](arm)(forward, DOWN)[0, 3] == pytest.approx(elbow, abs=1e-12)


@pytest.mark.parametrize("name", list(REFERENCES))
def test_a_reference_scales_with_the_gains(name):
    configured = configured_arm()
    arm = replace(configured.robot, gain=(0.5, 1.0, 1.5, 2.0))
    pose = np.array(((0.3, 0.5, 0.7, 0.9),))
    assert REFERENCES[name](arm)(pose, DOWN) == pytest.approx(REFERENCES[name](configured.robot)(pose, DOWN) * arm.gain)


def test_a_reference_that_is_not_installed_is_named_with_what_installs_it(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    monkeypatch.setattr(anfis, "MAX_EVALUATIONS", 1)
    with pytest.raises(SystemExit) as ended:
        validate.main(["--quick", "--output", str(tmp_path)])
    error = capsys.readouterr().err
    assert ended.value.code == 2 and "pinocchio" in error and "'.[report,validate]'" in error


def test_the_first_case_is_the_papers_positions_and_the_others_turn_joint_1_and_tilt_the_trunk_within_limits():
    configured = configured_arm()
    first, *others = comparison.cases("", configured, 500)
    assert len(np.unique(first.theta, axis=0)) == len(first.theta) == 13 * 9 * 9
    assert all(tilt.axis_angle == 0 for tilt in first.tilts) and np.all(first.theta[:, 0] == 0)
    assert [case.limit for case in others] == [0, 5, 10, 20, 30]
    for case in others:
        assert np.all((case.theta >= configured.low) & (case.theta <= configured.high)) and np.ptp(case.theta[:, 0]) > 3
        for angle in ("beta", "phi"):
            largest = max(abs(getattr(tilt, angle)) for tilt in case.tilts)
            assert largest == pytest.approx(math.radians(case.limit), rel=0.05)


def test_rmse_largest_error_and_torque_are_those_of_a_known_error():
    case = next(comparison.cases("", configured_arm(), 10))
    expected = np.full((1053, 4), 2.0)
    given = expected + 0.1
    given[0, 2] += 1.0
    (row,) = comparison.compare(case, {"law": given}, "reference", expected)
    assert (row.rmse[0], row.largest[0], row.rms_torque[0]) == pytest.approx((0.1, 0.1, 2.0))
    assert row.largest[2] == pytest.approx(1.1)


def test_the_papers_assumptions_are_cog_at_link_ends_gain_1_and_its_own_gravity():
    arm = with_cog_at_link_ends(ArmModel((0.1,) * 4, (0.05,) * 4, (1.0,) * 4, (0.5,) * 4))
    assert np.array_equal(arm.cog, arm.length) and arm.gravity == 9.8 and np.all(arm.gain == 1)


def test_the_arm_is_read_from_dotted_and_nested_names_and_its_limits_from_the_bridge_beside_it(tmp_path):
    mass, cog = [0.1, 0.2, 0.3, 0.4], [0.01, 0.02, 0.03, 0.04]
    limits = {"position_min": [-1.0, 0.0, 0.0, 0.0], "position_max": [1.0, 1.5, 1.5, 2.0]}
    for named in ({"robot": {"mass": mass, "cog": cog}}, {"robot.mass": mass, "robot.cog": cog}):
        found = configured_arm(write_params(tmp_path, {**named, "gravity": 9.8}, limits))
        assert found.robot == ArmModel((0.05, 0.13, 0.3, 0.3), cog, mass, gravity=9.8)
        assert found.high.tolist() == limits["position_max"]


@pytest.mark.parametrize(
    ("arm", "bridge", "named"),
    [
        ({"robot.mass": [1.0, 2.0, 3.0]}, None, "^/right/compensator robot.mass = .* must be 4"),
        ({}, {"positions_min": [0.0, 0.0, 0.0, 0.0]}, "^/right/can_bridge positions_min"),
        ({}, {"position_min": [2.0, 2.0, 2.0, 2.0], "position_max": [1.0, 1.0, 1.0, 1.0]}, "position_min"),
        ({"side": "left"}, None, "right"),
    ],
)
def test_an_impossible_arm_is_refused_by_the_name_of_the_parameter(arm, bridge, named, tmp_path):
    with pytest.raises(ParameterError, match=named):
        configured_arm(write_params(tmp_path, arm, bridge))


def test_all_checks_hold_on_the_packaged_arm_and_a_table_and_figures_are_written(quick):
    code, printed, folder, _ = quick
    assert code == 0
    assert "FAILED" not in printed and printed.count("\nheld") == 4
    for name in ("workspace.png", "tilt.png"):
        assert matplotlib.image.imread(folder / name)[..., :3].std() > 0.05
    rows = csv_rows(folder / "laws.csv")
    assert len(rows) == 2 * 6 * 4 * 2 * 4  # cases, laws, references, joints
    assert max(float(row["largest"]) for row in rows if row["law"] == "exact") < 1e-12
    static = [row for row in rows if (row["cog"], row["law"], row["joint"]) == ("as configured", "EQ2-EQ5", "2")]
    assert float(static[0]["rmse"]) > 0.1  # the paper's law assumes the centres at the link ends


def test_each_check_can_fail_and_a_failed_one_is_printed_and_ends_with_1(quick, monkeypatch, tmp_path, capsys):
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
    assert validate.main(["--output", str(tmp_path)]) == 1
    assert "FAILED exact law" in capsys.readouterr().out
