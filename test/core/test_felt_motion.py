# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The trunk's motion, extrapolated to the moment at which the motors answer it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trunk.inputs import FELT, FeltMotion

G = 9.80665
STILL = (0.0, 0.0, 0.0)


def following(force, spin, until=1.0, period=0.01):
    """A follower of the vectors force(t) and spin(t), sampled until `until`."""
    felt = FeltMotion()
    for t in np.arange(0.0, until + period / 2, period):
        felt.add(t, force(t), spin(t))
    return felt


def shaken(t, frequency=1.9):
    return 0.0, 0.0, G + 2.0 * math.cos(2 * math.pi * frequency * t)


def test_an_arm_on_a_trunk_at_rest_feels_gravity():
    felt = following(lambda t: (0.0, 0.0, G), lambda t: STILL).at(1.004)
    np.testing.assert_allclose(felt.gravity, (0.0, 0.0, -G), atol=1e-9)
    np.testing.assert_allclose(felt.angular_acceleration, 0.0, atol=1e-9)


@pytest.mark.parametrize("age", [0.0, 0.004, 0.01])
@pytest.mark.parametrize(("frequency", "share"), [(1.9, 0.03), (3.8, 0.15)])
def test_a_shake_is_felt_as_it_will_be_when_the_motors_answer(age, frequency, share):
    felt = following(lambda t: shaken(t, frequency), lambda t: STILL).at(1.0 + age)
    assert felt.gravity[2] == pytest.approx(-shaken(1.0 + age + FELT.effect, frequency)[2], abs=share * 2.0)


def test_the_angular_acceleration_is_that_of_the_sway_when_the_motors_answer():
    w, sway = 2 * math.pi * 0.95, 0.2
    felt = following(shaken, lambda t: (sway * math.sin(w * t), 0.0, 0.0)).at(1.004)
    assert felt.angular_acceleration[0] == pytest.approx(sway * w * math.cos(w * (1.004 + FELT.effect)), rel=0.05)


def test_too_few_or_too_old_samples_give_no_motion():
    assert FeltMotion().at(0.0) is None
    assert following(shaken, lambda t: STILL, until=0.02).at(0.02) is None
    assert following(shaken, lambda t: STILL).at(1.1) is None


@pytest.mark.parametrize("rate", [40.0, 50.0, 250.0, 1000.0])
def test_a_shake_is_felt_at_any_usual_rate(rate):
    felt = following(shaken, lambda t: STILL, period=1.0 / rate).at(1.0)
    assert felt.gravity[2] == pytest.approx(-shaken(1.0 + FELT.effect)[2], abs=0.1)


def test_a_gap_is_not_bridged():
    felt = following(shaken, lambda t: STILL)
    felt.add(1.3, shaken(1.3), STILL)
    assert felt.at(1.3) is None


def test_a_sample_that_is_late_is_ignored():
    felt = following(lambda t: (0.0, 0.0, G), lambda t: STILL)
    felt.add(0.5, (5.0, 5.0, 5.0), STILL)
    np.testing.assert_allclose(felt.at(1.0).gravity, (0.0, 0.0, -G), atol=1e-9)


@pytest.mark.parametrize("force", [0.1, 8.0 * G])
def test_free_fall_and_blows_are_felt_only_within_a_range(force):
    felt = following(lambda t: (0.0, 0.0, force), lambda t: STILL).at(1.0)
    low, high = FELT.range
    assert low - 1e-9 <= np.linalg.norm(felt.gravity) <= high + 1e-9


def test_numbers_that_are_not_finite_are_refused():
    with pytest.raises(ParameterError):
        FeltMotion().add(0.0, (0.0, 0.0, math.nan), STILL)


def test_the_shoulder_of_a_trunk_that_turns_accelerates_other_than_the_imu():
    w, sway, lever = 2 * math.pi * 0.95, 0.3, (0.0, -0.2, 0.1)
    felt = following(lambda t: (0.0, 0.0, G), lambda t: (sway * math.sin(w * t), 0.0, 0.0)).at(1.0, lever)
    phase = w * (1.0 + FELT.effect)
    turning, spin_up = np.array((sway * math.sin(phase), 0, 0)), np.array((sway * w * math.cos(phase), 0, 0))
    expected = (0, 0, -G) - np.cross(spin_up, lever) - np.cross(turning, np.cross(turning, lever))
    np.testing.assert_allclose(felt.gravity, expected, atol=0.02)
    assert np.linalg.norm(expected - (0, 0, -G)) > 0.3
