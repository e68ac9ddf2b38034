# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The trunk's orientation from an IMU: on simulated motions known exactly, on recorded ones (BROAD), and in situations.

Ordinary situations are followed; faults are named before a wrong tilt is published. Every published tilt is judged by
the true one.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exo_gravity.core.arm.interface import STANDARD_GRAVITY as G
from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.trunk_estimator import TUNING, ImuSample, TrunkEstimator
from exo_gravity.sim.script import Step
from exo_gravity.sim.trunk_motion import ImuConfig, SimulatedImu, TrunkState, motion_of

from ..support.imu_motion import (
    RECORDED,
    STILL_TIME,
    Motion,
    Trunk,
    angles,
    bow,
    bowing_and_walking,
    bowing_trunk,
    by_vqf,
    down,
    even,
    follow,
    recorded,
    sampled,
)
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


# Situations of an IMU: ordinary ones are followed, faults are named before a wrong tilt is published.

GYROSCOPE_SPAN = 0.002  # s over which it averages
SETTLED = 1.2  # s
WRONG = 5.0  # degrees
BOWED = STILL_TIME + 2.0  # s, when the bow of `BOW` is over
BOW = bow(0.6, 2.0)
WALKING = bowing_and_walking()
RANDOM = np.random.default_rng(5)


def worn(*steps: Step, rate: float = 100.0, seed: int = 0) -> Motion:
    """Return the samples of an IMU at `rate` Hz on the trunk of a person who stands still and then does `steps`."""
    imu, state, rows = SimulatedImu(ImuConfig(rate=rate, seed=seed)), TrunkState(), list[np.ndarray]()
    for step in (Step("hold", STILL_TIME), *steps, Step("hold", 5.0)):
        motion = motion_of(step, state.pitch, state.roll)
        for time in even(step.duration, rate):
            state = motion.at(time) if motion else TrunkState(state.pitch, state.roll)
            rows.append(np.array((*imu.sample(state), gravity_in_trunk(state.pitch, state.roll))))
    gyroscope, accelerometer, gravity = np.array(rows).transpose(1, 0, 2)
    times = np.arange(len(rows)) / rate
    return Motion(rate, times, gyroscope, accelerometer, gravity, times + 0.001)


def bows(angle: float, over: float, walk: float) -> tuple[Step, ...]:
    """Return a walk of `walk` s, and right after it a bow by `angle` rad in `over` s, and back."""
    back = Step("bow", over, (0.0,))
    return Step("walk", walk), Step("bow", over, (angle,)), Step("hold", 1.0), back


ACTIVE = (*bows(0.8, 1.0, 6.0), Step("sit", 1.5), Step("lean", 0.8, (0.4,)), Step("lean", 1.0, (0.0,)))


def swaying_trunk(times: np.ndarray) -> np.ndarray:
    """Return a trunk that sways by 14 degrees at 0.2 Hz."""
    sway, phase = math.radians(14.0), 0.4 * np.pi * times
    return np.stack((0.5 * sway * np.cos(phase), sway * np.sin(phase), 0.0 * times), axis=1)


# Drivers: when they take samples, how they stamp them, when these arrive.


@dataclass(frozen=True)
class Driver:
    """taken: s, when each sample was taken; stamps and arrivals: s, by the clock of this computer; (n,) each."""

    taken: np.ndarray
    stamps: np.ndarray
    arrivals: np.ndarray

    def read(self, trunk: Trunk) -> Motion:
        """Return the samples of an IMU on a trunk."""
        motion = sampled(trunk, self.taken, GYROSCOPE_SPAN)
        return replace(motion, times=self.stamps, arrivals=self.arrivals)


def arriving(taken: np.ndarray, arrivals: np.ndarray, is_stamped_then: bool = False) -> Driver:
    """Return a driver that knows when its samples were taken, or stamps them when they arrive, in their order."""
    steps = 5e-5 * np.arange(len(arrivals))  # s between two of a batch
    arrivals = np.maximum.accumulate(arrivals - steps) + steps
    return Driver(taken, arrivals if is_stamped_then else taken, arrivals)


def timer(taken: np.ndarray, period: float) -> np.ndarray:
    """Return the arrivals behind an adapter that passes on what it has every `period` s."""
    return np.ceil(taken / period + 0.37) * period


