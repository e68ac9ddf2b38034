"""The tables and the figure of the study."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .growth import Growth
from .learned import Baseline

LEAST = 0.01  # Nm or degrees; a smaller bar is drawn as 0


def growth_line(row: Growth | None = None) -> str:
    """Return one line of the growth table; without a row, its heading."""
    if row is None:
        names = ("inputs", "functions", "rules", "parameters", "positions", "steps", "training", "one pose")
        return "".join(f"{name:>11}" for name in names) + f"{'RMSE':>11}{'held out':>11}"
    times = f"{row.training_time:>9.2f} s{row.inference_time * 1e6:>8.0f} us"
    return "".join(f"{count:>11}" for count in row[:6]) + f"{times}{row.training_rmse:>11.1e}{row.held_out_rmse:>11.1e}"


def baseline_line(row: Baseline | None = None) -> str:
    """Return one line of the table of baselines; without a row, its heading."""
    if row is None:
        names = ("RMSE", "largest", "RMSE", "largest", "memory", "one pose", "training", "exertion", "sag", "sag bowed")
        inside = f"{'':<22}{'inside, Nm':>22}{'outside, Nm':>22}"
        return f"{inside}\n{'':<22}" + "".join(f"{name:>11}" for name in names)
    errors = (row.inside_rmse, row.inside_largest, row.outside_rmse, row.outside_largest)
    figures = [(error, ".1e", "") for error in errors]
    figures += [(row.memory / 1e3, ".0f", " kB"), (row.pose_time * 1e6, ".0f", " us"), (row.training_time, ".1f", " s")]
    figures += [(row.exertion, ".2f", " Nm")]
    figures += [(math.degrees(sag), ".2f", " deg") for sag in (row.sag, row.sag_bowed)]
    cells = ("-" if math.isnan(value) else f"{value:{style}}{unit}" for value, style, unit in figures)
    return f"{row.law:<22}" + "".join(f"{cell:>11}" for cell in cells)


def write_csv(path: Path, rows: Sequence[Growth] | Sequence[Baseline]) -> None:
    """Write rows as CSV, one column per field, in SI units."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(rows[0]._fields)
        writer.writerows(rows)


def figure(rows: Sequence[Baseline]) -> Figure:
    """Return each law's error inside and outside the training box, and each controller's cost for the wearer."""
    result = Figure(figsize=(10, 7.5), layout="constrained")
    axis, below = result.subplots(2)
    _draw_burdens(below, [row for row in rows if not math.isnan(row.exertion)])
    rows = [row for row in rows if not math.isnan(row.inside_rmse)]
    place = np.arange(len(rows))
    for shift, part, colour in ((-0.2, "inside", "tab:blue"), (0.2, "outside", "tab:orange")):
        error, largest = (np.array([getattr(row, f"{part}_{name}") for row in rows]) for name in ("rmse", "largest"))
        bars = axis.bar(place + shift, error, 0.38, color=colour, label=f"RMSE {part} the training box")
        axis.bar_label(bars, [f"{value:.1g}" for value in error], fontsize=8)
        axis.plot(place + shift, largest, "v", color=colour, markeredgecolor="black", label=f"largest error {part}")
    axis.set_yscale("log")
    axis.set_xticks(place, [f"{row.law}\n{row.memory / 1e3:,.0f} kB, {1e6 * row.pose_time:,.0f} µs" for row in rows])
    axis.set_ylabel("error against gravload (Nm)")
    axis.set_ylim(1e-17, 1e3)
    axis.legend(fontsize=8, ncols=4, loc="upper center")
    axis.grid(axis="y", alpha=0.3)
    return result


def _draw_burdens(axis: Axes, rows: Sequence[Baseline]) -> None:
    """Draw the wearer's exertion and the sag after letting go."""
    place = np.arange(len(rows))
    for shift, values, colour, label in (
        (-0.27, [row.exertion for row in rows], "tab:green", "exertion in a reach, RMS in Nm"),
        (0.0, [math.degrees(row.sag) for row in rows], "tab:red", "largest sag after letting go, in degrees"),
        (0.27, [math.degrees(row.sag_bowed) for row in rows], "tab:purple", "the same, trunk bowed by 30 degrees"),
    ):
        bars = axis.bar(place + shift, np.maximum(values, LEAST), 0.26, color=colour, label=label)
        axis.bar_label(
            bars, [f"{value:.{int(value < 10.0)}f}" if value > LEAST else "0" for value in values], fontsize=8
        )
    axis.set_yscale("log")
    axis.set_ylim(LEAST, 3e3)
    axis.set_ylabel("in the simulator")
    axis.set_xticks(place, [row.law.replace(" ", "\n", 1) for row in rows])
    axis.legend(fontsize=8, ncols=3, loc="upper center")
    axis.grid(axis="y", alpha=0.3)
