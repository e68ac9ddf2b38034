# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The trunk's orientation from an IMU: on simulated motions known exactly, and on recorded ones (BROAD)."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exo_gravity.core.arm.interface import STANDARD_GRAVITY as G
from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.trunk_estimator import TUNING, ImuSample, TrunkEstimator

from ..support.imu_motion import RECORDED, angles, by_vqf, down, follow, recorded
from ..support.thorough import quick

ALIGNED = (0.0, 0.0, 0.0, 1.0)


def gravity(estimate):
    return gravity_in_trunk(estimate.pitch, estimate.roll)


def samples_of(orientation, duration=5.0, rate=100.0, start=0.0, report=False, bias=(0.0, 0.0, 0.0)):
    """Samples of an IMU with hardly any noise: `orientation(t)` is world from IMU, a Rotation."""
    times = np.arange(round(duration * rate) + 1) / rate
    world_from_imu = Rotation.concatenate([orientation(t) for t in times])
    noise = 1e-9 * (-1.0) ** np.arange(len(times) - 1)[:, None]
    speeds = (world_from_imu[:-1].inv() * world_from_imu[1:]).as_rotvec() * rate + bias + noise
    accelerations = world_from_imu[1:].inv().apply((0, 0, G)) + noise
    for t, speed, acceleration, now in zip(times[1:], speeds, accelerations, world_from_imu[1:], strict=True):
        yield ImuSample(start + t, speed, acceleration, now.as_quat() if report else None)


def last(estimator, samples):
    answer = None
    for sample in samples:
        answer = estimator.update(sample)
    return answer


@pytest.mark.parametrize("report", [False, True])
def test_any_mounting_of_the_imu_gives_the_tilt_of_the_trunk(report):
    world_from_trunk = Rotation.from_euler("xyz", (0.2, -0.5, 1.0))
    for mounting in (*Rotation.random(5, random_state=1), Rotation.from_quat((1, 0, 0, 0))):  # also upside down
        estimator = TrunkEstimator(mounting.as_quat())
        answer = last(estimator, samples_of(lambda t, fixed=world_from_trunk * mounting: fixed, report=report))
        assert (answer.pitch, answer.roll) == pytest.approx((-0.5, 0.2), abs=1e-4)
        assert down(answer.orientation) == pytest.approx(gravity(answer), abs=1e-6)


def test_the_gyroscope_bias_is_estimated_at_rest():
    estimator = TrunkEstimator(ALIGNED)
    answer = last(estimator, samples_of(lambda t: Rotation.identity(), duration=60.0, bias=(0.03, 0, 0)))
    assert estimator.gyroscope_bias == pytest.approx((0.03, 0, 0), abs=1e-3)
    assert abs(answer.roll) < math.radians(0.3)  # 0.03 rad/s over a gain of 0.5 would be 3.4 degrees


def settled(report=False, mounting=ALIGNED, rate=100.0):
    estimator = TrunkEstimator(mounting, rate)
    assert last(estimator, samples_of(lambda t: Rotation.identity(), report=report, rate=rate)) is not None
    return estimator


GOOD = ImuSample(5.01, (0.0, 0.0, 0.0), (0.0, 0.0, G))
IMPOSSIBLE = {
    "a NaN stamp": GOOD._replace(time=math.nan),
    "an infinite stamp": GOOD._replace(time=math.inf),
    "the last stamp again": GOOD._replace(time=5.0),
    "a stamp before the last": GOOD._replace(time=4.95),
    "a NaN angular velocity": GOOD._replace(angular_velocity=(0, math.nan, 0)),
    "a gyroscope in deg/s": GOOD._replace(angular_velocity=(0, 40.0, 0)),
    "no gyroscope": GOOD._replace(angular_velocity=None),
    "an infinite acceleration": GOOD._replace(acceleration=(0, 0, math.inf)),
    "a dead accelerometer": GOOD._replace(acceleration=(0, 0, 0)),
    "an accelerometer in g": GOOD._replace(acceleration=(0, 0, 1.0)),
    "an accelerometer at 20 g": GOOD._replace(acceleration=(0, 0, 20 * G)),
    "no accelerometer": GOOD._replace(acceleration=None),
    "two axes": GOOD._replace(acceleration=(0, G)),
    "an orientation with one NaN": GOOD._replace(orientation=(0, 0, math.nan, 1)),
    "an orientation without an accelerometer": GOOD._replace(acceleration=None, orientation=ALIGNED),
    "an orientation with a dead accelerometer": GOOD._replace(acceleration=(0, 0, 0), orientation=ALIGNED),
    "an orientation with a gyroscope in deg/s": GOOD._replace(angular_velocity=(0, 40.0, 0), orientation=ALIGNED),
}


