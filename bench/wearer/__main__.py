# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.wearer [--devices 20] [--first 0] [--output build/wearer]: the study of `wearer_efforts`.

Random calibrated devices with a virtual wearer go through one trial each, weigh loads in the hand, and adapt to one who
tires, offline, 1 to 2 minutes each, one on each core. It prints a table, writes it and a picture of the first trial,
and exits with 1 if a limit is missed.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import NamedTuple

os.environ["OMP_NUM_THREADS"] = "1"

from ..device_study import as_markdown, options_of
from ..parts import play as part_by_part
from . import payload, tiring
from .devices import draw
from .report import picture, points, verdict
from .study import Trial, judge, play


class Judged(NamedTuple):
    """What was seen of one wearer. tired: with and without `support_adapts`."""

    trial: Trial
    weighed: payload.Weighings
    tired: tuple[tiring.Tired, tiring.Tired]

    @property
    def line(self) -> str:
        """What is printed of it."""
        share = float(self.trial.share.value)
        off = points(share - self.trial.true_share)
        return f"device {self.trial.seed}: share {share:.1%}, off by {off} {self.trial.trouble}"


def judged(seed: int) -> Judged:
    """Play and judge one wearer."""
    worn = draw(seed)
    tired = tiring.tire(worn, adapts=True), tiring.tire(worn, adapts=False)
    return Judged(judge(play(worn)), payload.weigh(worn), tired)


def main() -> int:
    """Run the study; return the exit code."""
    options = options_of("bench.wearer", "Judge the estimate of the wearer's torque.", Path("build/wearer"))
    found = part_by_part("wearer", judged, options.seeds, lambda one: one.line)
    trials, weighed, tired = zip(*found, strict=True)
    rows = [*verdict(trials), *payload.verdict(weighed), *tiring.verdict(tired)]
    text = as_markdown(rows)
    print(text)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.with_suffix(".md").write_text(f"{text}\n", encoding="utf-8")
    picture(trials[0]).savefig(options.output.with_suffix(".png"), dpi=120)
    return 0 if all(row.held for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
