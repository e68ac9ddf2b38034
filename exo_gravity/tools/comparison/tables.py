"""The tables of `validate` on the terminal, and their rows as CSV."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path

from exo_gravity.core.model.anfis import AnfisLaw
from exo_gravity.tools.anfis.training import Trained
from exo_gravity.tools.comparison.growth import Growth
from exo_gravity.tools.comparison.laws import Baseline, Row
from exo_gravity.tools.inputs.references import PAPER_ANALYTICAL, PAPER_ANFIS, PAPER_SECONDS


def paper_table(rows: Sequence[Row], law: AnfisLaw, trained: Sequence[Trained]) -> Iterator[str]:
    """Yield the lines of the paper's comparison, its figures next to ours; rows: with its assumption d_n = l_n."""
    ours = {
        name: [row.rmse for row in rows if (row.positions, row.law, row.reference) == ("workspace", name, "gravload")]
        for name in ("exact", "EQ2-EQ5")
    }
    seconds = f"{sum(result.seconds for result in trained):.1f} s for all three"
    yield f"{'RMSE against gravload in Nm':<34}{'joint 2':>10}{'joint 3':>10}{'joint 4':>10}   training"
    for name, values, training in (
        ("EQ3-EQ5, the paper", PAPER_ANALYTICAL, ""),
        ("EQ3-EQ5, here", ours["EQ2-EQ5"][1:], ""),
        ("exact law, here", ours["exact"][1:], ""),
        ("ANFIS, the paper", PAPER_ANFIS, f"{PAPER_SECONDS:.0f} s per joint"),
        ("ANFIS, here", law.error["training"], seconds),
        ("ANFIS, here, between the positions", law.error["held_out"], ""),
    ):
        yield f"{name:<34}{''.join(f'{value:>10.2e}' for value in values)}   {training}".rstrip()


def law_table(rows: Iterable[Row]) -> Iterator[str]:
    """Yield the lines of RMSE, largest error and RMSE / RMS torque for each case, law and joint."""
    yield f"{'law - reference; Nm':<22}" + "".join(f"{f'joint {joint}':^24}" for joint in range(1, 5))
    yield f"{'':<22}" + "".join(f"{'RMSE':>9}{'largest':>9}{'share':>6}" for _ in range(4))
    for (cog, positions, limit, count), case in groupby(rows, lambda r: (r.cog, r.positions, r.limit, r.count)):
        tilt = f"trunk tilted by up to {limit} degrees" if limit else "trunk upright"
        yield f"CoGs {cog}; {count:,} {positions} positions; {tilt}"
        for (law, reference), line in groupby(case, lambda r: (r.law, r.reference)):
            if reference == "gravload" or law == "exact":
                yield f"{f'  {law} - {reference}':<22}" + "".join(map(_cell, line))


def _cell(row: Row) -> str:
    share = "-" if math.isnan(row.share) else f"{100 * row.share:.0f}%"
    return f"{row.rmse:>9.1e}{row.largest:>9.1e}{share:>6}"


def growth_line(row: Growth | None = None) -> str:
    """Return one line of the growth table; without a row, its heading."""
    if row is None:
        names = ("inputs", "functions", "rules", "parameters", "positions", "steps", "training", "one pose")
        return "".join(f"{name:>11}" for name in names) + f"{'RMSE':>11}{'held out':>11}"
    counts = (row.inputs, row.functions, row.rules, row.parameters, row.positions, row.steps)
    times = f"{row.training_time:>9.2f} s{row.inference_time * 1e6:>8.0f} us"
    return "".join(f"{count:>11}" for count in counts) + f"{times}{row.training_rmse:>11.1e}{row.held_out_rmse:>11.1e}"


def baseline_line(row: Baseline | None = None) -> str:
    """Return one line of the table of baselines; without a row, its heading."""
    if row is None:
        names = ("RMSE", "largest", "RMSE", "largest", "memory", "one pose", "training", "effort", "sag", "sag bowed")
        inside = f"{'':<22}{'inside, Nm':>22}{'outside, Nm':>22}"
        return f"{inside}\n{'':<22}" + "".join(f"{name:>11}" for name in names)
    errors = (row.inside_rmse, row.inside_largest, row.outside_rmse, row.outside_largest)
    figures = [(error, ".1e", "") for error in errors]
    figures += [(row.memory / 1e3, ".0f", " kB"), (row.pose_time * 1e6, ".0f", " us"), (row.training_time, ".1f", " s")]
    figures += [(row.effort, ".2f", " Nm")]
    figures += [(math.degrees(sag), ".2f", " deg") for sag in (row.sag, row.sag_bowed)]
    cells = ("-" if math.isnan(value) else f"{value:{style}}{unit}" for value, style, unit in figures)
    return f"{row.law:<22}" + "".join(f"{cell:>11}" for cell in cells)


def write_csv(path: Path, rows: Sequence[Row | Growth | Baseline]) -> None:
    """Write dataclasses as CSV, one column per field (SI units: Nm, s; `limit` in degrees)."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(asdict(rows[0])))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
