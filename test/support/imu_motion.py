# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How trunks with an IMU move, recorded (BROAD, see data/broad) or simulated; and what the estimator makes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from vqf import VQF

from exo_gravity.core.arm.interface import STANDARD_GRAVITY as G
from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator

STILL_TIME = 3.0  # s at the start of each simulated motion
RECORDED = sorted((Path(__file__).parents[1] / "data" / "broad").glob("*.npz"))
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

    def at(self, samples: np.ndarray | slice) -> Motion:
        """Return some of the samples, or some of them more than once."""
        values = vars(self).items()
        arrays: dict[str, Any] = {name: value[samples] for name, value in values if isinstance(value, np.ndarray)}
        return replace(self, **arrays)


@dataclass(frozen=True)
class Outcome:
    """What an estimator makes of the samples of a motion."""

    #: (n, 3), gravity's direction as published, NaN where none was
    gravity: np.ndarray
    #: (n,) degrees of the published tilts, NaN where none was
    errors: np.ndarray
    #: (n,) messages, '' for none
    refusals: list[str]


def follow(motion: Motion) -> Outcome:
    """Feed the samples to an estimator."""
    estimator = TrunkEstimator((0.0, 0.0, 0.0, 1.0), motion.rate)
    answers, refusals = np.full(motion.gravity.shape, np.nan), [""] * len(motion.times)
    nothing = [None] * len(motion.times)
    columns = (motion.times, motion.gyroscope, motion.accelerometer, motion.orientation, motion.arrivals)
    rows = zip(*(nothing if column is None else column.tolist() for column in columns), strict=True)
    for k, (*sample, arrival) in enumerate(rows):
        try:
            answer = estimator.update(ImuSample(*sample), arrival)
        except ParameterError as error:
            refusals[k] = str(error)
            continue
        if answer is not None:
            answers[k] = answer.gravity
    return Outcome(answers, angles(answers, motion.gravity), refusals)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return how far unit vectors (n, 3) are apart, (n,) in degrees."""
    return np.degrees(2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def by_vqf(motion: Motion) -> np.ndarray:
    """Return the orientation (n, 4), x, y, z, w, that VQF alone makes of evenly spaced samples."""
    values = (np.ascontiguousarray(array) for array in (motion.gyroscope, motion.accelerometer))
    return np.roll(VQF(1.0 / motion.rate).updateBatch(*values)["quat6D"], -1, axis=1)


def down(orientation: np.ndarray) -> np.ndarray:
    """Return gravity's direction (n, 3) in the axes of an IMU with an `orientation` (n, 4)."""
    return Rotation.from_quat(orientation).inv().apply((0.0, 0.0, -1.0))


def recorded(path: Path) -> tuple[Motion, np.ndarray]:
    """Return a trial of BROAD, and (n,) whether a sample is in motion and has an optical reference."""
    with np.load(path) as file:
        rate, gyroscope, accelerometer = float(file["rate"]), file["gyr"].astype(float), file["acc"].astype(float)
        reference, counts = file["quat_wxyz"].astype(float), file["movement"].astype(bool)
    counts &= np.isfinite(reference[:, 0])
    gravity = down(np.roll(np.where(np.isfinite(reference), reference, 1.0), -1, axis=1))
    return Motion(rate, np.arange(len(gyroscope)) / rate, gyroscope, accelerometer, gravity), counts


def eased(share: np.ndarray) -> np.ndarray:
    """Return the way (n,) from 0 to 1 with minimum jerk."""
    s = np.clip(share, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def bowing_trunk(times: np.ndarray) -> np.ndarray:
    """Return a trunk that stands still, bows by 40 degrees, leans by 25 and sways."""
    moving = np.clip(times - STILL_TIME, 0.0, None)
    roll = 0.22 * (1.0 - np.cos(1.9 * moving)) + 0.02 * np.sin(7.0 * moving)
    pitch = 0.35 * (1.0 - np.cos(1.4 * moving)) + 0.02 * np.sin(5.0 * moving)
    return np.stack((roll, pitch, 0.3 * np.sin(0.9 * moving)), axis=1)


def bow(angle: float, duration: float) -> Trunk:
    """Return a trunk that bows by `angle` rad after it stood still, in `duration` s, and stays so."""
    return lambda times: np.outer(eased((times - STILL_TIME) / duration), (0.0, angle, 0.0))


def sampled(trunk: Trunk, times: np.ndarray, span: float | np.ndarray = 0.01, rate: float = 100.0) -> Motion:
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


def even(duration: float = 15.0, rate: float = 100.0) -> np.ndarray:
    """Return the times (n,) s of a sensor with its own clock."""
    return np.arange(round(duration * rate)) / rate


def bowing_and_walking(duration: float = 15.0) -> Motion:
    """Return the samples of an IMU on the bowing trunk, which walks from 8 s on."""
    return sampled(bowing_trunk, even(duration))
