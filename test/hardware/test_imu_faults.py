# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Faults of IMUs, drivers and clocks: named, and no tilt is published that is off by more than 5 degrees.

Each fault is put into the simulated motion of a trunk that bows, leans and then walks, from the start or amid the
motion; every published tilt is judged by the true one.
"""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.imu_trials import read_trials
from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator

from ..support.imu_faults import (
    STILL_TIME,
    G,
    Motion,
    bow,
    bowing_and_walking,
    bowing_trunk,
    follow,
    lost,
    sampled,
    second_publisher,
    slow_clock,
    stuck,
    values,
)  # fmt: skip
from ..support.thorough import quick

MOTION = bowing_and_walking()
WRONG = 5.0  # degrees


def frozen(array):
    return np.tile(array[0], (len(array), 1))


FAULTS = {
    "frozen bytes": (values(frozen, frozen), "the IMU or its driver is frozen"),
    "NaN": (values(lambda w: np.where(np.arange(3) == 1, math.nan, w)), "angular_velocity .* 3 finite numbers"),
    "a gyroscope in deg/s": (values(np.degrees), "check the gyroscope's unit|is its unit right"),
    "an accelerometer in g": (values(None, lambda a: a / G), "in m/s.2, not in g|check units, axes and signs"),
    "a clock at half the speed": (slow_clock(0.5), "by a clock as fast as this computer's"),
    "a second publisher": (second_publisher, "check units, axes and signs"),
    **{f"gyroscope {axis} stuck": (values(stuck(k)), f"the {axis} axis is stuck") for k, axis in enumerate("xyz")},
    **{
        f"accelerometer {axis} stuck": (values(None, stuck(k)), f"the {axis} axis is stuck")
        for k, axis in enumerate("xyz")
    },
}
# The accelerometer alone shows these, and while the trunk moves it also measures the movement. The figures are the time
# in s for which a wrong tilt is published until the fault is distinguished from movement.
SHOWN_BY_MOTION = {
    "gyroscope reversed": (values(np.negative), 0.05),
    "gyroscope x reversed": (values(lambda w: w * (-1, 1, 1)), 0.1),
    "gyroscope y reversed": (values(lambda w: w * (1, -1, 1)), 0.05),
    "gyroscope x and y swapped": (values(lambda w: w[:, [1, 0, 2]]), 1.0),
    "gyroscope y and z swapped": (values(lambda w: w[:, [0, 2, 1]]), 2.0),
    "gyroscope x and z swapped": (values(lambda w: w[:, [2, 1, 0]]), 2.2),
    "gyroscope of half the scale": (values(lambda w: 0.5 * w), 0.7),
    "gyroscope of twice the scale": (values(lambda w: 2.0 * w), 0.8),
}


def wrong_time(motion, outcome):
    return np.nansum(outcome.errors > WRONG) / motion.rate


CASES = list(itertools.product(FAULTS, (0.0, 6.0)))  # s: from the start, or amid the motion


@pytest.mark.parametrize(("fault", "start"), quick(CASES[::3], CASES))
def test_a_fault_is_named_and_no_wrong_tilt_is_published(fault, start):
    apply, name = FAULTS[fault]
    motion = apply(MOTION, round(start * MOTION.rate))
    outcome = follow(motion)
    assert any(re.search(name, text) for text in outcome.refusals)
    assert wrong_time(motion, outcome) == 0.0


@pytest.mark.parametrize("fault", SHOWN_BY_MOTION)
def test_a_wrong_axis_or_sign_is_named_within_a_few_bows(fault):
    apply, longest = SHOWN_BY_MOTION[fault]
    motion = apply(MOTION, 0)
    outcome = follow(motion)
    named = [k for k, text in enumerate(outcome.refusals) if "axes and signs" in text]
    assert motion.times[named[0]] < STILL_TIME + 4.0
    assert wrong_time(motion, outcome) <= longest
    assert np.isfinite(outcome.errors[motion.times > STILL_TIME]).mean() < 0.35


def standing(times):
    """Roll, pitch and yaw (n, 3) rad of a trunk that sways by a degree."""
    return np.radians(np.stack((np.sin(1.9 * times), 0.7 * np.sin(1.3 * times + 1.0), 2.0 * np.sin(0.4 * times)), 1))


SLOW = list(itertools.product((standing, bow(0.6, STILL_TIME, 8.0)), (260, 310, 430, 560, 690)))


@pytest.mark.parametrize(("trunk", "start"), quick(SLOW[::4], SLOW))
def test_a_gyroscope_that_turns_to_degrees_in_slow_motion_is_withheld_before_the_tilt_is_wrong_and_named(trunk, start):
    motion = values(np.degrees)(sampled(trunk, np.arange(800) / 100.0, 0.01, 100.0), start)
    outcome = follow(motion)
    withheld = start + np.flatnonzero(np.isnan(outcome.errors[start:]))
    named = [k for k, text in enumerate(outcome.refusals) if "check the gyroscope's unit" in text]
    # The trunk may just not turn when it begins.
    assert withheld[0] < start + 25 and named[0] < start + 60
    assert np.nanmax(outcome.errors) < 6.0 and np.isnan(outcome.errors[withheld[0] :]).all()


@pytest.mark.parametrize("turn", [30.0, 90.0, 180.0])
def test_a_wrong_reported_orientation_is_never_used_also_while_the_trunk_moves(turn):
    reported = Rotation.from_euler("xyz", bowing_trunk(MOTION.times)) * Rotation.from_euler("y", turn, degrees=True)
    outcome = follow(replace(MOTION, orientation=reported.as_quat()))
    assert any(outcome.refusals) and np.isnan(outcome.errors).all()


def test_3_percent_of_the_samples_lost_cost_nothing():
    motion = lost(0.03)(MOTION, 0)
    outcome = follow(motion)
    assert np.nanmax(outcome.errors) < 1.0 and np.isfinite(outcome.errors[motion.times > 1.1]).all()


def test_a_knock_between_lost_samples_is_no_wrong_gyroscope():
    motion = sampled(bow(1.2, STILL_TIME, 1.5), np.arange(800) / 100.0, 0.01, 100.0)
    for knock in range(370, 430, 5):
        force, kept = motion.accelerometer.copy(), np.ones(len(motion.times), bool)
        force[knock] *= -0.9
        kept[[knock - 1, knock + 1]] = False  # one judgement has this sample alone
        parts = {name: getattr(motion, name)[kept] for name in ("times", "gyroscope", "gravity")}
        outcome = follow(replace(motion, accelerometer=force[kept], **parts))
        assert not any(outcome.refusals) and np.nanmax(outcome.errors) < 2.5


def saturated(duration):
    """The motion, with a knock at 5 s that turns faster than the gyroscope's range for `duration` s."""
    gyroscope = MOTION.gyroscope.copy()
    gyroscope[(MOTION.times >= 5.0) & (MOTION.times < 5.0 + duration), 2] = math.radians(2000.0)
    return Motion(**{**vars(MOTION), "gyroscope": gyroscope})


