# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.effort [--quick]: a wearer's exertion on the simulated arm, under every setting of the compensator.

A virtual wearer moves the arm through 13 poses, a reach task and a sine sweep of each joint. Tables go to the terminal,
CSV files and a figure to a folder.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from ..parts import play
from .exertion import RATE, Exertion
from .report import Results, comparisons, figure, tables, write_csv
from .study import Study, TaskUnderSetting, played


def line(found: tuple[TaskUnderSetting, Exertion]) -> str:
    """Return what is printed of a part."""
    part, exertion = found
    return f"{part.setting}, {part.task}: {exertion.total:.2f} Nm"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="bench.effort", description="Measure how hard the simulated arm is to move.")
    parser.add_argument("--quick", action="store_true", help="a reach task under four settings")
    parser.add_argument("--rate", type=float, default=RATE, metavar="HZ", help="of the control loop (%(default)g)")
    parser.add_argument("--params", type=Path, metavar="FILE", help="parameter file (default: the packaged simulator)")
    parser.add_argument("--output", type=Path, default=Path("build/effort"), metavar="DIR", help="(%(default)s)")
    options = parser.parse_args()
    console, study = Console(width=None if Console().is_terminal else 180, highlight=False), Study.of(options.params)
    results = Results({}, {(setting, share): reached for setting, share, reached in study.workspaces()})
    parts, files = study.parts(options.quick, options.rate, options.params), [options.params] if options.params else []
    for part, exertion in play("effort", played, parts, line, files=files):
        results.exertions[part.setting, part.task] = exertion
    for table in tables(results):
        console.print(table)
    for sentence in comparisons(results):
        console.print(sentence, markup=False, soft_wrap=True)
    options.output.mkdir(parents=True, exist_ok=True)
    write_csv(results, options.output)
    figure(results).savefig(options.output / "effort.png", dpi=120)
    console.print(f"Tables and figure: {options.output}")


if __name__ == "__main__":
    main()
