# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Recorded or simulated motion of an IMU, and the faults of IMUs, drivers and clocks put into it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from bench.imu_trials import angles
from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator

G = 9.80665
STILL_TIME = 3.0  # s at the start of each motion


Trunk = Callable[[np.ndarray], np.ndarray]  # times (n,) s -> roll, pitch and yaw (n, 3) rad


@dataclass(frozen=True)
class Motion:
    """Samples of an IMU in its own axes."""

    #: nominal, Hz
    rate: float
    #: (n,) s, by their stamps
    times: np.ndarray
    #: (n, 3) rad/s
    gyroscope: np.ndarray
    #: (n, 3) m/s^2
    accelerometer: np.ndarray
    #: (n, 3), gravity's true direction
    gravity: np.ndarray
    #: (n,) s, None: not known
    arrivals: np.ndarray | None = None
    #: (n, 4), x, y, z, w, world from IMU, as the IMU reports it; None: it does not
    orientation: np.ndarray | None = None


@dataclass(frozen=True)
class Outcome:
    """What an estimator makes of the samples of a motion."""

    #: (n,) degrees of the published tilts, NaN where none was
    errors: np.ndarray
    #: (n,) messages, '' for none
    refusals: list[str]


def bowing_and_walking(duration: float = 15.0, rate: float = 100.0) -> Motion:
    """Return a trunk that stands still, bows by 40 degrees, leans by 25 and sways, while it walks from 8 s on."""
    times = np.arange(round(duration * rate)) / rate
    return sampled(bowing_trunk, times, 1.0 / rate, rate)


def bowing_trunk(times: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (n, 3) rad of the trunk of `bowing_and_walking`."""
    moving = np.clip(times - STILL_TIME, 0.0, None)
    roll = 0.22 * (1.0 - np.cos(1.9 * moving)) + 0.02 * np.sin(7.0 * moving)
    pitch = 0.35 * (1.0 - np.cos(1.4 * moving)) + 0.02 * np.sin(5.0 * moving)
    return np.stack((roll, pitch, 0.3 * np.sin(0.9 * moving)), axis=1)


def bow(angle: float, start: float, duration: float) -> Trunk:
    """Return a trunk that bows by `angle` rad from `start` s on, in `duration` s with minimum jerk, and stays so."""

    def trunk(times: np.ndarray) -> np.ndarray:
        s = np.clip((times - start) / duration, 0.0, 1.0)
        return np.outer(s**3 * (10.0 - 15.0 * s + 6.0 * s * s), (0.0, angle, 0.0))

    return trunk


def sampled(trunk: Trunk, times: np.ndarray, span: float | np.ndarray, rate: float) -> Motion:
    """Return the samples, taken at `times` s, of an IMU on a trunk that walks from 8 s on.

    span: s before each sample over which the gyroscope averages, one or (n,).
    """
    span = np.broadcast_to(span, times.shape)
    before, world_from_imu = (Rotation.from_euler("xyz", trunk(at)) for at in (times - span, times))
    turns = (before.inv() * world_from_imu).as_rotvec() / span[:, None]
    walks = np.clip((times - 8.0) / 0.5, 0.0, 1.0)[:, None]
    steps = np.stack((0.8 * np.sin(12.6 * times), 1.0 * np.sin(6.3 * times), 2.5 * np.sin(12.6 * times + 1.0)), axis=1)
    random = np.random.default_rng(7)
    gyroscope = turns + 0.005 + random.normal(0.0, 0.002, (len(times), 3))
    force = world_from_imu.inv().apply(np.array((0.0, 0.0, G)) + walks * steps)
    accelerometer = force + 0.05 + random.normal(0.0, 0.03, (len(times), 3))
    return Motion(rate, times, gyroscope, accelerometer, world_from_imu.inv().apply((0.0, 0.0, -1.0)))


def follow(motion: Motion) -> Outcome:
    """Feed the samples to an estimator."""
    estimator = TrunkEstimator((0.0, 0.0, 0.0, 1.0), motion.rate)
    answers, refusals = np.full(motion.gravity.shape, np.nan), []
    columns = [motion.times.tolist(), motion.gyroscope.tolist(), motion.accelerometer.tolist()]
    columns.append([None] * len(motion.times) if motion.orientation is None else motion.orientation.tolist())
    arrivals = [None] * len(motion.times) if motion.arrivals is None else motion.arrivals.tolist()
    for k, (arrival, *sample) in enumerate(zip(arrivals, *columns, strict=True)):
        refusals.append("")
        try:
            answer = estimator.update(ImuSample(*sample), arrival)
        except ParameterError as error:
            refusals[-1] = str(error)
            continue
        if answer is not None:
            answers[k] = answer.gravity
    return Outcome(angles(answers, motion.gravity), refusals)


Fault = Callable[[Motion, int], Motion]  # the motion, and the sample from which the fault lasts


def values(gyroscope: Callable | None = None, accelerometer: Callable | None = None) -> Fault:
    """Return the fault that changes the values of one sensor, or of both: functions of (n, 3)."""

    def apply(motion: Motion, first: int) -> Motion:
        changed = {}
        for name, change in (("gyroscope", gyroscope), ("accelerometer", accelerometer)):
            if change is not None:
                array = getattr(motion, name).copy()
                array[first:] = change(array[first:])
                changed[name] = array
        return replace(motion, **changed)

    return apply


def stuck(axis: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that holds one axis at its first value."""

    def hold(array: np.ndarray) -> np.ndarray:
        held = array.copy()
        held[:, axis] = held[0, axis]
        return held

    return hold


def slow_clock(share: float) -> Fault:
    """Return the fault of stamps that advance by `share` of the time."""

    def apply(motion: Motion, first: int) -> Motion:
        times = motion.times.copy()
        times[first:] = times[first] + share * (times[first:] - times[first])
        return replace(motion, times=times, arrivals=motion.times)

    return apply


def second_publisher(motion: Motion, first: int) -> Motion:
    """Between each two samples, put one of another IMU, mounted with its x axis upwards."""
    turned = Rotation.from_euler("y", 90, degrees=True)
    count = len(motion.times) - first
    order = np.concatenate((np.arange(first), np.repeat(np.arange(first, len(motion.times)), 2)))
    is_second = np.concatenate((np.zeros(first, bool), np.tile((False, True), count)))
    times = motion.times[order] + 0.4 / motion.rate * is_second
    gyroscope, accelerometer = motion.gyroscope[order].copy(), motion.accelerometer[order].copy()
    gyroscope[is_second], accelerometer[is_second] = (
        turned.apply(gyroscope[is_second]),
        turned.apply(accelerometer[is_second]),
    )
    return replace(motion, times=times, gyroscope=gyroscope, accelerometer=accelerometer, gravity=motion.gravity[order])


def lost(share: float) -> Fault:
    """Return the fault of a random share of lost samples."""

    def apply(motion: Motion, first: int) -> Motion:
        kept = np.random.default_rng(3).random(len(motion.times)) >= share
        kept[:first] = True
        names = ("times", "gyroscope", "accelerometer", "gravity")
        return replace(motion, **{name: getattr(motion, name)[kept] for name in names})

    return apply
