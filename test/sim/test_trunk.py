# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The simulated trunk and its IMU: motions agree with their own derivatives, readings with the trunk's motion."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exo_gravity.sim import ImuConfig, SimulatedImu
from exo_gravity.sim.script import Step
from exo_gravity.sim.trunk_motion import HIP_TO_SHOULDER, SitDown, TrunkState, Turn, Walk, motion_of

START = (0.1, -0.06)
MOTIONS = {
    "bow": (Turn(START, (0.8, -0.06), 3.0), 3.0),
    "lean": (Turn(START, (0.1, 0.5), 2.0), 2.0),
    "walk": (Walk(START, 8.0), 8.0),
    "sit": (SitDown(START), 1.0),
}
G = 9.80665
UPRIGHT = TrunkState(0.0, 0.0)
QUIET = {f"{sensor}_{error}": 0.0 for sensor in ("gyroscope", "accelerometer") for error in ("noise", "walk")}
EXACT = {**QUIET, "gyroscope_bias": 0.0, "accelerometer_bias": 0.0, "delay": 0.0}
# Turned by 120 degrees about (1, 1, 1): the IMU's x, y, z point along the trunk's y, z, x.
MOUNTED = (0.5, 0.5, 0.5, 0.5)


def orientation(state: TrunkState) -> np.ndarray:
    """Return the rotation (3, 3), world from trunk: a roll, and then a pitch, about fixed axes."""
    return Rotation.from_euler("xyz", (state.roll, state.pitch, 0.0)).as_matrix()


@pytest.mark.parametrize("name", MOTIONS)
def test_rates_and_accelerations_are_the_derivatives_of_the_tilt_and_a_motion_begins_and_ends_at_rest(name):
    motion, duration = MOTIONS[name]
    step = 1e-5
    for t in np.linspace(0.03, duration - 0.03, 40):
        before, state, after = (motion.at(t + n * step) for n in (-1, 0, 1))
        change = np.subtract(after[:4], before[:4]) / (2 * step)
        np.testing.assert_allclose(change, state[2:6], atol=1e-4)
        turned = orientation(state).T @ (orientation(after) - orientation(before)) / (2 * step)
        x, y, z = state.angular_velocity
        np.testing.assert_allclose(turned, ((0, -z, y), (z, 0, -x), (-y, x, 0)), atol=1e-5)
        spun_up = np.subtract(after.angular_velocity, before.angular_velocity) / (2 * step)
        np.testing.assert_allclose(spun_up, state.angular_acceleration, atol=1e-4)
        if name in ("bow", "lean"):  # the shoulder turns about the hips
            shoulder = (orientation(motion.at(t + n * 1e-4)) @ HIP_TO_SHOULDER for n in (-1, 0, 1))
            pushed = orientation(state).T @ np.diff([*shoulder], 2, axis=0)[0] / 1e-8
            np.testing.assert_allclose(state.acceleration, pushed, atol=1e-4)
    for state in (motion.at(0.0), motion.at(duration)):
        np.testing.assert_allclose((*state[2:6], *state.acceleration), 0.0, atol=1e-9)
    np.testing.assert_allclose(motion.at(0.0)[:2], START, atol=1e-12)


def test_walking_accelerates_the_trunk_as_much_as_measured_and_goes_nowhere_but_forward():
    states = [Walk((0.0, 0.0), 60.0).at(t) for t in np.arange(2.0, 58.0, 0.01)]
    world = np.array([orientation(state) @ state.acceleration for state in states]) / G
    forward, lateral, vertical = np.sqrt(np.mean(world**2, axis=0))
    assert 0.1 < vertical < 0.3 and 0.05 < lateral < 0.2 and 0.05 < forward < 0.2
    np.testing.assert_allclose(world.mean(axis=0), 0.0, atol=0.002)
    pitch, roll = np.degrees([state[:2] for state in states]).T
    assert 1.9 < np.ptp(pitch) < 2.1 and 3.9 < np.ptp(roll) < 4.1


def test_the_shock_of_sitting_down_stops_the_fall():
    up = np.array([SitDown((0.0, 0.0)).at(t).acceleration[2] for t in np.arange(0.0, 1.0, 1e-3)])
    speed = np.cumsum(up) * 1e-3
    assert (speed.min(), speed[-1], up.max()) == pytest.approx((-0.8, 0.0, 1.28 * G), abs=0.02)


