# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.imu_report [FOLDER]: the trunk's inclination error here, by VQF and by imufusion.

Writes one table as Markdown: for each trial the error in degrees, RMS (largest), over the samples in motion. FOLDER
holds trials as .npz files; by default it is test/data/broad.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path

from exo_gravity.core.errors import DataError

from .imu_trials import EXCERPTS, METHODS, Trial, lost_samples, read_trials, score

LOST = 0.03  # share of samples


def main() -> None:
    """Print the table; exit code 2 for wrong files."""
    parser = argparse.ArgumentParser(prog="bench.imu_report", description="Compare the trunk estimator with its peers.")
    parser.add_argument("folder", nargs="?", type=Path, default=EXCERPTS, help="folder of trials (%(default)s)")
    options = parser.parse_args()
    try:
        table = report(list(read_trials(options.folder)))
    except DataError as error:
        sys.stderr.write(f"{error}\n")
        raise SystemExit(2) from None
    print(table)


def report(trials: list[Trial]) -> str:
    """Return the table."""
    methods = [name for name in METHODS if name != "imufusion, its defaults" or importlib.util.find_spec("imufusion")]
    head = ["trial", "here", "published", f"here, {LOST:.0%} of the samples lost", *methods[1:]]
    rows = [head, ["---"] * len(head)]
    costs: dict[str, list[float]] = {name: [] for name in methods}
    for trial in trials:
        scores = {name: score(trial, name) for name in methods}
        lossy = score(trial.without(lost_samples(len(trial.times), LOST)), "here")
        for name in methods:
            costs[name].append(scores[name].cost)
        here, *others = (f"{s.rms:.2f} ({s.largest:.1f})" for s in scores.values())
        lossy_cell = f"{lossy.rms:.2f} ({lossy.largest:.1f}), {lossy.published:.1%} published"
        rows.append([trial.name.replace("_", " "), here, f"{scores['here'].published:.1%}", lossy_cell, *others])
    cost = [f"{min(costs[name]):.0f}" for name in methods]
    rows.append(["us of processor time a sample", cost[0], "", "", *cost[1:]])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


if __name__ == "__main__":
    main()
