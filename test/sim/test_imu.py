# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The simulated IMU: axes, signs, noise and bias."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.sim import ImuConfig, SimulatedImu
from exo_gravity.sim.trunk_motion import HIP_TO_SHOULDER, TrunkState, Turn, Walk

from ..support.trunk import orientation

G = 9.80665
QUIET = {f"{sensor}_{error}": 0.0 for sensor in ("gyroscope", "accelerometer") for error in ("noise", "walk")}
EXACT = {**QUIET, "gyroscope_bias": 0.0, "accelerometer_bias": 0.0, "delay": 0.0}
# Turned by 120 degrees about (1, 1, 1): the IMU's x, y, z point along the trunk's y, z, x.
MOUNTED = (0.5, 0.5, 0.5, 0.5)


def test_a_bow_acts_on_the_x_axis_and_a_lean_to_the_right_on_the_y_axis():
    imu = SimulatedImu(ImuConfig(**EXACT))
    np.testing.assert_allclose(imu.sample(TrunkState(0.3, 0.0))[1], (-G * math.sin(0.3), 0, G * math.cos(0.3)))
    np.testing.assert_allclose(imu.sample(TrunkState(0.0, 0.3))[1], (0, G * math.sin(0.3), G * math.cos(0.3)))


def test_readings_are_in_the_imus_own_axes():
    imu = SimulatedImu(ImuConfig(rotation_trunk_from_imu=MOUNTED, **EXACT))
    gyroscope, accelerometer = imu.sample(TrunkState(0, 0, 0.2, 0.1))
    np.testing.assert_allclose(accelerometer, (0, G, 0), atol=1e-12)
    np.testing.assert_allclose(gyroscope, (0.2, 0, 0.1), atol=1e-12)


def test_noise_has_the_configured_density():
    rate = 200.0
    imu = SimulatedImu(ImuConfig(rate=rate))
    samples = np.array([imu.sample(TrunkState(0.0, 0.0)) for _ in range(4000)])
    spread = samples.std(axis=0) / math.sqrt(rate / 2)
    np.testing.assert_allclose(spread[0], math.radians(0.007), rtol=0.05)
    np.testing.assert_allclose(spread[1], 180e-6 * G, rtol=0.05)


def test_biases_without_a_random_walk_are_constant_and_have_the_configured_size():
    biases = []
    for seed in range(400):
        imu = SimulatedImu(ImuConfig(seed=seed, **QUIET))
        first, second = (np.array(imu.sample(TrunkState(0.0, 0.0))) for _ in range(2))
        np.testing.assert_array_equal(first, second)
        biases.append(first - ((0, 0, 0), (0, 0, G)))
    np.testing.assert_allclose(np.std(biases, axis=(0, 2)), (math.radians(0.1), 5e-3 * G), rtol=0.1)


def test_biases_walk_at_random_as_configured():
    ends = []
    for seed in range(200):
        walk = {"gyroscope_walk": 0.01, "accelerometer_walk": 0.1}
        imu = SimulatedImu(ImuConfig(**{**EXACT, **walk, "rate": 10.0, "seed": seed}))
        after_4_s = [imu.sample(TrunkState(0.0, 0.0)) for _ in range(40)][-1]
        ends.append(after_4_s - np.array(((0, 0, 0), (0, 0, G))))
    np.testing.assert_allclose(np.std(ends, axis=(0, 2)), (0.02, 0.2), rtol=0.1)


def test_the_accelerometer_measures_the_trunks_acceleration_less_gravity():
    walk = Walk((0.3, -0.2), 10.0)
    for t in (2.1, 3.3, 4.7):
        state = walk.at(t)
        gyroscope, accelerometer = SimulatedImu(ImuConfig(**EXACT)).sample(state)
        force = orientation(state) @ state.acceleration + (0.0, 0.0, G)
        np.testing.assert_allclose(orientation(state) @ accelerometer, force, atol=1e-9)
        np.testing.assert_allclose(gyroscope, state.angular_velocity)


def test_an_imu_away_from_the_shoulder_feels_the_acceleration_of_its_own_place():
    # At the hips, about which a bow turns, there is none.
    bow = Turn((0.0, 0.0), (0.7, 0.2), 1.0).at(0.4)
    at_hips = SimulatedImu(ImuConfig(**EXACT, position=(0.0, 0.0, -HIP_TO_SHOULDER[2]))).sample(bow)[1]
    still = SimulatedImu(ImuConfig(**EXACT)).sample(TrunkState(bow.pitch, bow.roll))[1]
    assert np.linalg.norm(bow.acceleration) > 0.5
    np.testing.assert_allclose(at_hips, still, atol=1e-9)


def test_readings_beyond_the_range_are_cut_off():
    imu = SimulatedImu(ImuConfig(**EXACT, gyroscope_range=1.0, accelerometer_range=5.0))
    gyroscope, accelerometer = imu.sample(TrunkState(0.0, 0.0, pitch_rate=-3.0, roll_rate=0.5))
    np.testing.assert_allclose(gyroscope, (0.5, -1.0, 0.0))
    np.testing.assert_allclose(accelerometer, (0.0, 0.0, 5.0))


@pytest.mark.parametrize("delay", [0.0, 0.003, 0.01, 0.025])
def test_readings_lag_by_the_delay(delay):
    imu = SimulatedImu(ImuConfig(**{**EXACT, "delay": delay}))
    times = np.arange(100) / 100.0
    rates = [imu.sample(TrunkState(0.0, 0.0, roll_rate=t))[0][0] for t in times]
    np.testing.assert_allclose(rates[10:], times[10:] - delay, atol=1e-12)


def test_the_same_seed_gives_the_same_samples():
    one, other, third = (SimulatedImu(ImuConfig(seed=seed)).sample(TrunkState(0.1, 0.2)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, other)
    assert not np.array_equal(one, third)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"rotation_trunk_from_imu": (0, 0, 0, 2)}, "rotation_trunk_from_imu"),
        ({"rate": 0.0}, "rate"),
        ({"gravity": -1.0}, "gravity"),
        ({"delay": -0.1}, "delay"),
    ],
)
def test_an_impossible_configuration_is_rejected_by_name(change, name):
    with pytest.raises(ParameterError) as caught:
        ImuConfig(**change)
    assert caught.value.name == name
