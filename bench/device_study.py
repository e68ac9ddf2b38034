# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the studies of random devices share: their options, the devices one on each core, and the table of figures."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

from exo_gravity.lab.parallel import in_processes

Result = TypeVar("Result")


class Row(NamedTuple):
    """A row of the table. limit: '' for none; held: whether the figure is within it."""

    what: str
    shown: str
    limit: str = ""
    held: bool = True


def run_study(
    name: str,
    work: Callable[[int], Result],
    told: Callable[[Result], str],
    verdict: Callable[[list[Result]], list[Row]],
) -> int:
    """Play `work` for each seed of the command line, print and write the table; return the exit code.

    told: what to print of a result. verdict: the rows of all results, in the order of the seeds.
    """
    parser = argparse.ArgumentParser(prog=f"bench.{name}")
    option = parser.add_argument
    option("--devices", type=int, default=20, metavar="N", help="how many (default: %(default)s)")
    option("--first", type=int, default=0, metavar="SEED", help="of the first one (default: %(default)s)")
    option("--output", type=Path, default=Path(f"build/{name}.md"), metavar="FILE", help="(default: %(default)s)")
    options = parser.parse_args()
    results: dict[int, Result] = {}
    for outcome in in_processes(work, range(options.first, options.first + options.devices)):
        if outcome.result is None:
            raise RuntimeError(f"device {outcome.item}: {outcome.problem}")
        results[outcome.item] = outcome.result
        print(f"{len(results)} of {options.devices}, device {outcome.item}: {told(outcome.result)}", flush=True)
    rows = verdict([results[seed] for seed in sorted(results)])
    lines = ["| what | shown | limit | |", "|---|---|---|---|"]
    lines += (f"| {r.what} | {r.shown} | {r.limit} | {'' if r.held else 'missed'} |" for r in rows)
    text = "\n".join(lines)
    print(text)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(f"{text}\n", encoding="utf-8")
    return 0 if all(row.held for row in rows) else 1
