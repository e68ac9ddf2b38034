"""Holds, drift, pushes, let-downs and the verdict, from synthetic recordings with known motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core.errors import DataError
from exo_gravity.lab.trial.analysis import HoldCriteria, analyse, failures
from exo_gravity.lab.trial.recording import Recording, ScriptedStep

from ..support.synthetic_recording import (
    HANGING,
    POSE_A,
    POSE_B,
    POSITION_CODE,
    RATE,
    SCRIPT,
    STOPPED_IN_A_HOLD,
    VELOCITY_CODE,
    carried_until,
    recording,
    released,
    smooth,
    still,
    two_poses,
)

DEG_PER_MIN = math.radians(1.0) / 60.0
PEAK_SPEED = 1.875 * np.abs(POSE_A - HANGING) / 4.0  # of a minimum-jerk motion in 4 s


def test_each_still_span_is_a_hold_and_the_motion_between_them_is_not():
    holds = analyse(two_poses()).holds
    assert [(round(h.start), round(h.end)) for h in holds] == [(0, 10), (12, 22)]


def test_the_pose_of_a_hold_is_its_mean_position():
    holds = analyse(two_poses()).holds
    np.testing.assert_allclose([h.pose for h in holds], [POSE_A, POSE_B], atol=2 * POSITION_CODE)


def test_an_arm_that_does_not_move_at_all_has_no_drift():
    (hold,) = analyse(recording(still(POSE_A, 60.0))).holds
    assert not hold.drift.any() and not hold.drift_rate.any() and not hold.stray.any()


@pytest.mark.parametrize("per_minute", [0.1, 0.2, -0.2, 1.0, -5.0, 30.0])
@pytest.mark.parametrize("noise", [0.0, POSITION_CODE])
def test_a_known_drift_is_found_within_twice_its_uncertainty(per_minute, noise):
    drift = per_minute * DEG_PER_MIN * np.array([1.0, 0.7, -0.4, 0.15])
    (hold,) = analyse(recording(still(POSE_A, 60.0, drift), noise=noise)).holds
    assert np.all(np.abs(hold.drift_rate - drift) < 2 * hold.drift_rate_uncertainty)


def test_over_a_minute_the_uncertainty_stays_well_below_a_fifth_of_a_degree_per_minute():
    (hold,) = analyse(recording(still(POSE_A, 60.0, 0.2 * DEG_PER_MIN), noise=POSITION_CODE)).holds
    assert np.all(hold.drift_rate_uncertainty < 0.05 * DEG_PER_MIN)


@pytest.mark.parametrize("phase", np.linspace(0.0, 1.0, 7))
def test_quantisation_alone_is_within_the_uncertainty_wherever_the_code_changes(phase):
    drift = 0.03 * DEG_PER_MIN  # 1.4 codes in a minute
    (hold,) = analyse(recording(still(POSE_A + phase * POSITION_CODE, 60.0, drift))).holds
    assert np.all(np.abs(hold.drift_rate - drift) < hold.drift_rate_uncertainty)


def test_a_5_s_touch_of_a_tenth_of_a_degree_hardly_changes_the_drift():
    drift = 1.0 * DEG_PER_MIN
    exact = still(POSE_A, 60.0, drift)
    exact[20_000:22_500] += math.radians(0.1)
    (hold,) = analyse(recording(exact)).holds
    ordinary = np.polyfit(np.arange(len(exact)) / RATE, exact, 1)[0]
    assert np.all(np.abs(hold.drift_rate - drift) < 0.4 * np.abs(ordinary - drift))


def test_total_drift_and_stray_are_in_radians_over_the_hold():
    drift = np.array([0.0, 6.0, -3.0, 0.0]) * DEG_PER_MIN
    (hold,) = analyse(recording(still(POSE_A, 60.0, drift))).holds
    np.testing.assert_allclose(hold.drift, drift * 57.6, atol=2 * POSITION_CODE)  # middle of first and last part
    np.testing.assert_allclose(hold.stray, np.abs(drift) * 9.9, atol=2 * POSITION_CODE)  # within 10 s, in blocks


def test_a_motor_at_rest_shows_half_a_velocity_code():
    (hold,) = analyse(recording(still(POSE_A, 10.0))).holds
    np.testing.assert_allclose(hold.velocity_rms, VELOCITY_CODE / 2)


def test_torque_error_is_the_rms_of_commanded_minus_measured_where_both_are_known():
    effort = np.full((5000, 4), 2.0)
    command = effort + np.array([0.0, 0.1, -0.2, 0.3])
    command[:100] = math.nan
    (hold,) = analyse(recording(still(POSE_A, 10.0), effort=effort, command=command)).holds
    np.testing.assert_allclose(hold.torque_error, [0.0, 0.1, 0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(hold.torque_rms, 2.0)


def test_a_torque_that_was_not_recorded_is_unknown_and_not_zero():
    (hold,) = analyse(recording(still(POSE_A, 10.0), command=np.full((5000, 4), math.nan))).holds
    assert np.all(np.isnan(hold.torque_error))


def test_a_push_has_a_peak_a_residual_and_a_time_until_still():
    aside = POSE_A + np.array([0.0, 0.2, -0.1, 0.0])
    back = POSE_A + np.array([0.0, 0.05, -0.02, 0.0])
    pieces = (still(POSE_A, 10.0), smooth(POSE_A, aside, 1.0), smooth(aside, back, 2.0), still(back, 10.0))
    (push,) = analyse(recording(*pieces)).motions
    assert push.kind == "push"
    np.testing.assert_allclose(push.peak, [0.0, 0.2, -0.1, 0.0], atol=2 * POSITION_CODE)
    np.testing.assert_allclose(push.residual, [0.0, 0.05, -0.02, 0.0], atol=5 * POSITION_CODE)
    assert push.until_still == pytest.approx(3.0, abs=0.4)


def test_a_motion_to_a_distant_pose_is_a_move():
    assert [motion.kind for motion in analyse(two_poses()).motions] == ["move"]


def test_an_arm_still_moving_at_the_end_of_the_recording_has_no_time_until_still():
    motion = analyse(recording(still(POSE_A, 10.0), still(POSE_A, 5.0, drift=-0.3))).motions[-1]
    assert math.isnan(motion.until_still) and np.all(np.isnan(motion.residual))


def test_a_gap_of_a_second_in_the_recording_splits_a_hold():
    whole = recording(still(POSE_A, 20.0))
    keep = (whole.time < 9.0) | (whole.time > 10.0)
    arrays = (getattr(whole, name)[keep] for name in ("time", "position", "velocity", "effort", "command"))
    trial = analyse(Recording("right", whole.joint_names, *arrays))
    assert len(trial.holds) == 2 and [motion.kind for motion in trial.motions] == ["gap"]


def test_a_fast_vibration_is_not_a_hold():
    time = np.arange(5000)[:, None] / RATE
    assert not analyse(recording(POSE_A + 0.02 * np.sin(2 * math.pi * 5.0 * time))).holds


def test_a_recording_at_20_hz_has_the_same_holds():
    whole = two_poses()
    arrays = (getattr(whole, name)[::25] for name in ("time", "position", "velocity", "effort", "command"))
    assert len(analyse(Recording("right", whole.joint_names, *arrays)).holds) == 2


def test_motion_before_release_is_not_drift():
    slow = recording(smooth(POSE_A - 0.01, POSE_A, 2.0), still(POSE_A, 10.0), steps=SCRIPT)
    (hold,) = analyse(slow).holds
    assert hold.start >= 2.0 and np.all(hold.stray < 2 * POSITION_CODE)


def test_an_arm_that_hangs_without_being_carried_has_no_hold():
    assert [(round(h.start), round(h.end)) for h in analyse(carried_until(17.0)).holds] == [(7, 17)]


def test_a_hold_cut_short_by_a_stop_is_judged_up_to_the_stop():
    script = (ScriptedStep("hold", 0.0, 60.0),)
    creeping = recording(still(POSE_A, 10.0, math.radians(0.3)), steps=script, carried=((0.0, 9.0),))
    (release,) = analyse(creeping).releases
    assert release.end == 9.0 and release.offset[0] == pytest.approx(math.radians(0.3) * 9.0, abs=math.radians(0.05))


def test_a_hold_stopped_right_after_its_start_is_not_judged():
    stopped = recording(smooth(POSE_B, POSE_A, 2.0), smooth(POSE_A, HANGING, 4.0), steps=SCRIPT, carried=((0.0, 2.5),))
    assert analyse(stopped).releases == ()


def test_a_let_down_has_the_peak_speed_of_each_joint():
    down = analyse(carried_until(17.0)).motions[-1]
    assert down.kind == "let down" and down.start == 17.0
    np.testing.assert_allclose(down.speed, PEAK_SPEED, atol=2 * VELOCITY_CODE)


def test_a_let_down_ends_when_the_wearer_moves_the_arm():
    steps = (*STOPPED_IN_A_HOLD[:1], ScriptedStep("hold", 7.0, 18.0), ScriptedStep("move", 18.0, 20.0))
    down = analyse(carried_until(17.0, steps)).motions[-1]
    assert (down.kind, down.start, down.end) == ("let down", 17.0, 18.0)


def test_a_let_down_between_two_holds_is_not_a_push():
    pieces = (still(POSE_A, 5.0), smooth(POSE_A, POSE_A - 0.1, 4.0), smooth(POSE_A - 0.1, POSE_A, 2.0))
    twice = recording(*pieces, still(POSE_A, 5.0), carried=((0.0, 5.0), (10.0, 16.0)))
    trial = analyse(twice)
    assert len(trial.holds) == 2 and [motion.kind for motion in trial.motions] == ["let down"]


@pytest.mark.parametrize("change", ["shape", "order", "nan"])
def test_inconsistent_arrays_are_rejected(change):
    good = recording(still(POSE_A, 1.0))
    arrays = {name: getattr(good, name).copy() for name in ("time", "position", "velocity", "effort", "command")}
    if change == "shape":
        arrays["effort"] = arrays["effort"][:-1]
    elif change == "order":
        arrays["time"] = arrays["time"][::-1]
    else:
        arrays["position"][7, 2] = math.nan
    with pytest.raises(DataError, match="right: "):
        Recording("right", good.joint_names, **arrays)


def test_an_arm_that_stays_where_it_was_released_passes():
    held = released(POSE_A)
    assert failures(held, analyse(held), HoldCriteria()) == []


def test_an_arm_that_falls_and_then_hangs_still_fails():
    fallen = released(np.zeros(4))
    (sentence,) = failures(fallen, analyse(fallen), HoldCriteria())
    assert "from where it was let go" in sentence


def test_a_jerk_within_the_criteria_is_not_a_failure():
    off = POSE_A + math.radians(0.4)
    jerked = recording(
        smooth(POSE_B, POSE_A, 2.0), still(POSE_A, 5.0), smooth(POSE_A, off, 0.1), still(off, 4.9), steps=SCRIPT
    )
    trial = analyse(jerked)
    assert [motion.kind for motion in trial.motions] == ["slip"]
    assert failures(jerked, trial, HoldCriteria()) == []


def test_an_arm_that_slips_during_a_hold_fails():
    off = POSE_A + math.radians(1.5)
    slipped = recording(
        smooth(POSE_B, POSE_A, 2.0), still(POSE_A, 5.0), smooth(POSE_A, off, 0.2), still(off, 4.8), steps=SCRIPT
    )
    assert any("slipped by 1.5" in sentence for sentence in failures(slipped, analyse(slipped), HoldCriteria()))


def test_a_hold_may_stray_half_a_degree_in_10_s_and_two_degrees_after_a_push():
    creeping = still(POSE_A, 10.0, drift=math.radians(0.1))
    steps = (*SCRIPT, ScriptedStep("push", 12.0, 12.4), ScriptedStep("hold", 12.4, 22.4))
    pushed = creeping[-1] + np.array([0.0, 0.3, 0.1, 0.0])
    pieces = (smooth(POSE_B, POSE_A, 2.0), creeping, smooth(creeping[-1], pushed, 0.4))
    made = recording(*pieces, still(pushed, 10.0, drift=math.radians(0.1)), steps=steps)
    trial = analyse(made)
    assert [hold.after for hold in trial.holds] == ["start", "push"]
    sentences = failures(made, trial, HoldCriteria())
    assert len(sentences) == 4 and all(sentence.startswith("right: 2.1-") for sentence in sentences)


def test_a_limit_on_the_rate_names_the_joint_that_exceeds_it():
    creeping = recording(still(POSE_A, 60.0, drift=np.array([0.0, 0.0, 0.0, 0.5]) * DEG_PER_MIN))
    (sentence,) = failures(creeping, analyse(creeping), HoldCriteria(max_rate=0.2 * DEG_PER_MIN))
    assert "j4 drifted 0.50 degrees per minute, more than 0.20" in sentence


def test_a_hold_shorter_than_rated_from_is_not_judged_by_its_rate():
    creeping = recording(still(POSE_A, 20.0, drift=0.5 * DEG_PER_MIN))
    assert failures(creeping, analyse(creeping), HoldCriteria(max_rate=0.2 * DEG_PER_MIN))
    assert not failures(creeping, analyse(creeping), HoldCriteria(max_rate=0.2 * DEG_PER_MIN, rated_from=30.0))


def test_the_let_down_after_a_stop_during_a_hold_is_not_a_slip():
    stopped = carried_until(17.0, STOPPED_IN_A_HOLD)
    trial = analyse(stopped)
    assert [motion.kind for motion in trial.motions] == ["let down"]
    assert failures(stopped, trial, HoldCriteria()) == []


def test_the_same_motion_of_an_arm_that_is_still_carried_is_a_slip():
    fallen = carried_until(26.0, STOPPED_IN_A_HOLD)
    assert any("slipped" in sentence for sentence in failures(fallen, analyse(fallen), HoldCriteria()))


def test_an_arm_that_was_never_carried_fails():
    hanging = recording(still(HANGING, 10.0), carried=())
    assert failures(hanging, analyse(hanging), HoldCriteria()) == ["right: the arm was never carried"]


def test_a_recording_without_a_hold_fails():
    moving = recording(smooth(POSE_A, POSE_B, 2.0))
    assert "never still" in failures(moving, analyse(moving), HoldCriteria())[0]


def test_joints_are_put_in_the_order_asked_for_and_others_are_refused_by_name():
    whole = two_poses()
    names = whole.joint_names[::-1]
    turned = whole.in_order(names)
    assert turned.joint_names == names
    for field in ("position", "velocity", "effort", "command"):
        np.testing.assert_array_equal(getattr(turned, field), getattr(whole, field)[:, ::-1])
    with pytest.raises(DataError, match="must be a, b, c, d"):
        whole.in_order(("a", "b", "c", "d"))