@pytest.mark.parametrize(
    ("step", "motion"),
    [
        (Step("bow", 3.0, (0.5,)), Turn((0.1, 0.2), (0.5, 0.2), 3.0)),
        (Step("lean", 3.0, (0.5,)), Turn((0.1, 0.2), (0.1, 0.5), 3.0)),
        (Step("walk", 3.0), Walk((0.1, 0.2), 3.0)),
        (Step("sit", 3.0), SitDown((0.1, 0.2))),
        (Step("hold", 3.0), None),
    ],
)
def test_a_step_of_a_script_names_the_motion(step, motion):
    assert motion_of(step, 0.1, 0.2) == motion


# The IMU


@pytest.mark.parametrize(
    ("config", "state", "gyroscope", "accelerometer"),
    [
        ({}, TrunkState(0.3, 0.0), (0, 0, 0), (-G * math.sin(0.3), 0, G * math.cos(0.3))),
        ({}, TrunkState(0.0, 0.3), (0, 0, 0), (0, G * math.sin(0.3), G * math.cos(0.3))),
        ({"rotation_trunk_from_imu": MOUNTED}, TrunkState(0, 0, 0.2, 0.1), (0.2, 0, 0.1), (0, G, 0)),
        (
            {"gyroscope_range": 1.0, "accelerometer_range": 5.0},
            TrunkState(0.0, 0.0, pitch_rate=-3.0, roll_rate=0.5),
            (0.5, -1.0, 0.0),
            (0, 0, 5.0),
        ),
    ],
    ids=["a bow", "a lean to the right", "in its own axes", "beyond the range"],
)
def test_readings_are_in_the_imus_own_axes_and_within_its_range(config, state, gyroscope, accelerometer):
    seen = SimulatedImu(ImuConfig(**EXACT, **config)).sample(state)
    np.testing.assert_allclose(seen, (gyroscope, accelerometer), atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "seeds", "expected"),
    [
        (QUIET, 400, (math.radians(0.1), 5e-3 * G)),
        ({**EXACT, "gyroscope_walk": 0.01, "accelerometer_walk": 0.1, "rate": 10.0}, 200, (0.02, 0.2)),
    ],
    ids=["constant", "walking at random"],
)
def test_biases_have_the_configured_size_after_4_s(changes, seeds, expected):
    imus = [SimulatedImu(ImuConfig(**{**changes, "seed": seed})) for seed in range(seeds)]
    samples = np.array([[imu.sample(UPRIGHT) for _ in range(40)][-1] for imu in imus])
    np.testing.assert_allclose(np.std(samples - ((0, 0, 0), (0, 0, G)), axis=(0, 2)), expected, rtol=0.1)


def test_the_accelerometer_measures_the_acceleration_of_its_own_place_less_gravity():
    state = Walk((0.3, -0.2), 10.0).at(3.3)
    gyroscope, accelerometer = SimulatedImu(ImuConfig(**EXACT)).sample(state)
    force = orientation(state) @ state.acceleration + (0.0, 0.0, G)
    np.testing.assert_allclose(orientation(state) @ accelerometer, force, atol=1e-9)
    np.testing.assert_allclose(gyroscope, state.angular_velocity)
    # At the hips, about which a bow turns, there is none.
    bow = Turn((0.0, 0.0), (0.7, 0.2), 1.0).at(0.4)
    at_hips = SimulatedImu(ImuConfig(**EXACT, position=(0.0, 0.0, -HIP_TO_SHOULDER[2]))).sample(bow)[1]
    still = SimulatedImu(ImuConfig(**EXACT)).sample(TrunkState(bow.pitch, bow.roll))[1]
    assert np.linalg.norm(bow.acceleration) > 0.5
    np.testing.assert_allclose(at_hips, still, atol=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.003, 0.01, 0.025])
def test_readings_lag_by_the_delay(delay):
    imu = SimulatedImu(ImuConfig(**{**EXACT, "delay": delay}))
    times = np.arange(100) / 100.0
    rates = [imu.sample(TrunkState(0.0, 0.0, roll_rate=t))[0][0] for t in times]
    np.testing.assert_allclose(rates[10:], times[10:] - delay, atol=1e-12)
