# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The mounting of an IMU, from simulated records of a person who stands, bows and stands."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core.arm.tilt import rotation_matrix
from exo_gravity.core.errors import DataError
from exo_gravity.lab.calibration.imu import ImuRecord, mounting, six_rests
from exo_gravity.sim.imu import ImuConfig, SimulatedImu
from exo_gravity.sim.trunk_motion import TrunkState

from ..support.imu_records import RATE, record, rests


def random_quaternion(rng: np.random.Generator) -> np.ndarray:
    quaternion = rng.standard_normal(4)
    return quaternion / np.linalg.norm(quaternion)


def angle_of(error: np.ndarray) -> float:
    """Return the angle in rad of a rotation matrix."""
    return math.acos(max(-1.0, min(1.0, (np.trace(error) - 1.0) / 2.0)))


@pytest.mark.parametrize("seed", range(8))
def test_any_mounting_is_found_within_its_stated_error(seed: int) -> None:
    quaternion = random_quaternion(np.random.default_rng(seed))
    found = mounting(record(quaternion, seed=seed))
    error = rotation_matrix(found.quaternion) @ rotation_matrix(quaternion).T
    assert angle_of(error) < math.radians(1.5)
    assert angle_of(error) < 2.0 * np.linalg.norm(found.error)
    assert found.bow == pytest.approx(0.7, abs=0.03)
    assert found.quaternion[3] >= 0.0 and np.linalg.norm(found.quaternion) == pytest.approx(1.0)


def test_three_bows_are_averaged() -> None:
    quaternion = np.array((0.0, 0.0, 0.0, 1.0))
    leans = (0.09, -0.05, -0.04)
    bows = [record(quaternion, lean=lean, seed=seed) for seed, lean in enumerate(leans)]
    length = bows[0].time[-1] + 1.0 / RATE
    time = np.concatenate([bow.time + i * length for i, bow in enumerate(bows)])
    together = mounting(ImuRecord(time, *(np.concatenate(column) for column in list(zip(*bows, strict=True))[1:])))
    one = mounting(bows[0])
    assert (one.bows, together.bows) == (1, 3)
    assert angle_of(rotation_matrix(one.quaternion)) > 0.08
    assert angle_of(rotation_matrix(together.quaternion)) < 0.02
    assert together.error[2] < one.error[2]


def test_a_bias_of_the_gyroscope_does_no_harm() -> None:
    still = record(np.array((0.0, 0.0, 0.0, 1.0)))
    shifted = still._replace(angular_velocity=still.angular_velocity + np.array((0.03, -0.02, 0.01)))
    assert mounting(shifted).quaternion == pytest.approx(mounting(still).quaternion, abs=1e-3)


def test_a_crooked_posture_is_part_of_the_result_and_a_lean_counts_into_its_error() -> None:
    quaternion = np.array((0.0, 0.0, 0.0, 1.0))
    straight, leaning = (mounting(record(quaternion, lean=lean)) for lean in (0.0, 0.09))
    assert leaning.error[2] > straight.error[2]
    crooked = mounting(record(quaternion, posture=(0.05, 0.0)))
    assert angle_of(rotation_matrix(crooked.quaternion)) == pytest.approx(0.05, abs=0.015)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"bow": 0.2}, "the bow was 1[12] degrees, must be 20 or more"),
        ({"lean": 0.5, "posture": (0.0, -0.3)}, "not about one axis"),
        ({"upright": 0.0}, "must begin and end upright"),
    ],
)
def test_a_bow_that_shows_nothing_is_refused(changes: dict[str, object], sentence: str) -> None:
    if "lean" in changes:  # leans first, then bows: no single axis
        time = np.arange(0.0, 9.0, 1.0 / RATE)
        first = np.clip((time - 2.0) / 0.7, 0.0, 1.0) - np.clip((time - 5.5) / 0.7, 0.0, 1.0)
        then = np.clip((time - 2.7) / 0.8, 0.0, 1.0) - np.clip((time - 6.2) / 0.8, 0.0, 1.0)
        imu = SimulatedImu(ImuConfig(rate=RATE))
        pitch, roll = 0.5 * then, 0.5 * first
        rates = np.gradient(pitch, time), np.gradient(roll, time)
        samples = [imu.sample(TrunkState(*row)) for row in zip(pitch, roll, *rates, strict=True)]
        taken = ImuRecord(time, *(np.array(column) for column in zip(*samples, strict=True)))
    else:
        taken = record(np.array((0.0, 0.0, 0.0, 1.0)), **changes)  # type: ignore[arg-type]
    with pytest.raises(DataError, match=sentence):
        mounting(taken)


@pytest.mark.parametrize(
    ("factor", "sentence"),
    [((1.0, -1.0), "check units and signs"), ((1.0, 57.3), "."), ((0.102, 1.0), "shows 0.10 g, must be 1")],
)
def test_wrong_units_and_signs_are_refused(factor: tuple[float, float], sentence: str) -> None:
    taken = record(np.array((0.0, 0.0, 0.0, 1.0)))
    wrong = ImuRecord(taken.time, factor[1] * taken.angular_velocity, factor[0] * taken.acceleration)
    with pytest.raises(DataError, match=sentence):
        mounting(wrong)


def test_an_imu_that_is_never_still_or_silent_is_refused() -> None:
    time = np.arange(0.0, 5.0, 0.01)
    shaken = np.stack([np.sin(40.0 * time + phase) for phase in (0, 1, 2)], axis=1)
    with pytest.raises(DataError, match="never still"):
        mounting(ImuRecord(time, shaken, 9.81 * shaken))
    with pytest.raises(DataError, match="3 IMU samples"):
        mounting(ImuRecord(time[:3], shaken[:3], shaken[:3]))


def test_six_rests_show_scale_and_bias_of_the_accelerometer() -> None:
    scale, bias = np.array((1.02, 0.97, 1.01)), np.array((0.2, -0.3, 0.1))
    found_scale, found_bias, remainder = six_rests(rests(6, scale, bias))
    assert found_scale == pytest.approx(scale, abs=1e-3)
    assert found_bias == pytest.approx(bias, abs=5e-3)
    assert remainder < 0.01


def test_five_rests_are_too_few() -> None:
    with pytest.raises(DataError, match="on 5 different sides, must be 6"):
        six_rests(rests(5, np.ones(3), np.zeros(3)))
