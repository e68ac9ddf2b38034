"""`make faults`: run the fault matrix on the simulated device, with real processes; print a table and write JSON.

    python -m test.faults.run [--only TEXT] [--start N] [--output build/faults.json]

The JSON file is written after every case. The exit code is 1 if a case was unsafe or could not be run: a reaction that
is too late, a joint above 1 rad/s, a torque step above 50 Nm/s times the period, a motor that is switched on again, or
an exception in the log. An interrupted run prints its table too, and its exit code is 130.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))  # before rclpy is imported

from rich.console import Console
from rich.table import Table

from .cases import CASES, FaultCase
from .runner import Result, RigPool, not_run

INTERRUPTED = 130  # the shell's exit code after Ctrl-C


def main() -> int:
    """Run the cases; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m test.faults.run", description="Run the fault matrix.")
    parser.add_argument("--only", default="", metavar="TEXT", help="only cases whose name contains TEXT")
    parser.add_argument("--start", default=1, type=int, metavar="N", help="begin with the Nth of them")
    parser.add_argument("--output", default=Path("build/faults.json"), type=Path, metavar="FILE", help="(%(default)s)")
    arguments = parser.parse_args()
    cases = [case for case in CASES if arguments.only in case.name][arguments.start - 1 :]
    console = Console(width=max(120, Console().width))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    results: list[Result] = []
    interrupted = False
    try:
        for result in run_all(cases, console):
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


def run_all(cases: Sequence[FaultCase], console: Console) -> Iterator[Result]:
    """Run the cases, show their progress, and yield their results."""
    with tempfile.TemporaryDirectory() as folder, RigPool(Path(folder)) as pool:
        for number, case in enumerate(cases, 1):
            console.print(f"[{number}/{len(cases)}] {case.name} ...", end=" ", markup=False)
            try:
                result = pool.run(case)
            except Exception as error:  # the other cases may still show something
                result = not_run(case, error)
            console.print(result["result"], result["unsafe"] or "safe", markup=False)
            for line in result.pop("log", ()):
                console.print("    ", line, markup=False)
            yield result


def save(results: Sequence[Result], path: Path) -> None:
    """Write the results as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(results, indent=1) + "\n")


def table(results: Sequence[Result]) -> Table:
    """Return the results as a table."""
    grid = Table("fault", "result", "after ms", "top rad/s", "step Nm", "latched", "verdict")
    for result in results:
        figures = (result["reaction_ms"], result["top_speed_rad_s"], result["torque_step_nm"], result["latched"])
        cells = ["-" if figure is None else str(figure) for figure in figures]
        grid.add_row(result["fault"], result["result"], *cells, result["unsafe"] or "safe")
    return grid


if __name__ == "__main__":
    sys.exit(main())
