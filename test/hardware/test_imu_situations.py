# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Situations of an IMU: ordinary ones are followed, faults are named before a wrong tilt is published.

Ordinary drivers and computers, ordinary motion, orientations that a sensor reports; and faults of sensors, drivers and
clocks, from the start or amid the motion. Every published tilt is judged by the true one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exo_gravity.core.arm.interface import STANDARD_GRAVITY as G

from ..support.imu_motion import (
    RECORDED,
    STILL_TIME,
    Motion,
    Trunk,
    bow,
    bowing_and_walking,
    bowing_trunk,
    by_vqf,
    eased,
    even,
    follow,
    recorded,
    sampled,
)
from ..support.thorough import quick

FROM_HIPS = ((0.1, 0.0, 0.35), (-0.1, 0.05, 0.5), (0.0, 0.15, 0.5))  # m, of the IMU: on the breastbone, back, shoulder
GYROSCOPE_SPAN = 0.002  # s over which it averages
NEAR = 1e-3  # s between positions that give an acceleration
ROLL, PITCH, YAW, AHEAD, _, UP = np.eye(6)
STRIDE = 2.0 * np.pi * 0.95  # rad/s
# What swings: axis (roll, pitch, yaw; then the hips' acceleration ahead, left, up), amplitude in rad or m/s^2, rad/s,
# and phase in rad. Walking as in sim.trunk_motion.
SWINGS = {
    "walk": (
        (0, 0.035, STRIDE, 0.0),
        (1, 0.017, 2.0 * STRIDE, 0.0),
        (3, 0.14 * G, 2.0 * STRIDE, 0.0),
        (4, 0.14 * G, STRIDE, np.pi / 2),
        (5, 0.23 * G, 2.0 * STRIDE, np.pi / 2),
        (5, 0.06 * G, 4.0 * STRIDE, np.pi / 2),
    ),
    "clap": tuple((axis, size, 6.0 * np.pi, 0.0) for axis, size in ((1, 0.01), (3, 0.5), (4, 0.5), (5, 0.3))),
    "nod": ((1, 0.05, 3.0 * np.pi, 0.0), (3, 0.2, 3.0 * np.pi, 0.0)),
    "impact": ((5, 1.3 * G, 10.0 * np.pi, 0.0),),
}
SETTLED = 1.2  # s
WRONG = 5.0  # degrees
BOWED = STILL_TIME + 2.0  # s, when the bow of `BOW` is over
BOW = bow(0.6, 2.0)
WALKING = bowing_and_walking()
RANDOM = np.random.default_rng(5)


@dataclass(frozen=True)
class Part:
    """The trunk turns and shifts by `change` (6,): roll, pitch, yaw in rad, hips ahead, left, up in m; or it swings."""

    start: float
    duration: float
    change: np.ndarray | None = None
    swing: str = ""


def walk_and_bow(angle: float, over: float, walk: float) -> list[Part]:
    """Return a walk of `walk` s, and right after it a bow by `angle` rad in `over` s, and back."""
    begin = STILL_TIME + walk
    bows = Part(begin, over, angle * PITCH), Part(begin + over + 1.0, over, -angle * PITCH)
    return [Part(STILL_TIME, walk, swing="walk"), *bows]


def there_and_back(at: float, over: float, change: np.ndarray, hold: float) -> list[Part]:
    return [Part(at, over, change), Part(at + over + hold, over, -change)]


def swinging(swing: str, at: float, over: float, size: float) -> list[Part]:
    return [Part(at, 6.0 + 4.0 * size, swing=swing)]


# What people do from `at` s on, in `over` s; size: -1 to 1.
DOINGS: dict[str, Callable[[float, float, float], list[Part]]] = {
    "bow": lambda at, over, size: there_and_back(at, over, (0.7 + 0.5 * size) * PITCH, max(0.0, 3.0 * size)),
    "lean": lambda at, over, size: there_and_back(at, over, 0.4 * size * ROLL, max(0.0, -3.0 * size)),
    "turn": lambda at, over, size: [Part(at, max(over, 0.8), 3.0 * size * YAW)],
    "sit": lambda at, over, size: [Part(at, 0.8, 0.6 * PITCH - 0.3 * AHEAD), Part(at + 0.5, 0.6, -0.4 * UP),
                                   Part(at + 1.0, 0.1, swing="impact"), Part(at + 1.1, 0.8, -0.6 * PITCH)],
    "jump": lambda at, over, size: [Part(at, 0.6, 0.6 * PITCH), Part(at + 0.4, 0.6, 0.4 * UP + 0.3 * AHEAD),
                                    Part(at + 0.6, 0.6, -0.6 * PITCH)],
    **{swing: partial(swinging, swing) for swing in ("walk", "clap", "nod")},
}  # fmt: skip


