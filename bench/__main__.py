"""python -m bench [--quick] [--only law,loop,work] [--output build/bench.json]: one table, and the same as JSON.

12 minutes on two quiet cores; noisy runs are repeated, twice at most.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from rich.console import Console

# One thread each for the numbers of all: what the machine's other cores would do is not what is measured.
os.environ["OMP_NUM_THREADS"] = "1"

from bench.laws import laws
from bench.loops import loops
from bench.table import Row, save, show
from bench.work import work


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(prog="bench", description="Measure the laws, the loop and the tools.")
    parser.add_argument("--quick", action="store_true", help="fewer rates and shorter runs, for development")
    parser.add_argument("--only", default="law,loop,work", help="which parts (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("build/bench.json"), help="(%(default)s)")
    options = parser.parse_args()
    console = Console(width=None if Console().is_terminal else 150, highlight=False)
    rows: list[Row] = []
    with console.status("bench") as status:

        def progress(text: str) -> None:
            status.update(text)
            if not console.is_terminal:
                console.print(text)

        parts = {
            "law": lambda: laws(options.quick),
            "loop": lambda: loops(options.quick, progress),
            "work": lambda: work(options.quick),
        }
        for part in options.only.split(","):
            progress(part)
            for row in parts[part]():
                rows.append(row)
                save(rows, options.output)  # what is measured is kept, should the rest be stopped
    show(rows, console)
    load = os.getloadavg()
    console.print(f"{os.cpu_count()} cores, load {load[0]:.1f} at the end; {options.output}")


if __name__ == "__main__":
    main()
