# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What straps that give and a shoulder that moves do to the estimate, whose model has neither."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from exo_gravity.core.numbers import COVER

from ..device_study import options_of
from ..parts import play as part_by_part
from .devices import Worn, draw
from .report import points
from .strapped_arm import RHYTHM, StrappedArm
from .study import Trial, judge, play

STILL = ({"hold": 47.0},)  # of the trunk
TIED = ("none", "straps that give", "straps, and a shoulder that moves")


def trials(worn: Worn) -> list[Trial]:
    """Play and judge the trial of `worn` with each of TIED, on a trunk at rest."""
    ties = (None, StrappedArm(worn.config, 0.0 * RHYTHM), StrappedArm(worn.config))
    return [judge(play(worn, tie, STILL)) for tie in ties]


def table(found: Sequence[Sequence[Trial]]) -> str:
    """Return the table of all devices' `trials`."""
    lines = [
        "| between wearer and robot | RMS error, Nm | within the 95 % band | share over a trial, off by | mean |",
        "|---|---|---|---|---|",
    ]
    for name, column in zip(TIED, zip(*found, strict=True), strict=True):
        error = np.concatenate([trial.error[0] for trial in column])
        rms = " ".join(f"{value:.2f}" for value in np.sqrt(np.mean(error**2, axis=0)))
        inside = np.concatenate([np.abs(trial.error[0]) <= COVER * trial.curve.deviation for trial in column]).mean()
        off = np.array([float(trial.share.value) - trial.true_share for trial in column])
        lines.append(
            f"| {name} | {rms} | {inside:.1%} | {points(float(np.abs(off).max()))} | {100.0 * off.mean():+.1f} |"
        )
    return "\n".join(lines)


def tied(seed: int) -> list[Trial]:
    """Return the `trials` of a device."""
    return trials(draw(seed))


def main() -> int:
    """Run the study; print its table, and write it."""
    options = options_of("bench.wearer.straps", "What straps and a shoulder that moves do.", Path("build/straps"))
    found = part_by_part("straps", tied, options.seeds, lambda device: f"device {device[0].seed}: {troubles(device)}")
    text = table(found)
    print(text)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.with_suffix(".md").write_text(f"{text}\n", encoding="utf-8")
    return int(any(troubles(device) for device in found))


def troubles(device: Sequence[Trial]) -> str:
    """Return what went wrong in the trials of a device, or ''."""
    return "; ".join(trial.trouble for trial in device if trial.trouble)


if __name__ == "__main__":
    sys.exit(main())