def test_a_saturated_sample_is_carried_as_uncertainty_and_a_longer_saturation_withheld_until_it_is_known_again():
    settled = TrunkEstimator((0, 0, 0, 1))
    for k in range(300):
        before = settled.update(ImuSample(k / 100, (0.0, 0.0, 1e-6 * (-1) ** k), (0.0, 0.0, G)))
    after = settled.update(ImuSample(3.0, (0.0, 0.0, math.radians(2000.0)), (0.0, 0.01, G)))
    assert after is None or after.uncertainty > before.uncertainty
    outcome = follow(saturated(0.05))
    missing = np.isnan(outcome.errors) & (MOTION.times > 1.1)
    assert MOTION.times[missing].min() < 5.03 and 0.9 < np.sum(missing) / MOTION.rate < 3.0
    back = np.flatnonzero(np.isfinite(outcome.errors) & (MOTION.times > 5.05))  # without a jump
    assert outcome.errors[back[0]] < 3.0 and np.abs(np.diff(outcome.errors[back])).max() < 0.5
    assert np.nanmax(outcome.errors) < WRONG


@pytest.mark.parametrize("size", [10.0, 30.0])
def test_a_single_wrong_rate_is_withheld_as_the_turn_that_it_may_hide(size):
    for wrong in (400, 700, 1000):
        gyroscope = MOTION.gyroscope.copy()
        gyroscope[wrong, 1] += size
        outcome = follow(Motion(**{**vars(MOTION), "gyroscope": gyroscope}))
        assert np.isnan(outcome.errors[wrong]) and np.nanmax(outcome.errors) < 1.5