@pytest.mark.parametrize("sample", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_an_impossible_sample_is_refused_and_leaves_the_estimate_as_it_was(sample):
    estimator, untouched = settled(), settled()
    with pytest.raises(ParameterError):
        estimator.update(sample)
    assert gravity(estimator.update(GOOD)) == pytest.approx(gravity(untouched.update(GOOD)), abs=1e-12)


@pytest.mark.parametrize("report", [False, True])
@pytest.mark.parametrize("start", [5.0 + TUNING.longest_gap, 1e9, -1e3])
def test_after_a_gap_or_a_clock_jump_there_is_no_estimate_until_it_has_settled_again(report, start):
    estimator = settled(report)
    tilted = Rotation.from_euler("y", 1.0)
    answers = [estimator.update(s) for s in samples_of(lambda t: tilted, start=start, report=report)]
    given = [answer for answer in answers if answer is not None]
    assert answers[0] is None and 0 < len(given) < len(answers) - 90
    assert {round(answer.pitch, 2) for answer in given} == {1.0}


def test_a_jump_of_the_reported_orientation_is_not_passed_on():
    estimator = settled(report=True)
    jumped = Rotation.from_euler("y", 0.3)
    answers = [estimator.update(s) for s in samples_of(lambda t: jumped, duration=0.9, start=5.0, report=True)]
    assert not any(answers) and "jumped" in estimator.settling


FROZEN = [(100.0, 10, 11, None), (100.0, 10, 11, ALIGNED), (20.0, 9, 10, None), (1000.0, 99, 103, None)]


@pytest.mark.parametrize(("rate", "accepted", "refused", "orientation"), FROZEN)
def test_a_frozen_imu_is_refused_after_a_tenth_of_a_second_and_followed_again_once_it_measures(
    rate, accepted, refused, orientation
):
    report = orientation is not None
    estimator = settled(report, rate=rate)
    samples = [GOOD._replace(time=5.0 + (k + 1) / rate, orientation=orientation) for k in range(refused)]
    assert all(estimator.update(sample) for sample in samples[:accepted])
    with pytest.raises(ParameterError, match="the IMU or its driver is frozen"):
        estimator.update(samples[-1])
    begin = 5.4 + refused / rate
    moved = samples_of(lambda t: Rotation.from_euler("y", 0.3), rate=rate, start=begin, report=report)
    tilted = [estimator.update(sample) for sample in moved]
    assert tilted[0] is None and tilted[-1].pitch == pytest.approx(0.3, abs=1e-3)


@pytest.mark.parametrize("missing", [(0.0, 0.0, 0.0, 0.0), (math.nan,) * 4])
def test_an_orientation_of_zeros_or_nan_is_none(missing):
    estimator, without = settled(), settled()
    for k in range(1, 20):
        sample = GOOD._replace(time=5.0 + 0.01 * k, acceleration=(0.0, 0.01 * k, G))
        assert estimator.update(sample._replace(orientation=missing)) == without.update(sample)


def test_without_vqf_an_imu_must_report_its_orientation(monkeypatch):
    monkeypatch.setattr("exo_gravity.hardware.trunk_estimator.VQF", None)
    estimator = settled(report=True)
    with pytest.raises(ParameterError, match="install vqf"):
        estimator.update(GOOD)


@pytest.mark.parametrize(
    ("name", "value"),
    [("rotation_trunk_from_imu", (0, 0, 0, 0)), ("gyroscope_range", 0.0), ("accelerometer_range", 9.0)],
)
def test_a_mounting_or_a_range_that_no_sensor_has_is_refused(name, value):
    with pytest.raises(ParameterError, match=name):
        TrunkEstimator(**{"rotation_trunk_from_imu": ALIGNED, name: value})


def test_values_beyond_the_given_ranges_are_refused_and_at_the_range_accepted():
    estimator = TrunkEstimator(ALIGNED, 100.0, gyroscope_range=4.4, accelerometer_range=19.6)
    last(estimator, samples_of(lambda t: Rotation.identity()))
    with pytest.raises(ParameterError, match="gyroscope_range = 4"):
        estimator.update(GOOD._replace(angular_velocity=(0.0, 5.0, 0.0)))
    with pytest.raises(ParameterError, match="accelerometer_range = 19"):
        estimator.update(GOOD._replace(acceleration=(0.0, 25.0, G)))
    assert estimator.update(GOOD._replace(acceleration=(0.0, 19.6, G))) is not None


EACH = pytest.mark.parametrize("path", quick(RECORDED[:2], RECORDED), ids=[path.stem for path in RECORDED])


def score(motion, gravity, counts):
    """Errors in degrees of the published tilts that count: RMS, largest; and the share of those published."""
    published = counts & np.isfinite(gravity[:, 0])
    errors = angles(gravity[published], motion.gravity[published])
    return np.sqrt(np.mean(errors**2)), errors.max(), published.sum() / counts.sum()


@EACH
def test_on_real_motion_the_tilt_is_as_good_as_vqfs_and_never_off_by_5_degrees(path):
    motion, counts = recorded(path)
    kept = np.random.default_rng(0).random(len(counts)) >= 0.03
    rms, largest, published = score(motion.at(kept), follow(motion.at(kept)).gravity, counts[kept])
    vqf, _, _ = score(motion, down(by_vqf(motion)), counts)
    assert rms <= max(1.1 * vqf, vqf + 0.1) and largest < 5.0 and published >= 0.99


def test_evenly_spaced_samples_give_vqf_alone():
    motion, _ = recorded(RECORDED[0])
    here, alone = follow(motion).gravity, down(by_vqf(motion))
    published = np.isfinite(here[:, 0])
    assert published.mean() > 0.9
    # The bias is read every tenth sample, and matters only to rounding.
    np.testing.assert_allclose(here[published], alone[published], atol=1e-5)


@EACH
def test_a_start_amid_strong_motion_gives_a_tilt_within_12_seconds(path):
    motion, counts = recorded(path)
    begin, end = np.flatnonzero(counts)[0], len(counts) - 12.0 * motion.rate
    for start in np.linspace(begin, end, 5).astype(int):
        began = motion.at(slice(start, start + round(12.0 * motion.rate)))
        assert np.isfinite(follow(began).gravity).any()
