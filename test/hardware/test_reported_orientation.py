# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Orientations that drivers report: confirmed by gyroscope and accelerometer before and while they are used.

The trunk stands, bows and stays bowed; or it bows and walks, or lives through a day of ordinary motion. Every published
tilt is judged by the true one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vqf import VQF

from ..support.imu_faults import G, Motion, Trunk, bow, bowing_trunk, follow, sampled
from ..support.ordinary_motion import day, worn

SETTLED = 1.1  # s
BOW = (3.0, 5.0)  # s, of which the trunk stays bowed afterwards


def bowing(angle: float) -> Trunk:
    return bow(angle, BOW[0], BOW[1] - BOW[0])


def reporting(trunk: Trunk, duration: float = 12.0, rate: float = 100.0, late: float = 0.0) -> Motion:
    """Return the samples of an IMU that reports its true orientation, `late` s behind."""
    times = np.arange(round(duration * rate)) / rate
    motion = sampled(trunk, times, 0.002, rate)
    return replace(motion, orientation=Rotation.from_euler("xyz", trunk(times - late)).as_quat())


def by_vqf(motion: Motion) -> Motion:
    """Return the samples with the orientation that a filter in the sensor makes of them."""
    filtered = VQF(1.0 / motion.rate).updateBatch(
        np.ascontiguousarray(motion.gyroscope), np.ascontiguousarray(motion.accelerometer)
    )["quat6D"]
    return replace(motion, orientation=np.roll(filtered, -1, axis=1))


def constant(motion: Motion) -> Motion:
    return replace(motion, orientation=np.tile((0.0, 0.0, 0.0, 1.0), (len(motion.times), 1)))


@pytest.mark.parametrize("late", [0.0, 0.03])
def test_a_true_orientation_is_used_from_the_first_second_on_also_late_and_fast(late: float) -> None:
    for trunk in (bowing(0.6), lambda times: 2.0 * bowing(0.6)(3.0 * times - 6.0), bowing_trunk):
        motion = reporting(trunk, 15.0, late=late)
        outcome = follow(motion)
        assert not any(outcome.refusals)
        assert np.isfinite(outcome.errors[motion.times > SETTLED]).all()


@pytest.mark.parametrize(("seed", "rate"), [(2, 100.0), (3, 200.0)])
def test_a_filters_orientation_is_followed_through_ordinary_motion(seed: int, rate: float) -> None:
    motion = by_vqf(worn(day(seed, 40.0), 50.0, rate, seed))
    outcome = follow(motion)
    assert not any(outcome.refusals)
    assert np.isfinite(outcome.errors[motion.times > SETTLED]).all()


@pytest.mark.parametrize("angle", [0.1, 0.3, 0.6])
def test_an_orientation_that_never_turns_is_refused_within_3_degrees_of_a_bow_and_not_used_again(angle: float) -> None:
    motion = constant(reporting(bowing(angle)))
    outcome = follow(motion)
    assert np.nanmax(outcome.errors) < 3.0
    assert np.isnan(outcome.errors[motion.times > BOW[1]]).all()
    assert any("orientation_covariance[0] must be -1" in text for text in outcome.refusals)


def test_without_a_gyroscope_an_orientation_that_never_turns_is_refused_in_the_bow() -> None:
    motion = constant(reporting(bowing(0.3)))
    outcome = follow(replace(motion, gyroscope=np.zeros_like(motion.gyroscope)))
    assert any("different after gravity has turned by linear_acceleration" in text for text in outcome.refusals)
    assert np.nanmax(outcome.errors) < 6.0 and np.isnan(outcome.errors[motion.times > BOW[1]]).all()