def test_a_knock_beyond_the_range_is_followed_by_the_new_tilt_after_a_second_of_rest():
    estimator, random = TrunkEstimator((0, 0, 0, 1)), np.random.default_rng(8)

    def feed(start, seconds, up, rate=(0.0, 0.0, 0.0)):
        for k in range(round(100 * seconds)):
            noise = random.normal(0.0, 0.002, 6)
            yield start + k / 100, estimator.update(ImuSample(start + k / 100, rate + noise[:3], G * up + noise[3:]))

    list(feed(0.0, 3.0, np.array((0.0, 0.0, 1.0))))
    turned = np.array((0.0, math.sin(1.0), math.cos(1.0)))  # the true turn: 1 rad; the saturated rate shows 1.4
    knock = list(feed(3.0, 0.04, turned, (math.radians(2000.0), 0.0, 0.0)))
    after = [(time, answer) for time, answer in feed(3.04, 4.0, turned) if answer is not None]
    assert knock[-1][1] is None and after[0][0] < 4.5
    assert all(answer.roll == pytest.approx(1.0, abs=0.02) for _, answer in after)


@pytest.mark.parametrize(("name", "start"), [("03", 11.77), ("07", 6.0), ("16", 13.99), ("25", 8.44)])
def test_in_strong_motion_a_frozen_imu_is_withheld_before_the_tilt_is_wrong(name, start):
    trial = next(trial for trial in read_trials() if trial.name.startswith(name))
    motion = Motion(trial.rate, trial.times, trial.angular_velocity, trial.acceleration, trial.gravity)
    outcome = follow(FAULTS["frozen bytes"][0](motion, int(start * motion.rate)))
    assert wrong_time(motion, outcome) == 0.0


def test_values_beyond_the_given_ranges_are_refused_and_at_the_range_accepted():
    estimator = TrunkEstimator((0, 0, 0, 1), 100.0, gyroscope_range=4.4, accelerometer_range=19.6)
    for k in range(200):
        estimator.update(ImuSample(k / 100, (0.0, 0.0, 1e-6 * (-1) ** k), (0.0, 0.0, G)))
    with pytest.raises(ParameterError, match="gyroscope_range = 4"):
        estimator.update(ImuSample(2.0, (0.0, 5.0, 0.0), (0.0, 0.0, G)))
    with pytest.raises(ParameterError, match="accelerometer_range = 19"):
        estimator.update(ImuSample(2.0, (0.0, 0.0, 0.0), (0.0, 25.0, G)))
    assert estimator.update(ImuSample(2.01, (0.0, 0.0, 0.0), (0.0, 19.6, G))) is not None


@pytest.mark.parametrize(("name", "value"), [("gyroscope_range", 0.0), ("accelerometer_range", 9.0)])
def test_a_range_that_no_sensor_has_is_refused(name, value):
    with pytest.raises(ParameterError, match=name):
        TrunkEstimator((0, 0, 0, 1), 100.0, **{name: value})


@pytest.mark.parametrize(("share", "error"), [(0.9, 1.5), (1.1, 3.0)], ids=["slow", "fast"])
def test_a_clock_that_becomes_10_percent_slow_or_fast_is_named_within_a_second(share, error):
    motion = slow_clock(share)(MOTION, 600)
    outcome = follow(motion)
    named = [k for k, text in enumerate(outcome.refusals) if "by a clock as fast as this computer's" in text]
    assert named[0] <= 700 and np.nanmax(outcome.errors) < error