def paused(taken: np.ndarray, pause: float, every: float) -> np.ndarray:
    """Return the arrivals at a driver that pauses for `pause` s `every` so many s."""
    phase = (taken + 0.5 * every) % every
    return taken + np.where(phase < pause, pause - phase, 0.0)


def loop(work: Callable[[int], float], late: float = 0.0) -> np.ndarray:
    """Return when a loop of 10 ms and `work(k)` s takes its samples; 5 % of its sleeps last `late` s longer."""
    taken = np.cumsum([0.01 + work(k) + late * (RANDOM.random() < 0.05) for k in range(2000)])
    return taken[taken < 20.0]


TAKEN = even(20.0)
LATE = TAKEN + np.where(RANDOM.random(len(TAKEN)) < 0.1, 0.02, 0.001)
ODD = loop(lambda k: 0.0006, 0.005)
PROMPT = TAKEN + 0.001
RATES = (50.0, 84.0, 95.0, 120.0, 200.0)
MILLISECONDS = np.round(even(20.0, 112.0), 3)
LOST = TAKEN[RANDOM.random(len(TAKEN)) > 0.03]
DRIVERS = {
    "even stamps": arriving(TAKEN, PROMPT),
    "whole milliseconds": arriving(MILLISECONDS, MILLISECONDS + 0.001),
    "arrival, exponential 2 ms": arriving(TAKEN, TAKEN + RANDOM.exponential(0.002, len(TAKEN)), True),
    "arrival, 4 ms USB timer": arriving(TAKEN, timer(TAKEN, 0.004), True),
    "arrival, 16 ms timer of an FTDI adapter": arriving(TAKEN, timer(TAKEN, 0.016), True),
    "true stamps, 16 ms timer": arriving(TAKEN, timer(TAKEN, 0.016)),
    "true stamps, 30 ms pause each 10 s": arriving(TAKEN, paused(TAKEN, 0.03, 10.0)),
    "arrival, 30 ms pause each 10 s": arriving(TAKEN, paused(TAKEN, 0.03, 10.0), True),
    "150 ms pauses that delay only the arrival": arriving(TAKEN, paused(TAKEN, 0.15, 4.0)),
    "loop, work of 0.5 and 2 ms": arriving(*2 * [loop(lambda k: (0.0005, 0.002)[k % 2])]),
    "loop, work of 0 to 8 ms": arriving(*2 * [loop(lambda k: RANDOM.uniform(0.0, 0.008))]),
    "loop, 5 % longer, delayed": arriving(ODD, ODD + RANDOM.exponential(0.003, len(ODD))),
    "true stamps, 10 % late by 20 ms": arriving(TAKEN, LATE),
    "arrival, 10 % late by 20 ms": arriving(TAKEN, LATE, True),
    "3 % of the samples lost": arriving(LOST, LOST + 0.001),
    "a clock off by 500 ppm": Driver(TAKEN, TAKEN * 1.0005, PROMPT),
    "a clock that is 2 % slow": Driver(TAKEN, 0.98 * TAKEN, TAKEN),
    "a clock that is set by 20 ms": Driver(TAKEN, TAKEN + 0.02 * (TAKEN > 10.0), PROMPT),
    **{f"{rate:g} Hz": arriving(even(20.0, rate), even(20.0, rate) + 0.001) for rate in (*RATES, 500.0)},
    **{f"{rate:g} Hz, 16 ms timer": arriving(even(20.0, rate), timer(even(20.0, rate), 0.016), True) for rate in RATES},
}
POLLED = Driver(np.floor(even(20.0, 200.0) / 0.01) * 0.01, *2 * [even(20.0, 200.0)]).read(swaying_trunk)


# Orientations that a sensor reports.


def reporting(trunk: Trunk, rate: float = 100.0, late: float = 0.0) -> Motion:
    """Return the samples of an IMU that reports its true orientation, `late` s behind."""
    times = even(15.0, rate)
    reported = Rotation.from_euler("xyz", trunk(times - late)).as_quat()
    return replace(sampled(trunk, times, GYROSCOPE_SPAN, rate), orientation=reported)


def filtered(motion: Motion) -> Motion:
    """Return the samples with the orientation that a filter in the sensor makes of them."""
    return replace(motion, orientation=by_vqf(motion))


def filled_in(motion: Motion) -> Motion:
    """Return the samples with an orientation that never turns."""
    return replace(motion, orientation=np.tile((0.0, 0.0, 0.0, 1.0), (len(motion.times), 1)))


