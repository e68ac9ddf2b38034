# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Holds, drift, pushes, let-downs, smoothness and the verdict, from synthetic recordings with known motion."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from exo_gravity.lab.report.cohort import LEAST, spectral_arc_length
from exo_gravity.lab.report.trial_report import analyse as report_of
from exo_gravity.lab.trial.analysis import ARRAYS, HoldCriteria, ScriptedStep, analyse

from ..support.synthetic_bags import POSITION_CODE, RATE, VELOCITY_CODE, bag_of, measured, smooth, still

DEG_PER_MIN = math.radians(1.0) / 60.0

POSE_A, POSE_B = np.array([0.1, 0.4, 0.5, 0.6]), np.array([-0.3, 0.9, 1.2, 0.2])

HANGING = np.array([0.0, 0.05, 0.0, 0.1])


SCRIPT = (ScriptedStep("move", 0.0, 2.0), ScriptedStep("hold", 2.0, 12.0))

STOPPED_IN_A_HOLD = (ScriptedStep("move", 5.0, 7.0), ScriptedStep("hold", 7.0, 60.0))

ARRIVAL = smooth(POSE_B, POSE_A, 2.0)


def recording(*pieces, **more):
    return measured(np.concatenate(pieces), **more)


def carried_until(end, steps=()):
    """Hang for 5 s, lift to `POSE_A` in 2 s, hold for 10 s, and let down from 17 s to 21 s."""
    pieces = (still(HANGING, 5.0), smooth(HANGING, POSE_A, 2.0), still(POSE_A, 10.0))
    return recording(*pieces, smooth(POSE_A, HANGING, 4.0), still(HANGING, 5.0), steps=steps, carried=((4.0, end),))


def sampled(whole, chosen):
    return replace(whole, **{name: getattr(whole, name)[chosen] for name in ("time", *ARRAYS)})


def spans(made):
    return [(round(hold.start), round(hold.end)) for hold in analyse(made).holds]


def kinds(made):
    return [motion.kind for motion in analyse(made).motions]


def failed(made, **criteria):
    return report_of(bag_of(made), HoldCriteria(**criteria)).failures


def test_each_still_span_is_a_hold_of_its_mean_position_and_the_motion_between_them_is_a_move():
    whole = recording(still(POSE_A, 10.0), smooth(POSE_A, POSE_B, 2.0), still(POSE_B, 10.0))
    assert spans(whole) == [(0, 10), (12, 22)] == spans(sampled(whole, slice(None, None, 25)))  # at 20 Hz
    np.testing.assert_allclose([h.pose for h in analyse(whole).holds], [POSE_A, POSE_B], atol=2 * POSITION_CODE)
    assert kinds(whole) == ["move"]


@pytest.mark.parametrize("per_minute", [0.0, 0.1, 0.2, -5.0, 30.0])
@pytest.mark.parametrize("noise", [0.0, POSITION_CODE])
def test_a_known_drift_is_found_within_twice_its_uncertainty(per_minute, noise):
    drift = per_minute * DEG_PER_MIN * np.array([1.0, 0.7, -0.4, 0.15])
    (hold,) = analyse(made := recording(still(POSE_A, 60.0, drift), noise=noise)).holds
    if not (per_minute or noise):  # an arm that does not move at all
        assert not hold.drift.any() and not hold.drift_rate.any() and not hold.stray.any()
        return
    assert np.all(np.abs(hold.drift_rate - drift) < 2 * hold.drift_rate_uncertainty)
    if not noise:
        np.testing.assert_allclose(hold.drift, drift * 57.6, atol=2 * POSITION_CODE)  # middle of first and last part
        np.testing.assert_allclose(hold.stray, np.abs(drift) * 9.9, atol=2 * POSITION_CODE)  # within 10 s, in blocks
    said = [failed(made, max_rate=DEG_PER_MIN, max_stray=1.0, rated_from=seconds) for seconds in (59.0, 61.0)]
    assert [len(sentences) for sentences in said] == [abs(per_minute) > 1.0, 0]
    if abs(per_minute) <= 1.0:  # a minute shows well below a fifth of a degree per minute
        assert np.all(hold.drift_rate_uncertainty < 0.05 * DEG_PER_MIN)


def test_a_5_s_touch_of_a_tenth_of_a_degree_hardly_changes_the_drift():
    drift = 1.0 * DEG_PER_MIN
    exact = still(POSE_A, 60.0, drift)
    exact[20_000:22_500] += math.radians(0.1)
    (hold,) = analyse(measured(exact)).holds
    ordinary = np.polyfit(np.arange(len(exact)) / RATE, exact, 1)[0]
    assert np.all(np.abs(hold.drift_rate - drift) < 0.4 * np.abs(ordinary - drift))


