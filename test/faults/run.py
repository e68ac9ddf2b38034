# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""`make study NAME=faults`: run the fault matrix on the simulated device, with processes; print a table and write JSON.

    python -m test.faults.run [--only TEXT ...] [--start N] [--output build/faults.json] [--busy]

The JSON file is written after every case. The exit code is 1 if a case was unsafe or could not be run. Safe means, by
the arm's true motion until 3 s after the last motor was switched off: damping on every motor in time, no joint above
1 rad/s, no torque step above 50 Nm/s times the period, no motor that drives the arm or is switched on again; and no
exception in the log. A row that is unsafe while the machine itself stands still is run again. An interrupted run prints
its table too, and its exit code is 130.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..support.ports import own_domain

os.environ.setdefault("ROS_DOMAIN_ID", str(own_domain()))  # before rclpy is imported

from rich.console import Console
from rich.table import Table

from .cases import CASES
from .fault_case import FaultCase
from .runner import Result, RigPool, not_run
from .stall_clock import StallClock

STALL = 0.03  # s for which the machine stood still, so that an unsafe result shows nothing about the nodes
ATTEMPTS = 3
INTERRUPTED = 130  # the shell's exit code after Ctrl-C


def main() -> int:
    """Run the cases; return the exit code."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the nodes inherit it: nohup must not hide a row's SIGHUP
    parser = argparse.ArgumentParser(prog="python -m test.faults.run", description="Run the fault matrix.")
    parser.add_argument("--only", default=[""], nargs="+", metavar="TEXT", help="only cases whose name contains TEXT")
    parser.add_argument("--exactly", action="store_true", help="only cases whose name is one of these TEXTs")
    parser.add_argument("--start", default=1, type=int, metavar="N", help="begin with the Nth of them")
    parser.add_argument("--output", default=Path("build/faults.json"), type=Path, metavar="FILE", help="(%(default)s)")
    parser.add_argument("--busy", action="store_true", help="for a busy machine: long time-outs, reactions not judged")
    arguments = parser.parse_args()
    chosen = [case for case in CASES if any(_matches(case, text, arguments.exactly) for text in arguments.only)]
    cases = chosen[arguments.start - 1 :]
    console = Console(width=max(120, Console().width))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    results: list[Result] = []
    interrupted = False
    try:
        for result in run_all(cases, console, not arguments.busy):
            results.append(result)
            save(results, arguments.output)
    except KeyboardInterrupt:
        interrupted = True
        console.print(f"interrupted after {len(results)} of {len(cases)} cases")
    finally:
        console.print(table(results))
    if interrupted:
        return INTERRUPTED
    return int(any(result["unsafe"] for result in results))


def _matches(case: FaultCase, text: str, exactly: bool) -> bool:
    return text == case.name if exactly else text in case.name


def run_all(cases: Sequence[FaultCase], console: Console, shipped_timeouts: bool = True) -> Iterator[Result]:
    """Run the cases, show their progress, and yield their results."""
    with (
        tempfile.TemporaryDirectory() as folder,
        RigPool(Path(folder), shipped_timeouts) as pool,
        contextlib.closing(StallClock()) as clock,
    ):
        for number, case in enumerate(cases, 1):
            console.print(f"[{number}/{len(cases)}] {case.name} ...", end=" ", markup=False)
            start = time.monotonic()
            result = run_undisturbed(case, pool, clock, console)
            result["seconds"] = round(time.monotonic() - start, 1)
            console.print(result["result"], result["unsafe"] or "safe", f"{result['seconds']:.0f} s", markup=False)
            for line in result.pop("log", ()):
                console.print("    ", line, markup=False)
            yield result


def run_undisturbed(case: FaultCase, pool: RigPool, clock: StallClock, console: Console) -> Result:
    """Run a case, and run it again if it is unsafe and the machine stood still meanwhile."""
    for attempt in range(1, ATTEMPTS + 1):
        clock.longest_gap()
        try:
            result = pool.run(case)
        except Exception as error:  # the rig cannot be started or ended
            result = not_run(case, error)
        gap = clock.longest_gap()
        result["attempts"], result["machine_stall_ms"] = attempt, round(1000.0 * gap)
        if not result["unsafe"] or gap < STALL:
            break
        if attempt < ATTEMPTS:
            console.print(
                f"({result['unsafe']}, but the machine stood still for {gap:.3f} s) ...", end=" ", markup=False
            )
    return result


def save(results: Sequence[Result], path: Path) -> None:
    """Write the results as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(results, indent=1) + "\n")


def table(results: Sequence[Result]) -> Table:
    """Return the results as a table."""
    columns = ("reaction_ms", "top_speed_rad_s", "torque_step_nm", "energy_j", "power_w", "damping_of_rated", "off_s")
    grid = Table("fault", "result", "after ms", "top rad/s", "step Nm", "J", "W", "damping", "off s", "verdict")
    for result in results:
        figures = [result[column] for column in columns]
        cells = ["-" if figure is None else str(figure) for figure in figures]
        grid.add_row(result["fault"], result["result"], *cells, result["unsafe"] or "safe")
    return grid


if __name__ == "__main__":
    sys.exit(main())
