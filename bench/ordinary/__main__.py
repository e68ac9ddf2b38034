# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.ordinary [--minutes 60] [--only TEXT]: ordinary motors, sensors and computers raise no alarm.

Plays an arm in virtual time: many starts, a wearer who reaches, walks and rests, no fault. Prints a table, and writes
build/ordinary.json. Exit code 1 if a start was refused, an arm was let down, or was without tilt for a second.
"""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.table import Table

from exo_gravity.lab.parallel import in_processes

from .arm import Result
from .rows import Row, all_rows, played

LONGEST = 1.0  # s without tilt


def is_quiet(result: Result) -> bool:
    """Return whether nothing was raised without cause."""
    return not result.refused_starts and not result.let_downs and result.without_tilt < LONGEST


def main() -> int:
    """Play the rows; return the exit code."""
    parser = argparse.ArgumentParser(prog="bench.ordinary", description="Watch for false alarms in virtual time.")
    parser.add_argument("--minutes", type=float, default=60.0, help="simulated, all rows together (%(default)g)")
    parser.add_argument("--only", default="", metavar="TEXT", help="only rows whose name contains TEXT")
    parser.add_argument("--workers", type=int, default=None, help="processes (default: one per core)")
    options = parser.parse_args()
    console = Console(width=None if Console().is_terminal else 180, highlight=False)
    rows = [row for row in all_rows() if options.only in row.name]
    share = 60.0 * options.minutes / len(rows)
    results: dict[Row, Result] = {}
    for outcome in in_processes(played, [(row, share) for row in rows], options.workers):
        if outcome.result is None:
            raise RuntimeError(f"{outcome.item}: {outcome.problem}")
        results[outcome.item[0]] = outcome.result
        causes = "; ".join(outcome.result.refused_starts + outcome.result.let_downs) or "quiet"
        console.print(f"{len(results)} of {len(rows)}: {outcome.item[0].name}: {causes}", markup=False)
    table = Table(
        "", "minutes", "starts", "refused", "let down", "rides", "samples %", "no tilt s", "error Nm", box=None
    )
    for row in rows:
        one = results[row]
        refused = 100.0 * one.refused_samples / max(1, one.samples)
        figures = (f"{one.time / 60.0:.1f}", one.starts, len(one.refused_starts), len(one.let_downs), one.rides)
        others = (f"{refused:.1f}", f"{one.without_tilt:.2f}", f"{one.largest_error:.2f}")
        table.add_row(row.name, *map(str, figures), *others)
    console.print(table)
    loud = [row.name for row in rows if not is_quiet(results[row])]
    total = sum(result.time for result in results.values()) / 60.0
    console.print(f"{total:.0f} minutes, {sum(result.starts for result in results.values())} starts; not quiet: {loud}")
    output = Path("build/ordinary.json")
    output.parent.mkdir(exist_ok=True)
    output.write_text(json.dumps({row.name: asdict(results[row]) for row in rows}, indent=1) + "\n", encoding="utf-8")
    return int(bool(loud))


if __name__ == "__main__":
    sys.exit(main())