def test_velocity_and_torques_of_a_hold_are_root_mean_squares_where_they_are_known():
    effort = np.full((5000, 4), 2.0)
    command = effort + np.array([0.0, 0.1, -0.2, 0.3])
    command[:100] = math.nan
    (hold,) = analyse(recording(still(POSE_A, 10.0), effort=effort, command=command)).holds
    np.testing.assert_allclose(hold.torque_error, [0.0, 0.1, 0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(hold.torque_rms, 2.0)
    np.testing.assert_allclose(hold.velocity_rms, VELOCITY_CODE / 2)  # a motor at rest has no code for 0
    (hold,) = analyse(recording(still(POSE_A, 10.0), command=np.full((5000, 4), math.nan))).holds
    assert np.all(np.isnan(hold.torque_error))


def test_a_push_has_a_peak_a_residual_and_a_time_until_still():
    aside, back = np.add(POSE_A, (0.0, 0.2, -0.1, 0.0)), np.add(POSE_A, (0.0, 0.05, -0.02, 0.0))
    pieces = (still(POSE_A, 10.0), smooth(POSE_A, aside, 1.0), smooth(aside, back, 2.0), still(back, 10.0))
    (push,) = analyse(recording(*pieces)).motions
    assert push.kind == "push"
    np.testing.assert_allclose(push.peak, [0.0, 0.2, -0.1, 0.0], atol=2 * POSITION_CODE)
    np.testing.assert_allclose(push.residual, [0.0, 0.05, -0.02, 0.0], atol=5 * POSITION_CODE)
    assert push.until_still == pytest.approx(3.0, abs=0.4)
    motion = analyse(recording(still(POSE_A, 10.0), still(POSE_A, 5.0, drift=-0.3))).motions[-1]  # never still again
    assert math.isnan(motion.until_still) and np.all(np.isnan(motion.residual))


def test_what_is_no_hold():
    whole = recording(still(POSE_A, 20.0))
    gap = sampled(whole, (whole.time < 9.0) | (whole.time > 10.0))
    assert len(spans(gap)) == 2 and kinds(gap) == ["gap"]
    time = np.arange(5000)[:, None] / RATE
    assert spans(measured(POSE_A + 0.02 * np.sin(2 * math.pi * 5.0 * time))) == []  # a vibration
    assert spans(carried_until(17.0)) == [(7, 17)]  # an arm that hangs is not carried
    (hold,) = analyse(recording(smooth(POSE_A - 0.01, POSE_A, 2.0), still(POSE_A, 10.0), steps=SCRIPT)).holds
    assert hold.start >= 2.0 and np.all(hold.stray < 2 * POSITION_CODE)  # motion before release is not drift


def test_a_hold_cut_short_by_a_stop_is_judged_up_to_the_stop_unless_it_had_just_begun():
    script = (ScriptedStep("hold", 0.0, 60.0),)
    creeping = recording(still(POSE_A, 10.0, math.radians(0.3)), steps=script, carried=((0.0, 9.0),))
    (release,) = analyse(creeping).releases
    assert release.end == 9.0 and release.offset[0] == pytest.approx(math.radians(0.3) * 9.0, abs=math.radians(0.05))
    assert analyse(recording(ARRIVAL, smooth(POSE_A, HANGING, 4.0), steps=SCRIPT, carried=((0.0, 2.5),))).releases == ()


def test_a_let_down_has_the_peak_speed_of_each_joint_until_the_wearer_moves_the_arm_and_is_no_push():
    down = analyse(carried_until(17.0)).motions[-1]
    assert (down.kind, down.start) == ("let down", 17.0)
    peak = 1.875 * np.abs(POSE_A - HANGING) / 4.0  # of a minimum-jerk motion in 4 s
    np.testing.assert_allclose(down.speed, peak, atol=2 * VELOCITY_CODE)
    then = (("hold", 7.0, 17.5), ("hold", 17.5, 18.0), ("move", 18.0, 20.0))
    down = analyse(carried_until(17.0, (*STOPPED_IN_A_HOLD[:1], *(ScriptedStep(*step) for step in then)))).motions[-1]
    assert (down.kind, down.start, down.end) == ("let down", 17.0, 18.0)
    pieces = (still(POSE_A, 5.0), smooth(POSE_A, POSE_A - 0.1, 4.0), smooth(POSE_A - 0.1, POSE_A, 2.0))
    twice = recording(*pieces, still(POSE_A, 5.0), carried=((0.0, 5.0), (10.0, 16.0)))
    assert len(spans(twice)) == 2 and kinds(twice) == ["let down"]


def released(pose_at_end):
    """Move to `POSE_A`, release at 2 s, and move to another pose within 1 s."""
    return recording(ARRIVAL, smooth(POSE_A, pose_at_end, 1.0), still(pose_at_end, 9.0), steps=SCRIPT)


def slipped(degrees, seconds):
    off = POSE_A + math.radians(degrees)
    return recording(ARRIVAL, still(POSE_A, 5.0), smooth(POSE_A, off, seconds), still(off, 5.0 - seconds), steps=SCRIPT)


JUDGED = {  # a recording, the kinds of its motions, and what is said of an arm that failed
    "it stays": (released(POSE_A), [], ""),
    "it moves on": (released(POSE_A + math.radians(2.5)), [], "did not stay where it was let go"),
    "it falls, then hangs still": (released(np.zeros(4)), [], "did not stay where it was let go"),
    "it slips a little": (slipped(0.4, 0.1), ["slip"], ""),
    "it slips": (
        slipped(1.5, 0.2),
        ["slip"],
        r"slipped at \d+\.\d s: joint \d moved 1\.5\d degrees, more than 0\.50, at up to \d+ deg/s",
    ),
    "it gives way to a load": (
        replace(
            slipped(1.5, 0.2),
            steps=(
                SCRIPT[0],
                ScriptedStep("hold", 2.0, 7.0),
                ScriptedStep("load", 7.0, 7.2),
                ScriptedStep("hold", 7.2, 12.0),
            ),
        ),
        ["load"],
        r"gave way to a change of load at \d+\.\d s: joint \d moved 1\.5",
    ),
    "let down in a hold": (carried_until(17.0, STOPPED_IN_A_HOLD), ["let down"], ""),
    "fallen in a hold": (carried_until(26.0, STOPPED_IN_A_HOLD), ["slip"], "slipped"),
    "never carried": (recording(still(HANGING, 10.0), carried=()), [], "right: the arm was never carried"),
    "never still": (recording(ARRIVAL), [], "never still"),
}


@pytest.mark.parametrize(("made", "expected", "said"), JUDGED.values(), ids=JUDGED)
def test_an_arm_holds_that_stays_where_it_was_let_go_and_does_not_slip_or_was_let_down(made, expected, said):
    sentences = failed(made)
    assert kinds(made) == expected and bool(sentences) == bool(said)
    assert not said or any(re.search(said, sentence) for sentence in sentences)


def test_a_hold_may_stray_half_a_degree_in_10_s_and_two_degrees_after_a_push():
    creeping = still(POSE_A, 10.0, drift=math.radians(0.1))
    steps = (*SCRIPT, ScriptedStep("push", 12.0, 12.4), ScriptedStep("hold", 12.4, 22.4))
    pushed = creeping[-1] + np.array([0.0, 0.3, 0.1, 0.0])
    pieces = (ARRIVAL, creeping, smooth(creeping[-1], pushed, 0.4), still(pushed, 10.0, drift=math.radians(0.1)))
    made = recording(*pieces, steps=steps)
    assert [hold.after for hold in analyse(made).holds] == ["start", "push"]
    (sentence,) = failed(made)
    assert re.fullmatch(r"right: within 10 s of hold 1, joint \d moved [01]\.\d\d degrees, more than 0\.50", sentence)


BELL = np.exp(-5.0 * np.arange(-1.0, 1.0, 1.0 / 100.0) ** 2)


def test_the_smoothness_of_a_bell_is_the_arc_length_of_its_spectrum_and_what_the_authors_code_prints():
    """The amplitude of exp(-5 t^2) is a Gaussian of the frequency: LEAST**(u^2), u = 1 where it has fallen to LEAST.

    The authors' is github.com/siva82kb/SPARC, smoothness.py at 3650934, the example of `sparc`: a bell that is cut off.
    """
    slope = 2.0 * math.log(LEAST)
    length, _ = quad(lambda u: math.hypot(1.0, slope * u * LEAST ** (u * u)), 0.0, 1.0)
    whole = np.exp(-5.0 * np.arange(-20.0, 20.0, 1.0 / 100.0) ** 2)
    assert spectral_arc_length(whole, 100.0) == pytest.approx(-length, abs=5e-4)
    assert spectral_arc_length(BELL, 100.0) == pytest.approx(-1.41403, abs=1e-5)
    assert spectral_arc_length(3.0 * BELL, 100.0) == pytest.approx(spectral_arc_length(BELL, 100.0))
    assert spectral_arc_length(np.concatenate((BELL, BELL)), 100.0) < spectral_arc_length(BELL, 100.0) - 0.1
    assert math.isnan(spectral_arc_length(np.zeros(100), 100.0))
