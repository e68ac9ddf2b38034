"""Whether a trial passes, from synthetic recordings with known motion."""

from __future__ import annotations

import math

import numpy as np

from exo_gravity.core.trial.analysis import HoldCriteria, analyse, failures
from exo_gravity.core.trial.recording import ScriptedStep

from ..support.synthetic_recording import (
    HANGING,
    POSE_A,
    POSE_B,
    SCRIPT,
    STOPPED_IN_A_HOLD,
    carried_until,
    recording,
    released,
    smooth,
    still,
)

DEG_PER_MIN = math.radians(1.0) / 60.0


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
