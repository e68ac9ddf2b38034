"""python -m bench.wearer [--devices 20] [--first 0] [--output build/wearer]: the study of `wearer_efforts`.

Random calibrated devices with a virtual wearer go through one trial each, offline and on one core, 20 s each. It prints
a table, writes it and a picture of the first trial, and exits with 1 if a limit is missed.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

from .devices import draw
from .report import as_markdown, picture, points, verdict
from .study import Trial, judge, play


def main() -> int:
    """Run the study; return the exit code."""
    parser = argparse.ArgumentParser(prog="bench.wearer", description="Judge the estimate of the wearer's torque.")
    option = parser.add_argument
    option("--devices", type=int, default=20, metavar="N", help="how many (default: %(default)s)")
    option("--first", type=int, default=0, metavar="SEED", help="of the first one (default: %(default)s)")
    option("--output", type=Path, default=Path("build/wearer"), metavar="FILE", help="(default: %(default)s)")
    options = parser.parse_args()
    trials: list[Trial] = []
    for seed in range(options.first, options.first + options.devices):
        trial = judge(play(draw(seed)))
        trials.append(trial)
        error = float(trial.share.value) - trial.true_share
        print(
            f"device {seed}: share {float(trial.share.value):.1%}, off by {points(error)} {trial.trouble}", flush=True
        )
    rows = verdict(trials)
    text = as_markdown(rows)
    print(text)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.with_suffix(".md").write_text(f"{text}\n", encoding="utf-8")
    picture(trials[0]).savefig(options.output.with_suffix(".png"), dpi=120)
    return 0 if all(row.held for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
