"""The page of a calibration: what it says, and what its numbers are."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import replace
from html import escape

import numpy as np
import pytest

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import gravity_torque, load_moments, regressor
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.lab.calibration.identification import fit_friction, identify
from exo_gravity.lab.calibration.result import CalibrationResult, Change, page_of, remainders
from exo_gravity.lab.inputs.arms import configured_arm

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


def true_arm() -> ArmModel:
    """An arm with the links of the configured one, a fifth heavier, and with centres of gravity off the links' axes."""
    robot = configured_arm().robot
    return ArmModel.from_moments(robot.length, 1.2 * np.array(robot.first_moment), (0.004, -0.006, 0.003, 0.002))


def observations(poses: np.ndarray = POSES, outlier: int | None = None) -> tuple[Observation, ...]:
    """Observations of `true_arm`, every second pose with a weight on link 4."""
    rng, arm = np.random.default_rng(1), true_arm()
    taken = []
    for number, theta in enumerate(poses):
        load = LOAD if number % 2 else (0.0, 0.0)
        weight = regressor(theta, DOWN)[0] @ load_moments(arm.length, *load)
        effort = gravity_torque(arm, theta, DOWN) + weight + 0.005 * rng.standard_normal(4)
        if number == outlier:
            effort = effort + 1.0
        taken.append(Observation(theta, DOWN, effort, FRICTION, np.full(4, 0.005), *load))
    return tuple(taken)


def outcome(outlier: int | None = None, **changes: object) -> CalibrationResult:
    taken, arm = observations(outlier=outlier), configured_arm()
    result = identify(taken, arm.robot.length)
    found = CalibrationResult(
        (Change("/right/compensator", "robot.first_moment", result.moments[:4].tolist(), "kg m, <±0.001>"),),
        ("M4 is 20 % larger than in the file.",),
        (),
        arm,
        taken,
        result,
    )
    return replace(found, **changes)  # type: ignore[arg-type]


def remainders_of(result: CalibrationResult) -> tuple[np.ndarray, ...]:
    assert result.identified and result.arm
    return remainders(result.identified, result.arm, result.observations)


def test_the_page_compares_the_old_and_the_new_file_with_what_was_measured() -> None:
    found = outcome()
    old, new, *_ = remainders_of(found)
    measured = np.array([o.effort for o in found.observations])
    unloaded = slice(0, None, 2)
    expected = gravity_torque(configured_arm().robot, POSES[unloaded], DOWN)
    assert (measured - old)[unloaded] == pytest.approx(expected)
    result = found.identified
    assert result is not None
    down = DOWN + np.cross(result.tilt, DOWN)  # the new file's mounting of the IMU
    by_new_file = regressor(POSES[unloaded], down / np.linalg.norm(down)) @ result.moments / result.scale
    assert (measured - new)[unloaded] == pytest.approx(by_new_file, abs=1e-3)
    assert np.abs(old).max() > 10.0 * np.abs(new).max()
    loads = regressor(POSES[1::2], DOWN) @ load_moments(configured_arm().robot.length, *LOAD)
    weighed = gravity_torque(configured_arm().robot, POSES[1::2], DOWN) + loads
    assert (measured - old)[1::2] == pytest.approx(weighed)


@pytest.mark.usefixtures("without_pictures")
def test_the_arm_creeps_where_the_remainder_exceeds_friction() -> None:
    found = outcome()
    old, _, held_out, _ = remainders_of(found)
    creeping = [int((np.abs(wrong) > 0.2 * FRICTION).any(axis=1).sum()) for wrong in (old, held_out)]
    page = page_of(found, "gravity", "old.yaml", DAY)
    count = f"in {creeping[0]} of 12 poses with the old file, in {creeping[1]} with the new"
    assert f"With 0.2 times that the arm creeps {count}" in page


def test_the_page_says_what_was_found_and_what_does_not_show() -> None:
    found = outcome()
    page = page_of(found, "gravity", "old.yaml", DAY)
    assert '<h1>calibrate gravity, right arm</h1><p class="when">2026-11-22, from old.yaml</p>' in page
    assert "<b>Calibrated.</b>" in page
    assert "robot.first_moment" in page and "kg m, &lt;±0.001&gt;" in page
    assert "M4 is 20 % larger than in the file." in page
    assert page.count("data:image/png;base64,") == 1
    assert found.identified is not None
    for sentence in found.identified.unknown:
        assert escape(sentence) in page
    assert "Singular values" in page
    assert ", in 0 with the new" in page


@pytest.mark.usefixtures("without_pictures")
def test_a_pose_that_was_left_out_is_not_counted() -> None:
    found = outcome(outlier=5)
    *_, used = remainders_of(found)
    assert np.flatnonzero(~used).tolist() == [5]
    assert " of 11 poses with the old file" in page_of(found, "gravity", "old.yaml", DAY)


def test_a_refusal_is_on_the_page_without_new_values() -> None:
    page = page_of(outcome(refusals=("pose 3 slipped",), identified=None), "gravity", "old.yaml", DAY)
    assert "Not calibrated; no file was written.</b><ul><li>pose 3 slipped</li>" in page
    assert "robot.first_moment" not in page and "<img" not in page


def test_friction_is_drawn_over_speed() -> None:
    speed = np.array((0.3, 0.05, 0.1))
    curves = [fit_friction(speed, 0.1 + 0.02 * speed) for _ in range(4)]
    comment = Change("/right/can_bridge", "", 0, "friction of the elbow")  # in the file alone
    found = CalibrationResult((comment,), ("friction found",), (), configured_arm(), curves=tuple(curves))
    page = page_of(found, "friction", "old.yaml", DAY)
    assert page.count("<img") == 1 and "Friction over speed" in page


def test_without_poses_the_page_holds_the_values_alone() -> None:
    changes: Sequence[Change] = (Change("/imu", "rotation_trunk_from_imu", [0.0, 0.0, 0.0, 1.0]),)
    page = page_of(CalibrationResult(tuple(changes), ()), "imu", "old.yaml", DAY)
    assert "[0.0, 0.0, 0.0, 1.0]" in page and "<img" not in page
