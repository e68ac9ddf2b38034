# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The trunk's motions: each agrees with its own derivatives, begins and ends at rest, and is as large as it says."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.sim.script import Step
from exo_gravity.sim.trunk_motion import HIP_TO_SHOULDER, SitDown, Turn, Walk, motion_of

from ..support.trunk import orientation

START = (0.1, -0.06)
MOTIONS = {
    "bow": (Turn(START, (0.8, -0.06), 3.0), 3.0),
    "lean": (Turn(START, (0.1, 0.5), 2.0), 2.0),
    "walk": (Walk(START, 8.0), 8.0),
    "sit": (SitDown(START), 1.0),
}
each_motion = pytest.mark.parametrize(("motion", "duration"), MOTIONS.values(), ids=MOTIONS)


@each_motion
def test_rates_and_accelerations_are_the_derivatives_of_the_tilt(motion, duration):
    step = 1e-5
    for t in np.linspace(0.03, duration - 0.03, 40):
        before, here, after = (np.array(motion.at(t + n * step)[:6]) for n in (-1, 0, 1))
        np.testing.assert_allclose((after - before)[:4] / (2 * step), here[2:], atol=1e-4)


@each_motion
def test_the_angular_velocity_is_that_of_the_orientation(motion, duration):
    step = 1e-6
    for t in np.linspace(0.0, duration, 20):
        change = (orientation(motion.at(t + step)) - orientation(motion.at(t - step))) / (2 * step)
        spin = orientation(motion.at(t)).T @ change
        x, y, z = motion.at(t).angular_velocity
        np.testing.assert_allclose(spin, ((0, -z, y), (z, 0, -x), (-y, x, 0)), atol=1e-5)


@each_motion
def test_the_angular_acceleration_is_the_derivative_of_the_angular_velocity(motion, duration):
    step = 1e-5
    for t in np.linspace(0.03, duration - 0.03, 20):
        before, after = (np.array(motion.at(t + n * step).angular_velocity) for n in (-1, 1))
        np.testing.assert_allclose((after - before) / (2 * step), motion.at(t).angular_acceleration, atol=1e-4)


@each_motion
def test_a_motion_begins_at_its_start_and_ends_at_rest(motion, duration):
    for state in (motion.at(0.0), motion.at(duration)):
        np.testing.assert_allclose(state[2:6], 0.0, atol=1e-9)
        np.testing.assert_allclose(state.acceleration, 0.0, atol=1e-9)
    np.testing.assert_allclose(motion.at(0.0)[:2], START, atol=1e-12)


@pytest.mark.parametrize("name", ["bow", "lean"])
def test_a_turning_trunk_accelerates_its_shoulder_about_the_hips(name):
    motion, duration = MOTIONS[name]
    step = 1e-4
    for t in np.linspace(0.1, duration - 0.1, 20):
        before, here, after = (orientation(motion.at(t + n * step)) @ HIP_TO_SHOULDER for n in (-1, 0, 1))
        acceleration = orientation(motion.at(t)).T @ (before - 2 * here + after) / step**2
        np.testing.assert_allclose(motion.at(t).acceleration, acceleration, atol=1e-4)


def test_walking_accelerates_the_trunk_as_much_as_measured_and_goes_nowhere_but_forward():
    times = np.arange(2.0, 58.0, 0.01)
    states = [Walk((0.0, 0.0), 60.0).at(t) for t in times]
    world = np.array([orientation(state) @ state.acceleration for state in states]) / 9.80665
    forward, lateral, vertical = np.sqrt(np.mean(world**2, axis=0))
    assert 0.1 < vertical < 0.3 and 0.05 < lateral < 0.2 and 0.05 < forward < 0.2
    np.testing.assert_allclose(world.mean(axis=0), 0.0, atol=0.002)
    pitch, roll = np.degrees([state[:2] for state in states]).T
    assert 1.9 < np.ptp(pitch) < 2.1 and 3.9 < np.ptp(roll) < 4.1


def test_walking_bent_forward_the_steps_still_shake_the_trunk_vertically():
    upright, bent = Walk((0.0, 0.0), 8.0, pitch_sway=0.0).at(4.0), Walk((0.7, 0.2), 8.0, pitch_sway=0.0).at(4.0)
    there = orientation(upright) @ upright.acceleration
    np.testing.assert_allclose(orientation(bent) @ bent.acceleration, there, atol=1e-9)


def test_the_shock_of_sitting_down_stops_the_fall():
    motion, step = SitDown((0.0, 0.0)), 1e-4
    up = np.array([motion.at(t).acceleration[2] for t in np.arange(0.0, 1.0, step)])
    speed = np.cumsum(up) * step
    assert speed.min() == pytest.approx(-0.8, abs=1e-3)
    assert speed[-1] == pytest.approx(0.0, abs=1e-3)
    assert up.max() == pytest.approx(1.28 * 9.80665, rel=0.01)


def test_a_step_of_a_script_names_the_motion():
    assert motion_of(Step("bow", 3.0, (0.5,)), 0.1, 0.2) == Turn((0.1, 0.2), (0.5, 0.2), 3.0)
    assert motion_of(Step("lean", 3.0, (0.5,)), 0.1, 0.2) == Turn((0.1, 0.2), (0.1, 0.5), 3.0)
    assert motion_of(Step("walk", 3.0), 0.1, 0.2) == Walk((0.1, 0.2), 3.0)
    assert motion_of(Step("sit", 3.0), 0.1, 0.2) == SitDown((0.1, 0.2))
    assert motion_of(Step("hold", 3.0), 0.1, 0.2) is None