def test_without_a_gyroscope_a_filters_orientation_is_followed_however_the_imu_is_mounted() -> None:
    motion = worn(day(4, 20.0), 30.0, 100.0, 4)
    turn = Rotation.from_euler("xyz", (1.0, -2.0, 0.5))
    vectors = ("gyroscope", "accelerometer", "gravity")
    motion = by_vqf(replace(motion, **{name: turn.apply(getattr(motion, name)) for name in vectors}))
    outcome = follow(replace(motion, gyroscope=np.zeros_like(motion.gyroscope)))
    assert not any(outcome.refusals) and np.isfinite(outcome.errors[motion.times > SETTLED]).all()


REPORTED = {
    "acceleration in g": ({"accelerometer": lambda a: a / G}, "it must be in m/s^2, not in g"),
    "acceleration without gravity": (
        {"accelerometer": lambda a: a - np.mean(a[:100], axis=0)},
        "it must contain gravity, +9.8 upward at rest",
    ),
    "z down and y to the right": (
        {"accelerometer": lambda a: a * (1, -1, -1), "gyroscope": lambda w: w * (1, -1, -1),
         "orientation": lambda q: q * (1, -1, -1, 1)},
        "it must point upward at rest (REP-145)",
    ),
    "rates in deg/s": ({"gyroscope": np.degrees}, "check unit, axes and signs of the gyroscope"),
}  # fmt: skip


@pytest.mark.parametrize("fault", REPORTED)
@pytest.mark.parametrize("trunk", [bowing(0.6), bowing_trunk], ids=["bows", "bows and walks"])
@pytest.mark.parametrize("filled_in", [False, True], ids=["true", "filled in"])
def test_wrong_units_frames_and_removed_gravity_are_named_and_no_tilt_is_published(
    fault: str, trunk: Trunk, filled_in: bool
) -> None:
    changes, name = REPORTED[fault]
    motion = constant(reporting(trunk)) if filled_in else reporting(trunk)
    motion = replace(motion, **{part: change(getattr(motion, part)) for part, change in changes.items()})
    outcome = follow(motion)
    assert np.isnan(outcome.errors).all()
    assert any(name in text for text in outcome.refusals)


@pytest.mark.parametrize("share", [(1.0, -1.0, 1.0), (0.5, 0.5, 0.5)], ids=["reversed", "half the scale"])
def test_a_gyroscope_that_turns_otherwise_than_the_orientation_is_named_in_the_first_bow(share: tuple) -> None:
    motion = reporting(bowing(0.6))
    outcome = follow(replace(motion, gyroscope=motion.gyroscope * share))
    named = [k for k, text in enumerate(outcome.refusals) if "check unit, axes and signs of the gyroscope" in text]
    assert BOW[0] < motion.times[named[0]] < BOW[1]
    assert np.isnan(outcome.errors[motion.times > BOW[1]]).all()


def test_a_gyroscope_with_a_dead_band_or_a_bias_is_no_contradiction() -> None:
    motion = reporting(bowing(0.6))
    rates = motion.gyroscope
    for changed in (np.where(np.abs(rates) < 0.01, 0.0, rates), rates + np.array((0.05, -0.05, 0.02))):
        outcome = follow(replace(motion, gyroscope=changed))
        assert not any(outcome.refusals) and np.isfinite(outcome.errors[motion.times > SETTLED]).all()


@pytest.mark.parametrize("is_reported", [True, False])
def test_samples_at_10_hz_are_refused_with_the_rate_that_is_needed_and_at_20_hz_followed(is_reported: bool) -> None:
    slow, enough = (reporting(bowing_trunk, 15.0, rate) for rate in (10.0, 20.0))
    if not is_reported:
        slow, enough = (replace(motion, orientation=None) for motion in (slow, enough))
    outcome = follow(replace(slow, rate=100.0))  # as the parameter says
    assert np.isnan(outcome.errors).all()
    assert "must be 20 or more; they come at 10 Hz: set a higher rate" in outcome.refusals[-1]
    outcome = follow(replace(enough, rate=100.0))
    assert not any(outcome.refusals) and np.isfinite(outcome.errors[enough.times > 3.0]).mean() > 0.99
    assert np.nanmax(outcome.errors) < 4.5
