# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The trunk estimator and its peers on recorded trials with an optical reference (BROAD; see test/data/broad)."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from vqf import VQF

from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator

EXCERPTS = Path(__file__).parent.parent / "test" / "data" / "broad"
ALIGNED = (0.0, 0.0, 0.0, 1.0)
G = 9.80665
Answers = tuple[np.ndarray, float]  # gravity (n, 3), and the processor time in s


@dataclass(frozen=True)
class Trial:
    """One trial. rate Hz; angular_velocity rad/s, acceleration m/s^2, true gravity: (n, 3) in the sensor's axes.

    counts: (n,), the samples in motion with a reference. times: (n,) s.
    """

    name: str
    rate: float
    times: np.ndarray
    angular_velocity: np.ndarray
    acceleration: np.ndarray
    gravity: np.ndarray
    counts: np.ndarray

    def without(self, lost: np.ndarray) -> Trial:
        """Return the trial without the samples where `lost` (n,) is true."""
        arrays = (self.times, self.angular_velocity, self.acceleration, self.gravity, self.counts)
        return Trial(self.name, self.rate, *(np.ascontiguousarray(array[~lost]) for array in arrays))


@dataclass(frozen=True)
class Score:
    """Errors of a published tilt in degrees, the share of samples for which one was published, us a sample."""

    rms: float
    largest: float
    published: float
    cost: float


def read_trials(folder: Path = EXCERPTS) -> Iterator[Trial]:
    """Read every .npz file of `folder`. Raises DataError."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise DataError(f"{folder}: no .npz files of trials")
    for path in paths:
        try:
            with np.load(path) as file:
                rate, gyr, acc = float(file["rate"]), file["gyr"].astype(float), file["acc"].astype(float)
                gravity, counts = gravity_of(file["quat_wxyz"].astype(float)), file["movement"].astype(bool)
        except (OSError, KeyError, ValueError) as error:
            raise DataError(f"{path}: not a trial ({error})") from None
        times = np.arange(len(gyr)) / rate
        yield Trial(path.stem, rate, times, gyr, acc, gravity, counts & np.isfinite(gravity[:, 0]))


def gravity_of(quaternion: np.ndarray) -> np.ndarray:
    """Return gravity's unit vector (n, 3) in the sensor's axes for (w, x, y, z), world from sensor, (n, 4)."""
    w, x, y, z = quaternion.T
    return -np.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), axis=1)


def by_estimator(trial: Trial) -> Answers:
    """Return the estimator's gravity (n, 3), NaN where nothing is published."""
    estimator = TrunkEstimator(ALIGNED, trial.rate)
    columns = (trial.times.tolist(), trial.angular_velocity.tolist(), trial.acceleration.tolist())
    samples = [ImuSample(*row) for row in zip(*columns, strict=True)]
    answers = []
    start = time.process_time()
    for sample in samples:
        try:
            answers.append(estimator.update(sample))
        except ParameterError:
            answers.append(None)
    seconds = time.process_time() - start
    nothing = np.full(3, np.nan)
    return np.array([nothing if answer is None else answer.gravity for answer in answers]), seconds


def by_vqf(trial: Trial) -> Answers:
    """Return the gravity (n, 3) of VQF with its defaults, one sample at a time as on line."""
    vqf, quaternions = VQF(1.0 / trial.rate), []
    start = time.process_time()
    for rate, acceleration in zip(trial.angular_velocity, trial.acceleration, strict=True):
        vqf.update(rate, acceleration)
        quaternions.append(vqf.getQuat6D())
    seconds = time.process_time() - start
    return gravity_of(np.array(quaternions)), seconds


def by_imufusion(trial: Trial) -> Answers:
    """Return the gravity (n, 3) of imufusion with its defaults."""
    import imufusion

    ahrs, answers = imufusion.Ahrs(), []
    ahrs.set_settings(imufusion.AhrsSettings(sample_rate=trial.rate, convention=imufusion.CONVENTION_NWU))
    bias = imufusion.Bias()
    bias.set_settings(imufusion.BiasSettings(sample_rate=trial.rate))
    ahrs.set_sample_period(1.0 / trial.rate)
    start = time.process_time()
    for rate, acceleration in zip(np.degrees(trial.angular_velocity), trial.acceleration / G, strict=True):
        ahrs.update_no_magnetometer(bias.update(rate), acceleration)
        answers.append(-ahrs.get_gravity().astype(float))
    return np.array(answers), time.process_time() - start


METHODS = {"here": by_estimator, "VQF, its defaults": by_vqf, "imufusion, its defaults": by_imufusion}


def score(trial: Trial, method: str) -> Score:
    """Run a method of METHODS on a trial."""
    answers, seconds = METHODS[method](trial)
    cost = seconds / len(answers) * 1e6
    published = np.isfinite(answers[:, 0])
    counted = trial.counts & published
    errors = angles(answers[counted], trial.gravity[counted])
    if not len(errors):
        return Score(math.nan, math.nan, 0.0, cost)
    share = float(np.mean(published[trial.counts]))
    return Score(float(np.sqrt(np.mean(errors**2))), float(errors.max()), share, cost)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles (n,) in degrees between unit vectors (n, 3)."""
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1)))


def lost_samples(count: int, share: float) -> np.ndarray:
    """Return which of `count` samples are lost, (count,): a random `share`, the same in every run."""
    return np.random.default_rng(0).random(count) < share
