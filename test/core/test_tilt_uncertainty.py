# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How much each thing that was not measured adds to the tilt's uncertainty, and when the estimate starts again."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core.trunk.uncertainty import MODEL, TiltUncertainty
from exo_gravity.hardware.trunk_estimator import TUNING, VqfFusion

G = 9.80665
RANGE = 34.9  # rad/s
STILL = (0.0, 0.0, 0.0)


def settled(acceleration=0.0, seconds=12.0):
    """An uncertainty after `seconds` at 100 Hz, while the rate changes by `acceleration` rad/s^2."""
    uncertainty = TiltUncertainty(0.01)
    for _ in range(round(50 * seconds)):
        go_on(uncertainty, acceleration)
    return uncertainty


def go_on(uncertainty, acceleration=0.0, square=0.0):
    uncertainty.advance(0.02, 2, acceleration, 0.0, square, 0.0)


def added(uncertainty):
    """The standard deviation in rad beyond that of an estimate that has lost nothing."""
    return math.sqrt(uncertainty.sigma**2 - MODEL.fused**2)


def test_an_estimate_that_has_lost_nothing_has_vqfs_own_error():
    assert settled().sigma == pytest.approx(MODEL.fused)


def test_saturated_samples_add_up_over_a_run():
    uncertainty = settled()
    for _ in range(3):
        uncertainty.add_unmeasured(0.001, 0.0, TUNING.overshoot * RANGE, 0.0)
    assert added(uncertainty) == pytest.approx(3 * TUNING.overshoot * RANGE * 0.001, rel=0.01)


@pytest.mark.parametrize(("acceleration", "assumed"), [(0.0, 20.0), (100.0, 100.0)])
@pytest.mark.parametrize(("gap", "share"), [(0.05, 1 / 6), (0.02, 1 / 15)])
def test_a_gap_adds_by_its_square_and_the_angular_acceleration_before_it(acceleration, assumed, gap, share):
    uncertainty = settled(acceleration)
    uncertainty.add_unmeasured(gap, 0.0, 0.0, 0.0)
    assert added(uncertainty) == pytest.approx(assumed * gap**2 * share, rel=0.05)


def test_repeated_samples_add_by_the_square_of_their_time():
    uncertainty = settled(acceleration=100.0)
    for k in range(1, 4):
        uncertainty.add_unmeasured(0.01, 0.0, 0.0, 0.01 * k)
    assert added(uncertainty) == pytest.approx(0.5 * 100.0 * 0.03**2, rel=0.1)


def test_what_was_lost_decays_and_too_much_makes_the_estimate_begin_anew():
    uncertainty = settled()
    assert not uncertainty.add_unmeasured(0.002, 0.0, TUNING.overshoot * RANGE, 0.0)
    before = added(uncertainty)
    uncertainty.add_unmeasured(0.01, 0.0, 0.0, 0.0)  # a good sample ends the run
    for _ in range(round(50 * MODEL.decay_time)):
        go_on(uncertainty)
    assert added(uncertainty) == pytest.approx(before / math.e, rel=0.02)
    assert uncertainty.add_unmeasured(0.004, 0.0, TUNING.overshoot * RANGE, 0.0)
    assert added(uncertainty) > 0.03 and uncertainty.sigma > MODEL.limit


def test_a_start_in_motion_takes_longer_and_an_unknown_bias_and_a_contradiction_widen_it():
    still, moving = TiltUncertainty(0.01), TiltUncertainty(0.01)
    for _ in range(60):
        go_on(still, square=4e-6)
        go_on(moving, square=0.5)
    assert still.sigma < MODEL.limit < moving.sigma
    still.advance(0.02, 2, 0.0, 0.02, 0.0, 0.0)
    assert still.sigma > MODEL.limit
    still.advance(0.02, 2, 0.0, 0.0, 0.0, math.radians(3.5))
    assert still.sigma > MODEL.limit


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
