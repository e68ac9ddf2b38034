"""python -m bench.soak [--minutes 10] [--rate 500]: show whether memory or latency grows while the nodes run.

Prints the latency from bus to bus and the memory of each process, for each minute.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from .loop import run_loop
from .timing import percentile

MINUTE = 60.0  # s


def memory(pid: int) -> float:
    """Return the resident memory of a process in MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1e3


def main() -> None:
    """Run the nodes and print the table."""
    parser = argparse.ArgumentParser(prog="bench.soak", description="Watch memory and latency in a long run.")
    parser.add_argument("--minutes", type=int, default=10)
    parser.add_argument("--rate", type=float, default=500.0, help="Hz")
    options = parser.parse_args()
    console = Console(highlight=False)
    samples: list[dict[str, float]] = []

    def watch(pids: dict[str, int]) -> None:
        end = time.monotonic()
        for minute in range(options.minutes + 1):
            samples.append({name: memory(pid) for name, pid in pids.items()})
            console.print(f"minute {minute} of {options.minutes}")
            end += MINUTE
            if minute < options.minutes:
                time.sleep(max(0.0, end - time.monotonic()))

    run = run_loop("nodes", options.rate, False, options.minutes * MINUTE, watch)
    table = Table("minute", "p50 ms", "p99 ms", "p99.9 ms", *(f"{name} MB" for name in samples[0]), box=None)
    parts = np.array_split(run.arms[0].latency, options.minutes)
    for minute, part in enumerate(parts):
        figures = [percentile(part, share) * 1e3 for share in (50, 99, 99.9)]
        sizes = [f"{size:.1f}" for size in samples[minute + 1].values()]
        table.add_row(str(minute + 1), *(f"{figure:.3f}" for figure in figures), *sizes)
    console.print(table)
    timing = run.arms[0]
    console.print(
        f"{timing.cycles} cycles: {timing.missed} missed, {timing.late} late, "
        f"{timing.incomplete} incomplete, {timing.lost} answers lost"
    )


if __name__ == "__main__":
    main()
