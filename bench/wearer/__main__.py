# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.wearer [--devices 20] [--first 0]: how far `wearer_efforts` is from what the wearer does.

Random calibrated devices with a virtual wearer go through one trial each, offline, one on each core.
"""

import os
import sys
from collections.abc import Sequence

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from exo_gravity.core.numbers import COVER

from ..device_study import Row, run_study
from .study import KINDS, Trial, judged

COVERAGE = (0.92, 0.98)
SHARE_ERROR = 0.05


def told(one: Trial | str) -> str:
    """Return the line of one wearer."""
    if isinstance(one, str):
        return one
    return f"share {float(one.share.value):.1%}, true {one.true_share:.1%} {one.trouble}"


def verdict(found: list[Trial | str]) -> list[Row]:
    """Return the table: RMS error by joint and kind of motion, cover, errors of the share."""
    trials = [one for one in found if isinstance(one, Trial)]
    rows = [Row("wearers whose calibration is refused", f"{len(found) - len(trials)} of {len(found)}")]
    for number, kind in enumerate(KINDS):
        error = np.concatenate([trial.error[trial.kind == number] for trial in trials])
        rms = " ".join(f"{value:.2f}" for value in np.sqrt(np.mean(error**2, axis=0)))
        rows.append(
            Row(f"{kind}: RMS error by joint, within the 95 % band", f"{rms} Nm, {cover(trials, [number]):.1%}")
        )
    whole = cover(trials, range(len(KINDS)))
    low, high = COVERAGE
    rows.append(Row("all: within the 95 % band", f"{whole:.1%}", f"{low:.0%} to {high:.0%}", low <= whole <= high))
    off = np.array([abs(float(trial.share.value) - trial.true_share) for trial in trials])
    shown = f"{np.median(off):.1%}, {off.max():.1%}"
    what = "share over a trial, error: median, largest"
    rows.append(Row(what, shown, f"{SHARE_ERROR:.0%}", bool(off.max() < SHARE_ERROR)))
    for part, name in enumerate(("lifting", "resting", "tiring")):
        errors = [
            (abs(float(share.value) - true), float(share.deviation)) for share, true in (t.parts[part] for t in trials)
        ]
        inside = sum(error < COVER * deviation for error, deviation in errors)
        shown = f"{max(error for error, _ in errors):.1%}; {inside} of {len(errors)} within their band"
        rows.append(Row(f"share while {name}, largest error", shown))
    carried = sum(not trial.trouble for trial in trials)
    rows.append(Row("arms carried to the end", f"{carried} of {len(trials)}", "all", carried == len(trials)))
    return rows


def cover(trials: Sequence[Trial], kinds: Sequence[int]) -> float:
    """Return the share of times and joints at which the 95 % band covers the truth."""
    inside = [(np.abs(trial.error) <= COVER * trial.deviation)[np.isin(trial.kind, kinds)] for trial in trials]
    return float(np.concatenate(inside).mean())


if __name__ == "__main__":
    sys.exit(run_study("wearer", judged, told, verdict))
