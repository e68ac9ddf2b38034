# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench [--quick] [--only PARTS] [--output build/bench.json]: print one table and write it as JSON.

PARTS are some of law,loop,recordings,starts. It takes 20 minutes on two cores.
"""

import argparse
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.console import Console

# Every library uses one thread, so that the other cores do not affect the figures.
os.environ["OMP_NUM_THREADS"] = "1"

from .laws import measure_laws
from .loop import Progress, measure_loops
from .recordings import measure_recordings
from .starts import measure_starts
from .table import Row, save, show

PARTS: dict[str, Callable[[bool, Progress], Iterator[Row]]] = {
    "law": lambda quick, progress: measure_laws(quick),
    "loop": measure_loops,
    "recordings": lambda quick, progress: measure_recordings(quick),
    "starts": lambda quick, progress: measure_starts(quick),
}


def main() -> None:
    """Run the chosen parts."""
    parser = argparse.ArgumentParser(prog="bench", description="Measure the laws, the loop and the tools.")
    parser.add_argument("--quick", action="store_true", help="fewer rates and shorter runs, for development")
    parser.add_argument("--only", default=",".join(PARTS), metavar="PARTS", help="parts to run (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("build/bench.json"), metavar="FILE", help="(%(default)s)")
    options = parser.parse_args()
    console = Console(width=None if Console().is_terminal else 150, highlight=False)
    rows: list[Row] = []
    with console.status("bench") as status:

        def progress(text: str) -> None:
            status.update(text)
            if not console.is_terminal:
                console.print(text)

        for part in options.only.split(","):
            progress(part)
            for row in PARTS[part](options.quick, progress):
                rows.append(row)
                save(rows, options.output)  # an interrupted run keeps its figures
    show(rows, console)
    load = os.getloadavg()
    console.print(f"{os.cpu_count()} cores, load {load[0]:.1f} at the end; {options.output}")


if __name__ == "__main__":
    main()
