# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Ordinary drivers with true data: no sample is refused, the tilt never stays away, and it is right."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.ordinary.drivers import DURATION, Timing, even, ordinary_drivers, true_stamps

from ..support.imu_drivers import driven, swaying_trunk
from ..support.imu_faults import bowing_trunk, follow, sampled
from ..support.thorough import quick

DRIVERS = ordinary_drivers()
TRUNKS = {"sways": swaying_trunk, "bows and walks": bowing_trunk}
SETTLED = 1.2  # s
LONGEST = 0.1  # s without a tilt, beyond the longest pause of the driver itself


def longest_without_tilt(motion, outcome):
    """In s, by the arrival of the samples."""
    arrived = motion.arrivals[np.isfinite(outcome.errors)]
    arrived = np.concatenate(([SETTLED], arrived[arrived > SETTLED], [motion.arrivals[-1]]))
    return np.diff(arrived).max()


SWAYING = [(name, "sways") for name in DRIVERS]
PLAYED = [*SWAYING, *((name, "bows and walks") for name in list(DRIVERS)[::8])]


@pytest.mark.parametrize(("driver", "trunk"), quick([*SWAYING[::5], PLAYED[-1]], PLAYED))
def test_no_sample_is_refused_and_the_tilt_is_always_there_and_right(driver, trunk):
    timing = DRIVERS[driver]
    motion = driven(TRUNKS[trunk], timing)
    outcome = follow(motion)
    assert not any(outcome.refusals)
    pause = np.diff(timing.arrivals).max()
    assert longest_without_tilt(motion, outcome) < max(LONGEST, pause + 0.01)
    # 0.5 degrees of it are the bias of the accelerometer; a stamp at arrival adds the turn since the sample.
    late = np.abs(timing.stamps - timing.taken).max()
    assert np.nanmax(outcome.errors) < 1.25 + math.degrees(0.7 * late)


def test_uneven_intervals_give_the_tilt_of_even_ones():
    random = np.random.default_rng(6)
    uneven = np.cumsum(random.uniform(0.002, 0.018, round(DURATION / 0.01)))
    worst = []
    for taken in (even(), uneven):
        motion = sampled(swaying_trunk, taken, np.diff(taken, prepend=-0.01), 100.0)
        errors = follow(motion).errors[taken > 2.0]
        worst.append((np.nanmax(errors), np.sqrt(np.nanmean(errors**2))))
    np.testing.assert_allclose(worst[1], worst[0], atol=0.05)


def test_a_sensor_that_is_polled_twice_as_often_as_it_measures_is_followed():
    taken = even(200.0)
    motion = driven(swaying_trunk, Timing(np.floor(taken / 0.01) * 0.01, taken, taken))
    values = np.arange(len(taken)) // 2 * 2  # the same noise too
    motion.gyroscope[:], motion.accelerometer[:] = motion.gyroscope[values], motion.accelerometer[values]
    outcome = follow(motion)
    assert not any(outcome.refusals) and np.nanmax(outcome.errors) < 1.5
    assert longest_without_tilt(motion, outcome) < LONGEST


def test_a_reported_orientation_in_batches_is_followed():
    def trunk(times):  # turns by up to 1.2 rad/s
        return 4.0 * swaying_trunk(times)

    timing = DRIVERS["arrival, 16 ms timer of an FTDI adapter"]
    motion = replace(driven(trunk, timing), orientation=Rotation.from_euler("xyz", trunk(timing.taken)).as_quat())
    outcome = follow(motion)
    assert not any(outcome.refusals) and np.isfinite(outcome.errors[110:]).all()


def test_a_clock_that_is_a_little_slow_is_followed():
    taken = even()
    motion = driven(swaying_trunk, Timing(taken, 0.98 * taken, taken))
    assert not any(follow(motion).refusals)


def test_samples_delayed_more_and_more_come_from_a_driver_that_lags():
    taken = even()
    lag = np.clip(taken - 10.0, 0.0, None) * 0.2
    outcome = follow(driven(swaying_trunk, true_stamps(taken, taken + lag)))
    named = [k for k, text in enumerate(outcome.refusals) if "by a clock as fast as this computer's" in text]
    assert 1000 < named[0] < 1100