def without_gyroscope(motion: Motion) -> Motion:
    return replace(motion, gyroscope=np.zeros_like(motion.gyroscope))


def turned(motion: Motion, rotation: Rotation) -> Motion:
    """Return the samples of an IMU that is mounted otherwise."""
    return values(rotation.apply, rotation.apply, gravity=rotation.apply)(motion)


# Faults: functions of a motion, and of the sample from which they last.

Fault = Callable[..., Motion]
Change = Callable[[np.ndarray], np.ndarray]


def values(gyroscope: Change | None = None, accelerometer: Change | None = None, **others: Change) -> Fault:
    """Return the fault that changes values of sensors: functions of (n, 3)."""
    changes = {"gyroscope": gyroscope, "accelerometer": accelerometer, **others}

    def apply(motion: Motion, first: int = 0) -> Motion:
        arrays = {name: getattr(motion, name) for name, change in changes.items() if change}
        parts = {name: (array[:first], changes[name](array[first:])) for name, array in arrays.items()}
        return replace(motion, **{name: np.concatenate(both) for name, both in parts.items()})

    return apply


def frozen(array: np.ndarray) -> np.ndarray:
    return np.tile(array[0], (len(array), 1))


def stuck(axis: int) -> Change:
    """Return the function that holds one axis at its first value."""
    return lambda array: np.where(np.arange(3) == axis, array[0], array)