def day(seed: int, duration: float) -> list[Part]:
    """Return motions in random order, some of them at the same time."""
    random, at = np.random.default_rng(seed), STILL_TIME
    parts: list[Part] = []
    while at < duration:
        more = DOINGS[random.choice((*DOINGS, "bow"))](at, random.uniform(0.6, 2.0), random.uniform(-1.0, 1.0))
        parts += more
        if not more[0].swing or random.random() < 0.7:  # or the next one at the same time
            at = max(part.start + part.duration for part in more) + random.choice((0.0, random.uniform(0.0, 2.0)))
    return parts


def worn(parts: list[Part], duration: float, rate: float = 100.0, seed: int = 0) -> Motion:
    """Return the samples of an IMU at `rate` Hz on the trunk of a person who does `parts`."""
    times, random = even(duration, rate), np.random.default_rng(seed)
    turned, places = {}, {}
    for shift in (-GYROSCOPE_SPAN, -NEAR, NEAR, 0.0):
        pose, push = _pose(parts, times + shift)
        turned[shift] = Rotation.from_euler("ZYX", pose[:, [2, 1, 0]])
        places[shift] = pose[:, 3:] + turned[shift].apply(FROM_HIPS[seed % len(FROM_HIPS)])
    moves, now = (places[-NEAR] - 2.0 * places[0.0] + places[NEAR]) / NEAR**2, turned[0.0]
    gyroscope = (turned[-GYROSCOPE_SPAN].inv() * now).as_rotvec() / GYROSCOPE_SPAN
    gyroscope += random.normal(0.0, 0.003, 3) + random.normal(0.0, 0.002, gyroscope.shape)
    force = now.inv().apply(moves + np.array((0.0, 0.0, G))) + push
    force += random.normal(0.0, 0.05, 3) + random.normal(0.0, 0.03, force.shape)
    return Motion(rate, times, gyroscope, force, now.inv().apply((0.0, 0.0, -1.0)), times + 0.001)


def _pose(parts: list[Part], times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose (n, 6) as in Part, and the acceleration (n, 3) of what swings, in the trunk's axes."""
    pose, swung = np.zeros((len(times), 6)), np.zeros((len(times), 6))
    for part in parts:
        since = times - part.start
        if part.change is not None:
            pose += np.outer(eased(since / part.duration), part.change)
            continue
        fade = eased(np.minimum(since, part.duration - since) / min(1.0, part.duration / 2.0))
        for axis, amplitude, speed, phase in SWINGS[part.swing]:
            swung[:, axis] += amplitude * fade * np.sin(speed * since + phase)
    pose[:, :3] += swung[:, :3]
    return pose, swung[:, 3:]


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


def random_day(seed: int, rate: float) -> Ordinary:
    """A tilt that is away is ridden through for 0.2 s at least, unless the trunk turns fast."""
    return Ordinary(lambda: worn(day(seed, 50.0), 60.0, rate, seed), 2.5, 0.3)


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
        lambda angle=angle, over=over, walk=walk, rate=rate, place=place:
            worn(walk_and_bow(angle, over, walk), walk + 2.0 * over + 6.0, rate, place), 2.5, 0.3)
       for angle, over, rate in ((0.3, 0.6, 100.0), (0.5, 0.8, 200.0), (1.0, 1.5, 100.0))
       for place, walk in enumerate((5.0, 10.0, 10.3))},
    "a day at 100 Hz": random_day(0, 100.0),
    "a day at 200 Hz": random_day(1, 200.0),
    **{f"reported, trunk {k // 2}, {late} s late": Ordinary(reporting(trunk, late=late), 7.0, 0.011)
       for k, (trunk, late) in enumerate(REPORTED_LATE)},
    "reported by a filter, a day": Ordinary(lambda: filtered(worn(day(2, 40.0), 50.0, 100.0, 2)), 2.5, 0.011),
    "reported by a filter, a day at 200 Hz": Ordinary(lambda: filtered(worn(day(3, 40.0), 50.0, 200.0, 3)), 2.5, 0.011),
    "reported by a filter, mounted anyhow, no gyroscope": Ordinary(
        lambda: without_gyroscope(filtered(turned(worn(day(4, 20.0), 30.0, 100.0, 4), MOUNTED))), 2.5, 0.011),
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
