"""python -m bench.soak [--minutes 10] [--rate 500]: does memory or latency grow while the nodes run?

Prints, minute by minute, the latency from bus to bus and each process's memory.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.latency import percentile
from bench.loop import run

MINUTE = 60.0  # s


def memory(pid: int) -> float:
    """Return the memory in MB that a process holds."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1e3


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(prog="bench.soak", description="Watch memory and latency of a long run.")
    parser.add_argument("--minutes", type=int, default=10)
    parser.add_argument("--rate", type=float, default=500.0, help="Hz")
    options = parser.parse_args()
    console = Console(highlight=False)
    held: list[dict[str, float]] = []

    def watch(processes: dict[str, int]) -> None:
        end = time.monotonic()
        for minute in range(options.minutes + 1):
            held.append({name: memory(pid) for name, pid in processes.items()})
            console.print(f"minute {minute} of {options.minutes}")
            end += MINUTE
            if minute < options.minutes:
                time.sleep(max(0.0, end - time.monotonic()))

    result = run("nodes", options.rate, False, options.minutes * MINUTE, watch)
    table = Table("minute", "p50 ms", "p99 ms", "p99.9 ms", *(f"{name} MB" for name in held[0]), box=None)
    parts = np.array_split(result.arms[0].latency, options.minutes)
    for minute, part in enumerate(parts):
        figures = [percentile(part, share) * 1e3 for share in (50, 99, 99.9)]
        sizes = [f"{size:.1f}" for size in held[minute + 1].values()]
        table.add_row(str(minute + 1), *(f"{figure:.3f}" for figure in figures), *sizes)
    console.print(table)
    seen = result.arms[0]
    console.print(
        f"{seen.cycles} cycles, {seen.missed} missed, {seen.late} late, {seen.incomplete} incomplete, {seen.lost} lost"
    )


if __name__ == "__main__":
    main()
