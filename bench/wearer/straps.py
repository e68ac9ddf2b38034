# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What straps that give, a shoulder that moves and elastic joints with play do to the estimate.

Its model has none of them but the joints' stiffness, which is known to 10 %, or not at all. Where it is not known, the
band is also judged as `model_error.deflection` widens it: the angle by which each link sinks with the arm raised.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.numbers import COVER

from ..device_study import options_of
from ..parts import play as part_by_part
from .devices import draw
from .report import points
from .strapped_arm import RHYTHM, StrappedArm
from .study import Trial, judge, play

STILL = ({"hold": 47.0},)  # of the trunk
JOINTS, PLAY = 100.0, math.radians(1.0)  # Nm/rad and rad, of elastic joints
STIFFNESS_ERROR = 0.1  # of what is known of them, as a share
RAISED = (0.1, 0.75, 0.55, 0.85)  # rad, where it is seen by how much each link sinks
TIED = (
    "none", "straps that give", "straps, and a shoulder that moves", "the same, as `calibrate wearer` has seen it",
    f"joints of {JOINTS:g} Nm/rad with a play of 1 degree, unknown",
    "the same, `model_error.deflection` given", "the same, `joint_stiffness` known",
)  # fmt: skip


def trials(seed: int) -> list[Trial]:
    """Play and judge the trial of a device with each of TIED, on a trunk at rest."""
    worn, seen = draw(seed), draw(seed, "shoulder")
    count = len(worn.motors)
    joints: dict[str, Any] = {"joint_stiffness": (JOINTS,) * count, "backlash": (PLAY,) * count}
    elastic = replace(worn, config=replace(worn.config, **joints))
    measured = JOINTS * (1.0 + STIFFNESS_ERROR * np.random.default_rng(seed).standard_normal(count))
    known = replace(elastic, settings=replace(worn.settings, joint_stiffness=measured.tolist()))
    cases = (
        (worn, None), (worn, StrappedArm(worn.config, 0.0 * RHYTHM)), (worn, StrappedArm(worn.config)),
        (seen, StrappedArm(seen.config)), (elastic, None), (known, None),
    )  # fmt: skip
    *tied, unknown, last = [play(case, tie, STILL) for case, tie in cases]
    torque, _ = worn.settings.torque(RAISED, Tilt.of(worn.side))
    sunk = [max(abs(held) / JOINTS, PLAY / 2.0) for held in torque]
    error = replace(worn.settings.model_error, deflection=sunk)
    told = replace(unknown, worn=replace(elastic, settings=replace(worn.settings, model_error=error)))
    return [judge(played) for played in (*tied, unknown, told, last)]


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


def main() -> int:
    """Run the study; print its table, and write it."""
    options = options_of(
        "bench.wearer.straps", "What straps, a shoulder that moves and elastic joints do.", Path("build/straps")
    )
    found = part_by_part("straps", trials, options.seeds, lambda device: f"device {device[0].seed}: {troubles(device)}")
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
