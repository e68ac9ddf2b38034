"""The check of an IMU's stamps: a busy start is learned from, another rate and a second publisher are refused."""

from itertools import pairwise

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.trunk.stamp_check import LEARN_TIME, StampCheck

RATE = 100.0  # Hz, given


def follow(stamps):
    """Check stamps from a start on."""
    check = StampCheck(RATE)
    check.check(stamps[0], 0.0)
    for last, stamp in pairwise(stamps):
        check.check(stamp, stamp - last)


def stamps_of(rate, duration=6.0):
    return np.arange(0.0, duration, 1.0 / rate)


@pytest.mark.parametrize("rate", [90.0, 99.0, 100.0, 101.5, 112.0])
@pytest.mark.parametrize("seed", range(10))
def test_a_busy_computer_at_the_start_does_not_refuse_the_sensor_later(rate, seed):
    rng = np.random.default_rng(seed)
    stamps = stamps_of(rate)
    is_late = (stamps < LEARN_TIME) & (rng.random(stamps.size) < 0.15)
    stamps += np.where(is_late, rng.uniform(0.4, 0.8, stamps.size) / rate, 0.0)
    follow(stamps[(rng.random(stamps.size) > 0.05) | (stamps > LEARN_TIME)])  # and some are lost


def test_stamps_in_whole_milliseconds_pass():
    follow(np.round(stamps_of(112.0), 3))


@pytest.mark.parametrize("rate", [50.0, 84.0, 120.0, 200.0])
def test_another_rate_than_the_given_one_is_named(rate):
    with pytest.raises(ParameterError, match=rf"rate = 100\.0: must be about the {rate:.0f} Hz"):
        follow(stamps_of(rate))


@pytest.mark.parametrize("offset", [0.0003, 0.001, 0.004, 0.005])
def test_a_second_publisher_from_the_start_is_refused(offset):
    first = stamps_of(RATE)
    with pytest.raises(ParameterError, match="a second IMU publishes"):
        follow(np.sort([*first, *(first + offset)]))


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_a_clock_that_changes_its_rate_is_refused(factor):
    stamps = stamps_of(RATE)
    with pytest.raises(ParameterError, match="its clock has changed"):
        follow(np.where(stamps < 3.0, stamps, 3.0 + factor * (stamps - 3.0)))
