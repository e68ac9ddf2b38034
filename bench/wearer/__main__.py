"""python -m bench.wearer [--devices 20] [--first 0] [--output build/wearer]: the study of `wearer_efforts`.

Random calibrated devices with a virtual wearer go through one trial each, weigh loads in the hand, and adapt to one who
tires, offline and on one core, 1 to 2 minutes each. It prints a table, writes it and a picture of the first trial, and
exits with 1 if a limit is missed.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

from ..device_study import as_markdown, options_of
from . import payload, tiring, ways
from .devices import draw
from .report import picture, points, verdict
from .study import Trial, judge, play


def main() -> int:
    """Run the study; return the exit code."""
    options = options_of("bench.wearer", "Judge the estimate of the wearer's torque.", Path("build/wearer"))
    trials: list[Trial] = []
    weighed: list[tuple[payload.Balance, str]] = []
    tired: list[tuple[tiring.Tired, tiring.Tired]] = []
    left = []
    for seed in range(options.first, options.first + options.devices):
        worn = draw(seed)
        trial = judge(play(worn))
        trials.append(trial)
        weighed.append(payload.weigh(worn))
        left.append(ways.left_over(worn))
        tired.append((tiring.tire(worn, adapts=True), tiring.tire(worn, adapts=False)))
        error = float(trial.share.value) - trial.true_share
        print(
            f"device {seed}: share {float(trial.share.value):.1%}, off by {points(error)} {trial.trouble}", flush=True
        )
    rows = [*verdict(trials), *payload.verdict(weighed), *tiring.verdict(tired), *ways.verdict(left)]
    text = as_markdown(rows)
    print(text)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.with_suffix(".md").write_text(f"{text}\n", encoding="utf-8")
    picture(trials[0]).savefig(options.output.with_suffix(".png"), dpi=120)
    return 0 if all(row.held for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
