"""How much each thing that was not measured adds to the tilt's uncertainty, and when the estimate begins anew."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core.trunk.uncertainty import BASE, DECAY_TIME, OVERSHOOT, TiltUncertainty
from exo_gravity.hardware.trunk_estimator import VqfFusion

G = 9.80665
RANGE = 34.9  # rad/s
STILL = (0.0, 0.0, 0.0)


def settled(acceleration=0.0, seconds=12.0):
    """An uncertainty after `seconds` at 100 Hz, while the rate about x swings with `acceleration` rad/s^2."""
    uncertainty, rate = TiltUncertainty(0.01), STILL
    for k in range(round(100 * seconds)):
        last, rate = rate, (0.01 * acceleration * (k % 2), 0.0, 0.0)
        uncertainty.advance(0.01, rate, last)
        uncertainty.combine(0.0, 0.0, 0.0)
    return uncertainty


def added(uncertainty):
    """The standard deviation in rad beyond that of an estimate that has lost nothing."""
    uncertainty.combine(0.0, 0.0, 0.0)
    return math.sqrt(uncertainty.variance - BASE**2)


def test_an_estimate_that_has_lost_nothing_has_vqfs_own_error():
    assert math.sqrt(settled().variance) == pytest.approx(BASE)


def test_saturated_samples_add_up_over_a_run():
    uncertainty = settled()
    for _ in range(3):
        uncertainty.advance(0.001, STILL, STILL, unknown=OVERSHOOT * RANGE)
    assert added(uncertainty) == pytest.approx(3 * OVERSHOOT * RANGE * 0.001, rel=0.01)


@pytest.mark.parametrize(("acceleration", "assumed"), [(0.0, 20.0), (100.0, 100.0)])
def test_a_gap_adds_by_its_square_and_the_angular_acceleration_of_late(acceleration, assumed):
    uncertainty = settled(acceleration)
    uncertainty.advance(0.05, STILL, STILL)
    assert added(uncertainty) == pytest.approx(assumed * 0.05**2 / 6, rel=0.05)


def test_one_lost_sample_adds_less_than_a_long_gap():
    uncertainty = settled(acceleration=100.0)
    uncertainty.advance(0.02, STILL, STILL)
    assert added(uncertainty) == pytest.approx(100.0 * 0.02**2 / 15, rel=0.05)


def test_repeated_samples_add_by_the_square_of_their_time():
    uncertainty = settled(acceleration=100.0)
    for k in range(1, 4):
        uncertainty.advance(0.01, STILL, STILL, repeated=0.01 * k)
    assert added(uncertainty) == pytest.approx(0.5 * 100.0 * 0.03**2, rel=0.1)


def test_what_was_lost_decays_and_too_much_makes_the_estimate_begin_anew():
    uncertainty = settled()
    uncertainty.advance(0.002, STILL, STILL, unknown=OVERSHOOT * RANGE)
    before = added(uncertainty)
    assert not uncertainty.is_lost
    for _ in range(round(100 * DECAY_TIME)):
        uncertainty.advance(0.01, STILL, STILL)
    assert added(uncertainty) == pytest.approx(before / math.e, rel=0.02)
    uncertainty.advance(0.004, STILL, STILL, unknown=OVERSHOOT * RANGE)
    assert added(uncertainty) > 0.03 and uncertainty.is_lost and not uncertainty.is_settled


def test_a_start_in_motion_takes_longer_and_an_unknown_bias_and_a_contradiction_widen_it():
    still, moving = TiltUncertainty(0.01), TiltUncertainty(0.01)
    for _ in range(120):
        for uncertainty, square in ((still, 4e-6), (moving, 0.5)):
            uncertainty.advance(0.01, STILL, STILL)
            uncertainty.combine(0.0, square, 0.0)
    assert still.is_settled and not moving.is_settled
    still.combine(0.02, 0.0, 0.0)
    assert not still.is_settled
    still.combine(0.0, 0.0, math.radians(3.5))
    assert not still.is_settled


def turned(samples):
    """The angle in rad about z after (dt, rate about z) for each sample."""
    orientation, last = VqfFusion(0.01), STILL
    for dt, rate in samples:
        now = (0.0, 0.0, rate)
        _, _, z, w = orientation.advance(dt, now, last, (0.0, 0.0, G))
        last = now
    return 2.0 * math.atan2(z, w)


def test_over_a_gap_the_rates_between_are_interpolated():
    ramp = [(0.01, 0.02 * k) for k in range(1, 41)]
    whole = turned(ramp)
    with_gap = turned([*ramp[:19], (0.04, ramp[22][1]), *ramp[23:]])
    assert whole > 0.15 and with_gap == pytest.approx(whole, abs=1e-4)


def test_a_restart_keeps_the_bias():
    orientation = VqfFusion(0.01)
    random = np.random.default_rng(4)
    for _ in range(1000):
        x, y, z = random.normal(0.0, 1e-3, 3)
        orientation.advance(0.01, (0.02 + x, y, z), (0.02, 0.0, 0.0), (x, y, G))
    orientation.restart()
    for _ in range(30):
        orientation.advance(0.01, (0.02, 0.0, 0.0), (0.02, 0.0, 0.0), (0.0, 0.0, G))
    assert orientation.bias[0] == pytest.approx(0.02, abs=2e-3)