def twice(array: np.ndarray) -> np.ndarray:
    """Return the values of a sensor that is read twice as often as it measures, with the same noise."""
    return array[np.arange(len(array)) // 2 * 2]


def clock(share: float) -> Fault:
    """Return the fault of stamps that advance by `share` of the time."""

    def apply(motion: Motion, first: int = 0) -> Motion:
        begin = motion.times[first]
        times = np.where(motion.times > begin, begin + share * (motion.times - begin), motion.times)
        return replace(motion, times=times, arrivals=motion.times)

    return apply


def second_publisher(motion: Motion, first: int = 0) -> Motion:
    """Between each two samples, put one of another IMU, mounted with its x axis upwards."""
    count = len(motion.times) - first
    both = motion.at(np.concatenate((np.arange(first), first + np.repeat(np.arange(count), 2))))
    is_second = np.concatenate((np.zeros(first, bool), np.tile((False, True), count)))
    other = turned(both, Rotation.from_euler("y", 90, degrees=True))
    mixed = {name: np.where(is_second[:, None], getattr(other, name), getattr(both, name))
             for name in ("gyroscope", "accelerometer")}  # fmt: skip
    return replace(both, times=both.times + 0.4 / motion.rate * is_second, **mixed)


# Situations that are ordinary.


@dataclass(frozen=True)
class Ordinary:
    """The samples of an IMU that works.

    largest: degrees that a tilt may be off. longest: s for which none may be there, from `settled` s on.
    """

    motion: Motion | Callable[[], Motion]
    largest: float
    longest: float = 0.1
    settled: float = SETTLED


def driven(driver: Driver, trunk: Trunk) -> Ordinary:
    """Half a degree are the accelerometer's bias; a stamp at arrival adds the turn since the sample."""
    largest = 1.25 + math.degrees(0.7 * np.abs(driver.stamps - driver.taken).max())
    pause = np.diff(driver.arrivals).max()
    return Ordinary(lambda: driver.read(trunk), min(largest, 4.0), max(0.1, pause + 0.01))


def fast_sway(times: np.ndarray) -> np.ndarray:
    return 4.0 * swaying_trunk(times)


FTDI = DRIVERS["arrival, 16 ms timer of an FTDI adapter"]
REPORTED_LATE = [
    (trunk, late) for trunk in (BOW, lambda times: 2.0 * BOW(3.0 * times - 6.0), bowing_trunk) for late in (0.0, 0.03)
]
MOUNTED = Rotation.from_euler("xyz", (1.0, -2.0, 0.5))
SWAYING = {f"{name}, sways": driven(driver, swaying_trunk) for name, driver in DRIVERS.items()}
ORDINARY = {
    **SWAYING,
    **{f"{name}, bows": driven(DRIVERS[name], bowing_trunk) for name in list(DRIVERS)[::8]},
    "a sensor polled twice as often as it measures": Ordinary(values(twice, twice)(POLLED), 1.5),
    **{f"bows by {angle} rad after a walk of {walk} s": Ordinary(
        lambda angle=angle, over=over, walk=walk, rate=rate: worn(*bows(angle, over, walk), rate=rate), 2.5, 0.3)
       for angle, over, rate in ((0.3, 0.6, 100.0), (0.5, 0.8, 200.0), (1.0, 1.5, 100.0))
       for walk in (5.0, 10.0, 10.3)},
    **{f"walks, bows, sits down and leans, at {rate} Hz": Ordinary(
        lambda rate=rate: worn(*ACTIVE, rate=rate, seed=1), 2.5, 0.3) for rate in (100.0, 200.0)},
    **{f"reported, trunk {k // 2}, {late} s late": Ordinary(reporting(trunk, late=late), 7.0, 0.011)
       for k, (trunk, late) in enumerate(REPORTED_LATE)},
    **{f"reported by a filter, at {rate} Hz": Ordinary(
        lambda rate=rate: filtered(worn(*ACTIVE, rate=rate, seed=2)), 2.5, 0.011) for rate in (100.0, 200.0)},
    "reported by a filter, mounted anyhow, no gyroscope": Ordinary(
        lambda: without_gyroscope(filtered(turned(worn(*ACTIVE, seed=4), MOUNTED))), 2.5, 0.011),
    "reported, a gyroscope with a dead band": Ordinary(
        values(lambda w: np.where(np.abs(w) < 0.01, 0.0, w))(reporting(BOW)), 0.1, 0.011),
    "reported, a gyroscope with a bias": Ordinary(
        values(lambda w: w + np.array((0.05, -0.05, 0.02)))(reporting(BOW)), 0.1, 0.011),
    "reported in batches": Ordinary(replace(
        FTDI.read(fast_sway), orientation=Rotation.from_euler("xyz", fast_sway(FTDI.taken)).as_quat()), 0.1, 0.1),
    "20 Hz, reported": Ordinary(replace(reporting(bowing_trunk, 20.0), rate=100.0), 4.5, 0.3, 3.0),
    "20 Hz": Ordinary(replace(reporting(bowing_trunk, 20.0), rate=100.0, orientation=None), 4.5, 0.3, 3.0),
}  # fmt: skip
QUICK = [*list(SWAYING)[::5], *(name for name in ORDINARY if name not in SWAYING)]


@pytest.mark.parametrize("name", quick(QUICK, ORDINARY))
def test_no_sample_of_an_imu_that_works_is_refused_and_the_tilt_is_always_there_and_right(name: str) -> None:
    case = ORDINARY[name]
    motion = case.motion() if callable(case.motion) else case.motion
    outcome = follow(motion)
    assert not any(outcome.refusals)
    arrived = motion.times if motion.arrivals is None else motion.arrivals
    published = arrived[np.isfinite(outcome.errors) & (arrived > case.settled)]
    longest = np.diff(np.concatenate(([case.settled], published, arrived[-1:]))).max()
    assert longest < case.longest
    assert np.nanmax(outcome.errors) < case.largest


# Situations that are not.


def standing(times: np.ndarray) -> np.ndarray:
    """Return a trunk that sways by a degree."""
    return np.radians(np.stack((np.sin(1.9 * times), 0.7 * np.sin(1.3 * times + 1.0), 2.0 * np.sin(0.4 * times)), 1))


@dataclass(frozen=True)
class Faulty:
    """The samples of an IMU with a fault, and what must be said about it.

    named: an expression that a refusal matches. within: s of the times of the first such refusal.
    wrong: s for which a tilt may be off by more than 5 degrees until the fault is distinguished from motion.
    silent: s from which no tilt may be published any more. largest: degrees that a tilt may be off.
    """

    motion: Motion | Callable[[], Motion]
    named: str
    within: tuple[float, float] = (0.0, math.inf)
    wrong: float = 0.0
    silent: float = math.inf
    largest: float = math.inf


BROKEN = {
    "frozen bytes": (values(frozen, frozen), "the IMU or its driver is frozen"),
    "NaN": (values(lambda w: np.where(np.arange(3) == 1, math.nan, w)), "angular_velocity .* 3 finite numbers"),
    "a gyroscope in deg/s": (values(np.degrees), "check the gyroscope's unit|is its unit right"),
    "an accelerometer in g": (values(None, lambda a: a / G), "in m/s.2, not in g|check units, axes and signs"),
    "a clock at half the speed": (clock(0.5), "by a clock as fast as this computer's"),
    "a second publisher": (second_publisher, "check units, axes and signs"),
    **{f"gyroscope {axis} stuck": (values(stuck(k)), f"the {axis} axis is stuck") for k, axis in enumerate("xyz")},
    **{f"accelerometer {axis} stuck": (values(None, stuck(k)), f"the {axis} axis is stuck")
       for k, axis in enumerate("xyz")},
}  # fmt: skip
# The accelerometer alone shows these, and while the trunk moves it also measures the movement: s of a wrong tilt.
SHOWN_BY_MOTION = {
    "reversed": (np.negative, 0.05),
    "x reversed": (lambda w: w * (-1, 1, 1), 0.1),
    "y reversed": (lambda w: w * (1, -1, 1), 0.05),
    "x and y swapped": (lambda w: w[:, [1, 0, 2]], 1.0),
    "y and z swapped": (lambda w: w[:, [0, 2, 1]], 2.0),
    "x and z swapped": (lambda w: w[:, [2, 1, 0]], 2.2),
    "of half the scale": (lambda w: 0.5 * w, 0.7),
    "of twice the scale": (lambda w: 2.0 * w, 0.8),
}
UNITS = {
    "acceleration in g": (values(None, lambda a: a / G), r"it must be in m/s\^2, not in g"),
    "acceleration without gravity": (
        values(None, lambda a: a - np.mean(a[:100], axis=0)), r"it must contain gravity, \+9.8 upward at rest"),
    "z down and y to the right": (
        values(lambda w: w * (1, -1, -1), lambda a: a * (1, -1, -1), orientation=lambda q: q * (1, -1, -1, 1)),
        r"it must point upward at rest \(REP-145\)"),
    "rates in deg/s": (values(np.degrees), "check unit, axes and signs of the gyroscope"),
}  # fmt: skip
CLOCK = "by a clock as fast as this computer's"
OTHERWISE = "check unit, axes and signs of the gyroscope"
SLOW = r"must be 20 or more; they come at 10 Hz: set a higher rate"
AMID = {f"{name}, from {start} s on": Faulty(fault(WALKING, round(100 * start)), named)
        for name, (fault, named) in BROKEN.items() for start in (0, 6)}  # fmt: skip
# Withheld before the tilt is wrong; the trunk may just not turn when it begins.
SLOW_MOTION = {f"a gyroscope that turns to degrees in slow motion {k} from {0.01 * start} s on": Faulty(
    values(np.degrees)(sampled(trunk, even(8.0)), start), "check the gyroscope's unit",
    (0.01 * start, 0.01 * start + 0.6), 0.1, 0.01 * start + 0.25, 6.0)
    for k, trunk in enumerate((standing, bow(0.6, 8.0))) for start in (260, 310, 430, 560, 690)}  # fmt: skip
FAULTS = {
    **AMID,
    **SLOW_MOTION,
    **{f"gyroscope {name}": Faulty(values(change)(WALKING), "axes and signs", (0.0, STILL_TIME + 4.0), wrong)
       for name, (change, wrong) in SHOWN_BY_MOTION.items()},
    **{f"{name}, {what}, trunk {number}": Faulty(fault(others(reporting(trunk))), named, silent=0.0)
       for name, (fault, named) in UNITS.items() for what, others in (("reported", replace), ("filled in", filled_in))
       for number, trunk in enumerate((BOW, bowing_trunk))},
    **{f"reported, turned by {turn} degrees": Faulty(
        replace(WALKING, orientation=(Rotation.from_euler("xyz", bowing_trunk(WALKING.times))
                                      * Rotation.from_euler("y", turn, degrees=True)).as_quat()), ".", silent=0.0)
       for turn in (30, 90, 180)},
    **{f"reported, never turns in a bow of {angle} rad": Faulty(
        filled_in(reporting(bow(angle, 2.0))), r"orientation_covariance\[0\] must be -1", silent=BOWED, largest=3.0)
       for angle in (0.1, 0.3, 0.6)},
    "reported, never turns, no gyroscope": Faulty(
        without_gyroscope(filled_in(reporting(bow(0.3, 2.0)))),
        "different after gravity has turned by linear_acceleration", silent=BOWED, wrong=1.0, largest=6.0),
    "reported, gyroscope reversed": Faulty(
        values(lambda w: w * (1, -1, 1))(reporting(BOW)), OTHERWISE, (STILL_TIME, BOWED), silent=BOWED),
    "reported, gyroscope of half the scale": Faulty(
        values(lambda w: 0.5 * w)(reporting(BOW)), OTHERWISE, (STILL_TIME, BOWED), silent=BOWED),
    "10 Hz, reported": Faulty(replace(reporting(bowing_trunk, 10.0), rate=100.0), SLOW, silent=0.0),
    "10 Hz": Faulty(replace(reporting(bowing_trunk, 10.0), rate=100.0, orientation=None), SLOW, silent=0.0),
    "a clock that becomes 10 % slow": Faulty(clock(0.9)(WALKING, 600), CLOCK, (6.0, 7.0), largest=1.5),
    "a clock that becomes 10 % fast": Faulty(clock(1.1)(WALKING, 600), CLOCK, (6.0, 7.1), largest=3.0),
    "a driver that lags more and more": Faulty(
        arriving(TAKEN, TAKEN + 0.2 * np.clip(TAKEN - 10.0, 0.0, None)).read(swaying_trunk), CLOCK, (10.0, 11.0)),
    # In strong motion, of recorded IMUs: freezing is only known after a while.
    **{f"frozen amid {path.stem} at {start} s": Faulty(
        lambda path=path, start=start: values(frozen, frozen)(recorded(path)[0], int(start * recorded(path)[0].rate)),
        "frozen") for path, start in zip([RECORDED[n] for n in (0, 1, 3, 4)], (11.77, 6.0, 13.99, 8.44), strict=True)},
}  # fmt: skip


SOME = [*list(AMID)[::3], *list(SLOW_MOTION)[::4], *list(FAULTS)[len(AMID) + len(SLOW_MOTION) :]]


@pytest.mark.parametrize("name", quick(SOME, FAULTS))
def test_a_fault_is_named_and_no_wrong_tilt_is_published(name: str) -> None:
    case = FAULTS[name]
    motion = case.motion() if callable(case.motion) else case.motion
    outcome = follow(motion)
    named = [motion.times[k] for k, text in enumerate(outcome.refusals) if re.search(case.named, text)]
    assert named and case.within[0] <= named[0] <= case.within[1]
    assert np.sum(outcome.errors > WRONG) / motion.rate <= case.wrong
    assert np.nanmax([0.0, *outcome.errors]) < case.largest
    assert np.isnan(outcome.errors[motion.times > case.silent]).all()
    if name.startswith("gyroscope") and case.wrong:
        assert np.isfinite(outcome.errors[motion.times > STILL_TIME]).mean() < 0.35


# Single samples that are wrong, and knocks beyond the range.


def test_a_knock_between_lost_samples_is_no_wrong_gyroscope() -> None:
    motion = sampled(bow(1.2, 1.5), even(8.0))
    for knock in range(370, 430, 5):
        force = motion.accelerometer.copy()
        force[knock] *= -0.9
        kept = np.delete(np.arange(len(force)), [knock - 1, knock + 1])  # one judgement has this sample alone
        outcome = follow(replace(motion, accelerometer=force).at(kept))
        assert not any(outcome.refusals) and np.nanmax(outcome.errors) < 2.5


def test_a_saturation_is_withheld_until_the_tilt_is_known_again_and_then_without_a_jump() -> None:
    gyroscope, times = WALKING.gyroscope.copy(), WALKING.times
    gyroscope[(times >= 5.0) & (times < 5.05), 2] = math.radians(2000.0)
    outcome = follow(replace(WALKING, gyroscope=gyroscope))
    missing = np.isnan(outcome.errors) & (times > 1.1)
    assert times[missing].min() < 5.03 and 0.9 < np.sum(missing) / WALKING.rate < 3.0
    back = np.flatnonzero(np.isfinite(outcome.errors) & (times > 5.05))
    assert outcome.errors[back[0]] < 3.0 and np.abs(np.diff(outcome.errors[back])).max() < 0.5
    assert np.nanmax(outcome.errors) < WRONG


@pytest.mark.parametrize("size", [10.0, 30.0])
def test_a_single_wrong_rate_is_withheld_as_the_turn_that_it_may_hide(size: float) -> None:
    for wrong in (400, 700, 1000):
        gyroscope = WALKING.gyroscope.copy()
        gyroscope[wrong, 1] += size
        outcome = follow(replace(WALKING, gyroscope=gyroscope))
        assert np.isnan(outcome.errors[wrong]) and np.nanmax(outcome.errors) < 1.5
