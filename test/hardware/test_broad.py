# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The estimator on real motion with an optical reference: excerpts of BROAD, see test/data/broad/README.md."""

from __future__ import annotations

import numpy as np
import pytest

from bench.imu_report import report
from bench.imu_trials import Trial, by_estimator, by_vqf, lost_samples, read_trials, score

from ..support.thorough import quick

TRIALS = list(read_trials())
EACH = pytest.mark.parametrize("number", quick((0, 1), range(len(TRIALS))), ids=[trial.name for trial in TRIALS])


@EACH
def test_on_real_motion_the_tilt_is_as_good_as_vqfs_and_never_off_by_5_degrees(number):
    trial = TRIALS[number]
    here = score(trial.without(lost_samples(len(trial.times), 0.03)), "here")
    vqf = score(trial, "VQF, its defaults")
    assert here.rms <= max(1.1 * vqf.rms, vqf.rms + 0.1)
    assert here.largest < 5.0
    assert here.published >= 0.99


def test_evenly_spaced_samples_give_vqf_alone():
    trial = TRIALS[0]
    (here, _), (alone, _) = by_estimator(trial), by_vqf(trial)
    published = np.isfinite(here[:, 0])
    assert published.mean() > 0.9
    # The bias is read every tenth sample, and matters only to rounding.
    np.testing.assert_allclose(here[published], alone[published], atol=1e-5)


def test_jitter_of_the_stamps_costs_little():
    trial = TRIALS[2]
    jitter = np.random.default_rng(1).uniform(-0.3, 0.3, len(trial.times)) / trial.rate
    jittered = type(trial)(**{**vars(trial), "times": trial.times + jitter})
    assert score(jittered, "here").rms < score(trial, "here").rms + 0.1
    assert score(jittered, "here").published >= 0.99


@EACH
def test_a_start_amid_strong_motion_gives_a_tilt_within_12_seconds(number):
    trial = TRIALS[number]
    # Motion that is played forward and then backward has no jump: rates change their sign, forces do not.
    rates, forces = (
        np.concatenate((values, sign * values[::-1]))
        for values, sign in ((trial.angular_velocity, -1.0), (trial.acceleration, 1.0))
    )
    for start in np.linspace(np.flatnonzero(trial.counts)[0], len(trial.times) - 2.0 * trial.rate, 5).astype(int):
        part = slice(start, start + round(12.0 * trial.rate))
        times = np.arange(part.stop - part.start) / trial.rate
        nothing = np.zeros((len(times), 3))
        shaken = Trial(trial.name, trial.rate, times, rates[part], forces[part], nothing, nothing[:, 0] == 0.0)
        assert np.isfinite(by_estimator(shaken)[0]).any()


def test_the_report_has_a_row_for_each_trial_and_a_column_for_each_method():
    lines = report(TRIALS[:1]).splitlines()
    assert len(lines) == 4 and lines[0].startswith("| trial | here | published |")
    assert lines[2].startswith("| 03 undisturbed slow rotation C | 0.")
