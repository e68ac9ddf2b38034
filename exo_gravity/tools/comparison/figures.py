"""The figures of `validate`: error over the workspace, and error over trunk tilt."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")  # draws without a screen
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from exo_gravity.tools.comparison.laws import Baseline, Row, rms
from exo_gravity.tools.inputs.arms import ConfiguredArm

FLOOR, CEILING = 1e-7, 1.0  # Nm, ends of the colour scale
LEAST = 0.01  # Nm or degrees, below which a bar of the baselines counts as 0
GRID = (56, 56, 7)  # positions of joints 2, 3, 4 in the workspace figure
# Overlapping lines stay visible, because the wider ones are drawn first.
STYLES: dict[str, dict[str, Any]] = {
    "EQ2-EQ5": {"color": "tab:orange", "marker": "s", "linewidth": 4, "markersize": 7},
    "EQ1m-EQ4m": {"color": "tab:red", "marker": "D", "linewidth": 2},
    "ANFIS": {"color": "tab:blue", "marker": "^", "linestyle": "--"},
    "exact": {"color": "tab:green", "marker": "o"},
}

Error = Callable[[np.ndarray], np.ndarray]  # theta (n, 4) rad -> error (n, 4) Nm


def workspace_figure(path: Path, configured: ConfiguredArm, errors: Mapping[str, Error]) -> None:
    """Draw the RMSE over the elbow of joints 2 to 4 (rows) and each law (columns) over abduction and flexion."""
    box = zip(configured.low[1:], configured.high[1:], GRID, strict=True)
    axes = [np.linspace(low, high, n) for low, high, n in box]
    theta = np.array(list(product((0.0,), *axes)))
    degrees = [np.degrees(axis) for axis in axes]
    figure, grid = plt.subplots(3, len(errors), figsize=(3.2 * len(errors) + 1.6, 8.4), sharex=True, sharey=True)
    figure.set_layout_engine("constrained")
    for column, (name, error) in zip(grid.T, errors.items(), strict=True):
        values = rms(np.moveaxis(error(theta).reshape(*GRID, 4), 2, 0))
        for joint, axis in enumerate(column, start=2):
            shown = np.clip(values[..., joint - 1].T, FLOOR, CEILING)
            image = axis.pcolormesh(*degrees[:2], shown, norm=LogNorm(FLOOR, CEILING), cmap="viridis", rasterized=True)
            axis.set_title(f"{name}: joint {joint}", fontsize=10)
    for axis in grid[-1]:
        axis.set_xlabel("joint 2, abduction (degrees)")
    for axis in grid[:, 0]:
        axis.set_ylabel("joint 3, flexion (degrees)")
    figure.colorbar(image, ax=grid, label="RMSE over the elbow's range (Nm)", extend="min")
    figure.suptitle("Error against gravload over the workspace, trunk upright, configured centres of gravity")
    _save(figure, path)


def tilt_figure(path: Path, rows: Sequence[Row]) -> None:
    """Draw the RMSE of each law over the tilt limit: one column per joint, one row per set of centres of gravity."""
    rows = [row for row in rows if row.positions == "random" and row.reference == "gravload"]
    cogs = list(dict.fromkeys(row.cog for row in rows))
    figure, grid = plt.subplots(len(cogs), 4, figsize=(13, 6.4), sharex=True, sharey="col", squeeze=False)
    figure.set_layout_engine("constrained")
    for (cog, line), joint in product(zip(cogs, grid, strict=True), range(1, 5)):
        axis = line[joint - 1]
        for law, style in STYLES.items():
            chosen = [row for row in rows if (row.cog, row.joint, row.law) == (cog, joint, law)]
            label = f"{law} (at most {max(row.rmse for row in rows if row.law == law):.2g} Nm)"
            axis.plot([row.limit for row in chosen], [row.rmse for row in chosen], label=label, **style)
        axis.set_title(f"joint {joint}, CoGs {cog}", fontsize=10)
        axis.grid(alpha=0.3)
    for axis in grid[-1]:
        axis.set_xlabel("tilt up to (degrees)")
    for axis in grid[:, 0]:
        axis.set_ylabel("RMSE (Nm)")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(STYLES))
    figure.suptitle("Error against gravload over trunk tilt, random poses; the ANFIS was trained upright")
    _save(figure, path)


def baseline_figure(path: Path, rows: Sequence[Baseline]) -> None:
    """Draw each law's error inside and outside the training box, and each controller's cost for the wearer."""
    figure, (axis, below) = plt.subplots(2, figsize=(10, 7.5), layout="constrained")
    _burdens(below, [row for row in rows if not np.isnan(row.effort)])
    rows = [row for row in rows if not np.isnan(row.inside_rmse)]
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
    _save(figure, path)


def _burdens(axis: Axes, rows: Sequence[Baseline]) -> None:
    """Draw the wearer's effort and the sag after letting go."""
    place = np.arange(len(rows))
    for shift, values, colour, label in (
        (-0.27, [row.effort for row in rows], "tab:green", "effort of a reach, RMS in Nm"),
        (0.0, [np.degrees(row.sag) for row in rows], "tab:red", "largest sag after letting go, in degrees"),
        (0.27, [np.degrees(row.sag_bowed) for row in rows], "tab:purple", "the same, trunk bowed by 30 degrees"),
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


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=130)
    plt.close(figure)
