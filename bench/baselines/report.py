# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The tables and the figure of the study."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from exo_gravity.lab.report.html import JOINT_COLOURS, make_plain

from .growth import Growth
from .learned import Baseline


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
    """Return each law's error inside and outside the training box, and what each controller costs the wearer."""
    result = Figure(figsize=(10.0, 9.0), layout="constrained")
    error, exertion, sag = result.subplots(3, height_ratios=(1.2, 1.0, 1.0))
    laws = [row for row in rows if not math.isnan(row.inside_rmse)]
    inside, outside = JOINT_COLOURS[:2]
    for values, marker, colour, label, side in (
        ([row.inside_rmse for row in laws], "o", inside, "RMSE inside the training box", "right"),
        ([row.outside_rmse for row in laws], "o", outside, "RMSE outside", "left"),
        ([row.outside_largest for row in laws], "v", outside, "largest error outside", "left"),
    ):
        error.plot(values, marker, color=colour, label=label)
        for place, value in enumerate(values):
            away = (-7 if side == "right" else 7, 0)
            error.annotate(
                f"{value:.1g}", (place, value), away, textcoords="offset points", fontsize=8, va="center", ha=side
            )
    error.set_yscale("log")
    error.set_xticks(range(len(laws)), [f"{row.law}\n{row.memory / 1e3:,.0f} kB" for row in laws])
    error.set(ylabel="Error against gravload (Nm)", xlim=(-0.5, len(laws) - 0.5), ylim=(1e-17, 1e2))
    driven = [row for row in rows if not math.isnan(row.exertion)]
    _draw_bars(exertion, driven, {"exertion in a reach": [row.exertion for row in driven]})
    exertion.set_ylabel("Exertion, RMS (Nm)")
    sags = {
        "trunk upright": [math.degrees(row.sag) for row in driven],
        "trunk bowed by 30 degrees": [math.degrees(row.sag_bowed) for row in driven],
    }
    _draw_bars(sag, driven, sags)
    sag.set_ylabel("Largest sag after letting go (deg)")
    for axis in (error, exertion, sag):
        axis.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, frameon=False, fontsize=9)
        make_plain(axis)
    return result


def _draw_bars(axis: Axes, rows: Sequence[Baseline], groups: Mapping[str, Sequence[float]]) -> None:
    """Draw a bar of each row in each group, by its label, on an axis that begins at 0."""
    place, width = np.arange(len(rows)), 0.8 / len(groups)
    for n, (label, values) in enumerate(groups.items()):
        shift = (n - (len(groups) - 1) / 2) * width
        bars = axis.bar(place + shift, values, 0.95 * width, color=JOINT_COLOURS[2 + n], label=label)
        axis.bar_label(bars, [f"{value:.{int(value < 10.0)}f}" for value in values], fontsize=8)
    axis.set_xticks(place, [row.law.replace(" ", "\n", 1) for row in rows])
    axis.margins(y=0.1)
