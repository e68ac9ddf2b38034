# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The page of a calibration: what it says, and what its numbers are."""

from __future__ import annotations

import datetime
from dataclasses import replace
from html import escape

import numpy as np
import pytest

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.lab.calibration.identification import fit_friction, identify
from exo_gravity.lab.calibration.moment_model import PapersMoments
from exo_gravity.lab.calibration.result import CalibrationResult, Change, page_of, remainders
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.moments import load_moments, regressor

DAY = datetime.date(2026, 11, 22)
DOWN = Tilt.of("right", 0.3, -0.2).direction
LOAD = (1.0, 0.25)  # kg, m from the elbow
FRICTION = np.array((0.12, 0.2, 0.12, 0.1))
POSES = np.radians(
    [
        (0, 10, 0, 20), (30, 60, 20, 30), (-40, 40, 60, 90), (20, 90, 0, 0), (0, 30, 90, 60), (-20, 70, 45, 110),
        (45, 100, 30, 45), (0, 50, 110, 20), (-60, 80, 10, 70), (10, 20, 40, 120), (30, 80, 60, 10), (-30, 60, 90, 30),
    ]
)  # fmt: skip


ROBOT = configured_arm().robot
PAPERS = PapersMoments(ROBOT, keeps_tilt=True)
#: The links of the configured arm, a fifth heavier, with centres of gravity off their axes.
TRUE = ArmModel.from_moments(ROBOT.length, 1.2 * np.array(ROBOT.first_moment), (0.004, -0.006, 0.003, 0.002))
LOADED = np.arange(len(POSES)) % 2 == 1  # every second pose has the weight on link 4


def predicted(arm: ArmModel) -> np.ndarray:
    """Return the torque (n, 4) in Nm that holds `arm` in each pose."""
    weight = regressor(POSES, DOWN) @ load_moments(arm.length, *LOAD)
    return gravity_torque(arm, POSES, DOWN) + LOADED[:, None] * weight


def outcome(outlier: int | None = None, **changes: object) -> CalibrationResult:
    """Return the result of a calibration of `TRUE`; outlier: a pose that somebody touched."""
    effort = predicted(TRUE) + 0.005 * np.random.default_rng(1).standard_normal(POSES.shape)
    if outlier is not None:
        effort[outlier] += 1.0
    taken = tuple(
        Observation(theta, DOWN, torque, FRICTION, np.full(4, 0.005), *(LOAD if loaded else (0.0, 0.0)))
        for theta, torque, loaded in zip(POSES, effort, LOADED, strict=True)
    )
    result = identify(taken, PAPERS)
    change = Change("/right/compensator", "robot.first_moment", result.moments.tolist(), "kg m, <±0.001>")
    found = CalibrationResult((change,), ("M4 is 20 % larger.",), (), configured_arm(), PAPERS, taken, result)
    return replace(found, **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def found() -> CalibrationResult:
    """The result of a calibration without outliers."""
    return outcome()


def remainders_of(result: CalibrationResult) -> tuple[np.ndarray, ...]:
    assert result.identified and result.arm
    return remainders(result.identified, result.arm, PAPERS, result.observations)


def test_the_page_compares_the_old_and_the_new_file_with_what_was_measured(found: CalibrationResult) -> None:
    old, new, *_ = remainders_of(found)
    measured = np.array([o.effort for o in found.observations])
    assert (measured - old) == pytest.approx(predicted(ROBOT))
    result = found.identified
    assert result is not None
    down = DOWN + np.cross(result.tilt, DOWN)  # the new file's mounting of the IMU
    joints = POSES[~LOADED] + result.turn[:, 0]  # as the new zeros show them
    unloaded = regressor(joints, down / np.linalg.norm(down)) @ result.in_file / result.scale
    assert (measured - new)[~LOADED] == pytest.approx(unloaded, abs=1e-3)
    assert np.abs(old).max() > 10.0 * np.abs(new).max()


def test_the_page_says_what_was_found_what_does_not_show_and_where_the_arm_creeps(found: CalibrationResult) -> None:
    page = page_of(found, "gravity", "old.yaml", DAY)
    assert "<h1>calibrate gravity, right arm</h1>" in page and "2026-11-22, from old.yaml" in page
    assert found.identified is not None
    for words in ("<b>Calibrated.</b>", "robot.first_moment", "kg m, &lt;±0.001&gt;", "M4 is 20 % larger.", "Singular"):
        assert words in page
    assert page.count("data:image/png;base64,") == 1
    assert all(escape(sentence) in page for sentence in found.identified.unknown)
    old, _, held_out, _ = remainders_of(found)
    creeping = [int((np.abs(wrong) > 0.2 * FRICTION).any(axis=1).sum()) for wrong in (old, held_out)]
    assert f"With 0.2 times that the arm creeps in {creeping[0]} of 12 poses" in page
    assert f"with the old file, in {creeping[1]} with the new" in page and ", in 0 with the new" in page


@pytest.mark.usefixtures("without_pictures")
def test_a_pose_that_was_left_out_is_not_counted() -> None:
    found = outcome(outlier=5)
    *_, used = remainders_of(found)
    assert np.flatnonzero(~used).tolist() == [5]
    assert " of 11 poses with the old file" in page_of(found, "gravity", "old.yaml", DAY)


def test_a_refusal_is_on_the_page_without_new_values(found: CalibrationResult) -> None:
    refused = replace(found, refusals=("pose 3 slipped",), identified=None)
    page = page_of(refused, "gravity", "old.yaml", DAY)
    assert "Not calibrated" in page and "<li>pose 3 slipped</li>" in page
    assert "robot.first_moment" not in page and "<img" not in page


def test_friction_is_drawn_over_speed_and_a_result_without_poses_is_its_values_alone() -> None:
    speed = np.array((0.3, 0.05, 0.1))
    curves = [
        fit_friction(speed, 0.1 + 0.02 * speed, np.full(len(speed), 0.002), np.zeros_like(speed)) for _ in range(4)
    ]
    comment = Change("/right/can_bridge", "", 0, "friction of the elbow")  # in the file alone
    found = CalibrationResult((comment,), (), (), configured_arm(), curves=tuple(curves))
    page = page_of(found, "friction", "old.yaml", DAY)
    assert page.count("<img") == 1 and "Friction over speed" in page and "friction of the elbow" in page
    change = Change("/imu", "rotation_trunk_from_imu", [0.0, 0.0, 0.0, 1.0])
    page = page_of(CalibrationResult((change,)), "imu", "old.yaml", DAY)
    assert "[0.0, 0.0, 0.0, 1.0]" in page and "<img" not in page
