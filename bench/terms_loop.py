# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.terms_loop [--turns 6] [--seconds 5]: what assist efforts and all terms cost the loop at 500 Hz.

One run of the package's nodes. The terms and an outer loop at 500 Hz are on and off in turns, so that other load on the
machine affects both alike. Exit code 1 if the median latency with them is more than 5 % above that without.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from .loop import ONE_ARM, run_loop
from .timing import percentile

RATE = 500.0  # Hz
ALLOWED = 1.05
SETTLING = 2.0  # s for each turn, in addition to what is measured
START = 15.0  # s


def main() -> int:
    """Run, print the median of each turn, and compare."""
    parser = argparse.ArgumentParser(prog="bench.terms_loop")
    parser.add_argument("--turns", type=int, default=6, help="(%(default)s)")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each turn, on and off (%(default)s)")
    options = parser.parse_args()
    windows: dict[str, list[tuple[float, float]]] = {}

    def alternate(_: dict[str, int]) -> list[tuple[float, float]]:
        command = [sys.executable, "-m", "bench.outer_loop", "/right", str(options.turns), str(options.seconds)]
        root = Path(__file__).parents[1]
        windows.update(json.loads(subprocess.run(command, cwd=root, check=True, stdout=subprocess.PIPE).stdout))
        return [*windows["off"], *windows["on"]]

    length = 2.0 * options.turns * (options.seconds + SETTLING) + START
    run = run_loop("nodes", RATE, ONE_ARM, length, watch=alternate)
    latencies = [timing.latency * 1e3 for timing in run.windows]
    off, on = latencies[: options.turns], latencies[options.turns :]
    for name, parts in (("without", off), ("with", on)):
        each = " ".join(f"{percentile(part, 50):.3f}" for part in parts)
        whole = np.concatenate(parts)
        p50, p99 = percentile(whole, 50), percentile(whole, 99)
        print(f"{name:<8} p50 {p50:.3f} ms, p99 {p99:.3f} ms, {len(whole)} answers; p50 of each turn: {each}")
    ratio = percentile(np.concatenate(on), 50) / percentile(np.concatenate(off), 50)
    print(f"p50 with assist_efforts and all terms: {ratio:.3f} times that without, at most {ALLOWED:g} allowed")
    return int(not ratio <= ALLOWED)


if __name__ == "__main__":
    sys.exit(main())
