# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows of the benchmark, each with our figure and that of a peer or a limit; their table and file."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Row:
    """One comparison. name: what is measured, and against what. ours, peer: in `unit`. spread: of our figure."""

    name: str
    ours: float
    peer: float
    unit: str
    spread: str = ""
    more_is_better: bool = False

    @property
    def ratio(self) -> float:
        """Ours as a multiple of the peer's."""
        return self.ours / self.peer if self.peer else float("inf") if self.ours else 1.0

    @classmethod
    def of_values(
        cls, name: str, ours: Sequence[float], peer: Sequence[float], unit: str, more_is_better: bool = False
    ) -> Row:
        """Return the row of runs that took turns: medians, and the spread of ours and of the ratio."""
        row = cls(name, statistics.median(ours), statistics.median(peer), unit, "", more_is_better)
        ratios = [cls(name, one, other, unit).ratio for one, other in zip(ours, peer, strict=True)]
        return row if len(ours) == 1 else replace(row, spread=f"{range_of(ours)}, x{range_of(ratios)}")


def race(calls: Sequence[tuple[Callable[[], object], int]], blocks: int) -> list[list[float]]:
    """Time functions in turns, so that other load on the machine affects all of them alike; return s a call, each time.

    calls: each function, and how often a block calls it.
    """
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(blocks):
        for (call, count), taken in zip(calls, times, strict=True):
            begin = time.perf_counter()
            for _ in range(count):
                call()
            taken.append((time.perf_counter() - begin) / count)
    return times


def range_of(values: Sequence[float]) -> str:
    """Return the least and the largest value."""
    return f"{min(values):.3g} to {max(values):.3g}"


def show(rows: Sequence[Row], console: Console) -> None:
    """Print the table."""
    table = Table("", "ours", "spread", "peer or limit", "unit", "ratio", "", box=None, pad_edge=False)
    for column in table.columns[1:4] + table.columns[5:6]:
        column.justify = "right"
    for row in rows:
        mark = f"x{', more is better' * row.more_is_better}"
        table.add_row(row.name, f"{row.ours:.4g}", row.spread, f"{row.peer:.4g}", row.unit, f"{row.ratio:.3g}", mark)
    console.print(table)


def save(rows: Sequence[Row], path: Path) -> None:
    """Write the rows as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = "name", "ours", "peer", "unit", "ratio"
    content = [{name: getattr(row, name) for name in names} for row in rows]
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
