"""Recorded or simulated motion of an IMU, and the faults of IMUs, drivers and clocks put into it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from bench.imu_trials import angles
from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware import ImuSample, TrunkEstimator

G = 9.80665
STILL_TIME = 3.0  # s at the start of each motion


@dataclass(frozen=True)
class Motion:
    """Samples of an IMU in its own axes, (n, 3), and gravity's true direction there, (n, 3); times (n,) s."""

    rate: float
    times: np.ndarray
    gyroscope: np.ndarray
    accelerometer: np.ndarray
    gravity: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """errors: (n,) degrees of the published tilts, NaN where none was. refusals: (n,) messages, '' for none."""

    errors: np.ndarray
    refusals: list[str]


def bowing_and_walking(duration: float = 15.0, rate: float = 100.0) -> Motion:
    """Return a trunk that stands still, bows by 40 degrees, leans by 25 and sways, while it walks from 8 s on."""
    times = np.arange(round(duration * rate)) / rate
    moving = np.clip(times - STILL_TIME, 0.0, None)
    roll = 0.22 * (1.0 - np.cos(1.9 * moving)) + 0.02 * np.sin(7.0 * moving)
    pitch = 0.35 * (1.0 - np.cos(1.4 * moving)) + 0.02 * np.sin(5.0 * moving)
    yaw = 0.3 * np.sin(0.9 * moving)
    world_from_imu = Rotation.from_euler("xyz", np.stack((roll, pitch, yaw), axis=1))
    turns = (world_from_imu[:-1].inv() * world_from_imu[1:]).as_rotvec() * rate
    walks = np.clip((times - 8.0) / 0.5, 0.0, 1.0)[:, None]
    steps = np.stack((0.8 * np.sin(12.6 * times), 1.0 * np.sin(6.3 * times), 2.5 * np.sin(12.6 * times + 1.0)), axis=1)
    random = np.random.default_rng(7)
    gyroscope = np.vstack((turns[:1], turns)) + 0.005 + random.normal(0.0, 0.002, (len(times), 3))
    force = world_from_imu.inv().apply(np.array((0.0, 0.0, G)) + walks * steps)
    accelerometer = force + 0.05 + random.normal(0.0, 0.03, (len(times), 3))
    return Motion(rate, times, gyroscope, accelerometer, world_from_imu.inv().apply((0.0, 0.0, -1.0)))


def follow(motion: Motion) -> Outcome:
    """Feed the samples to an estimator."""
    estimator = TrunkEstimator((0.0, 0.0, 0.0, 1.0), motion.rate)
    answers, refusals = np.full(motion.gravity.shape, np.nan), []
    columns = (motion.times.tolist(), motion.gyroscope.tolist(), motion.accelerometer.tolist())
    for k, sample in enumerate(zip(*columns, strict=True)):
        refusals.append("")
        try:
            answer = estimator.update(ImuSample(*sample))
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
        return replace(motion, times=times)

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
