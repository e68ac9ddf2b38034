# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.imu_report [FOLDER]: the trunk's inclination error here, by VQF and by imufusion.

Writes one table as Markdown: for each recorded trial with an optical reference (BROAD; see test/data/broad) the error
in degrees, RMS (largest), over the samples in motion. FOLDER holds trials as .npz files.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from vqf import VQF

from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator

EXCERPTS = Path(__file__).parent.parent / "test" / "data" / "broad"
G = 9.80665
LOST = 0.03  # share of samples
Step = Callable[[float, np.ndarray, np.ndarray], np.ndarray]  # s, rad/s and m/s^2 (3,) -> gravity (3,), or (w, x, y, z)


class Trial(NamedTuple):
    """One trial. rate Hz; angular_velocity rad/s, acceleration m/s^2, true gravity: (n, 3) in the sensor's axes.

    times: (n,) s. counts: (n,), the samples in motion with a reference.
    """

    name: str
    rate: float
    times: np.ndarray
    angular_velocity: np.ndarray
    acceleration: np.ndarray
    gravity: np.ndarray
    counts: np.ndarray


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
        counts &= np.isfinite(gravity[:, 0])
        yield Trial(path.stem, rate, np.arange(len(gyr)) / rate, gyr, acc, gravity, counts)


def gravity_of(quaternion: np.ndarray) -> np.ndarray:
    """Return gravity's unit vector (..., 3) in the sensor's axes for (w, x, y, z), world from sensor, (..., 4)."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return -np.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), axis=-1)


def here(rate: float) -> Step:
    """Return the estimator of this package; its gravity is NaN where it publishes none."""
    estimator, nothing = TrunkEstimator((0.0, 0.0, 0.0, 1.0), rate), np.full(3, np.nan)

    def step(now: float, turning: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        with suppress(ParameterError):
            if answer := estimator.update(ImuSample(now, turning.tolist(), acceleration.tolist())):
                return answer.gravity
        return nothing

    return step


def by_vqf(rate: float) -> Step:
    """Return VQF with its defaults, one sample at a time as on line."""
    vqf = VQF(1.0 / rate)

    def step(_: float, turning: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        vqf.update(turning, acceleration)
        return vqf.getQuat6D()

    return step


def by_imufusion(rate: float) -> Step:
    """Return imufusion with its defaults."""
    import imufusion

    ahrs, bias = imufusion.Ahrs(), imufusion.Bias()
    ahrs.set_settings(imufusion.AhrsSettings(sample_rate=rate, convention=imufusion.CONVENTION_NWU))
    bias.set_settings(imufusion.BiasSettings(sample_rate=rate))
    ahrs.set_sample_period(1.0 / rate)

    def step(_: float, turning: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        ahrs.update_no_magnetometer(bias.update(np.degrees(turning)), acceleration / G)
        return -ahrs.get_gravity().astype(float)

    return step


METHODS = {"here": here, "VQF, its defaults": by_vqf}
if find_spec("imufusion"):
    METHODS["imufusion, its defaults"] = by_imufusion


def score(trial: Trial, method: Callable[[float], Step], kept: np.ndarray | slice = slice(None)) -> tuple[str, ...]:
    """Return the error of the published tilts of the samples `kept`, the share published, and us a sample."""
    step, gravity, counts = method(trial.rate), trial.gravity[kept], trial.counts[kept]
    begin = time.process_time()
    answers = [step(*row) for row in zip(*(column[kept] for column in trial[2:5]), strict=True)]
    cost = (time.process_time() - begin) / len(answers) * 1e6
    found = gravity_of(np.array(answers)) if len(answers[0]) == 4 else np.array(answers)
    published = counts & np.isfinite(found[:, 0])
    apart, along = (np.linalg.norm(found + sign * gravity, axis=1)[published] for sign in (-1.0, 1.0))
    errors = np.degrees(2.0 * np.arctan2(apart, along))
    shown = f"{np.sqrt(np.mean(errors**2)):.2f} ({errors.max():.1f})" if len(errors) else "none"
    return shown, f"{np.sum(published) / np.sum(counts):.1%}", f"{cost:.0f}"


def report(trials: list[Trial]) -> str:
    """Return the table; its last row has the us of processor time a sample."""
    head = ["trial", "here", "published", f"here, {LOST:.0%} of the samples lost", *list(METHODS)[1:]]
    rows = [head, ["---"] * len(head)]
    for trial in trials:
        (own, published, cost), *others = (score(trial, method) for method in METHODS.values())
        kept = np.random.default_rng(0).random(len(trial.times)) >= LOST
        lossy, lossy_published, _ = score(trial, here, kept)
        lossy = f"{lossy}, {lossy_published} published"
        rows.append([trial.name.replace("_", " "), own, published, lossy, *(shown for shown, *_ in others)])
        costs = ["us of processor time a sample", cost, "", "", *(taken for *_, taken in others)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (*rows, costs))


def main() -> None:
    """Print the table; exit code 2 for wrong files."""
    parser = argparse.ArgumentParser(prog="bench.imu_report", description="Compare the trunk estimator with its peers.")
    parser.add_argument("folder", nargs="?", type=Path, default=EXCERPTS, help="folder of trials (%(default)s)")
    try:
        print(report(list(read_trials(parser.parse_args().folder))))
    except DataError as error:
        sys.stderr.write(f"{error}\n")
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
