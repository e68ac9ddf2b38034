# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arm on two computers over better and worse wires: `python -m test.two_computers [--output FILE] [CASE ...]`.

Each case starts all nodes anew; the virtual wearer brings the arm to a pose and lets go. The table is printed, and
written as JSON with `--output`; cases that the file holds already are replaced.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from ..support.launched_nodes import SIMULATED
from .case import Result, play
from .network import Wire

HOLD = 8.0  # s
# As config/sim.yaml, for a busy computer, but efforts may be no older than on a real arm.
TIMING = {**SIMULATED, "can_bridge": {**SIMULATED["can_bridge"], "command_timeout": 0.05}}
# Delay ms one way, jitter ms, loss.
CASES = [
    Wire(),
    Wire(2.0),
    Wire(5.0),
    Wire(5.0, 5.0),
    Wire(10.0),
    Wire(10.0, 10.0),
    Wire(15.0),
    Wire(20.0),
    Wire(20.0, 5.0),
    Wire(0.0, 0.0, 0.01),
    Wire(0.0, 0.0, 0.05),
    Wire(0.0, 0.0, 0.1),
    Wire(5.0, 2.0, 0.05),
    Wire(10.0, 5.0, 0.1),
]
HEADER = (
    "| delay one way ms | jitter ms | loss % | outcome | held s | age of efforts ms: median / 99 % / largest "
    "| unanswered % | longest gap ms | drift deg | late cycles, frame ms |"
)


def row(result: Result) -> str:
    """Return the table's row of one case."""
    wire, seen = result.wire, result.measured
    cells = [f"{wire.delay:g}", f"{wire.jitter:g}", f"{100 * wire.loss:g}", result.outcome]
    if seen is None:
        cells += [""] * 5
    else:
        cells += [
            f"{seen.duration:.1f}",
            " / ".join(f"{age:.1f}" for age in seen.age),
            f"{100 * seen.missed:.1f}",
            f"{seen.gap:.0f}",
            f"{seen.drift:.2f}",
        ]
    return f"| {' | '.join([*cells, f'{result.late_cycles}, {result.late_frame:.0f}'])} |"


def main() -> None:
    """Play the cases and print the table."""
    parser = argparse.ArgumentParser(prog="python -m test.two_computers")
    parser.add_argument("cases", nargs="*", type=int, metavar="CASE", help=f"0 to {len(CASES) - 1}; default: all")
    parser.add_argument("--output", type=Path, help="JSON file of the results")
    options = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", "1")
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # ends what was started
    results = {}
    if options.output and options.output.exists():
        results = json.loads(options.output.read_text())
    print(HEADER)
    print("|" + "---|" * (HEADER.count("|") - 1))
    for case in options.cases or range(len(CASES)):
        with tempfile.TemporaryDirectory() as folder:
            result = play(CASES[case], Path(folder), HOLD, TIMING)
        print(row(result), flush=True)
        results[str(case)] = asdict(result)
        if options.output:
            options.output.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
