"""The tables of `validate` on the terminal, its rows as CSV, and its figures: error over workspace and trunk tilt."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import groupby, product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from exo_gravity.core.model.gravity import gravity_torque, paper_static_torque
from exo_gravity.tools.comparison.validation import Part, Row, Validation, rms
from exo_gravity.tools.inputs.paper import PAPER_ANALYTICAL, PAPER_ANFIS, PAPER_SECONDS
from exo_gravity.tools.inputs.references import gravload

FLOOR, CEILING = 1e-7, 1.0  # Nm, ends of the colour scale
FIGURE_GRID = (56, 56, 7)  # positions of joints 2, 3, 4 in the workspace figure
# Overlapping lines stay visible, because the wider ones are drawn first.
STYLES: dict[str, dict[str, Any]] = {
    "EQ2-EQ5": {"color": "tab:orange", "marker": "s", "linewidth": 4, "markersize": 7},
    "EQ1m-EQ4m": {"color": "tab:red", "marker": "D", "linewidth": 2},
    "ANFIS": {"color": "tab:blue", "marker": "^", "linestyle": "--"},
    "exact": {"color": "tab:green", "marker": "o"},
}

Torque = Callable[[np.ndarray], np.ndarray]  # theta (n, 4) rad -> torque (n, 4) Nm


def tables(validation: Validation) -> Iterator[str]:
    """Yield the lines of all tables."""
    yield from _law_table(validation.rows)
    yield "\nThe paper's comparison (d_n = l_n, g = 9.8 m/s^2, torques in Nm, not scaled)"
    yield from _paper_table(validation.link_ends)


def _paper_table(part: Part) -> Iterator[str]:
    """Yield the lines of the paper's comparison, its figures next to ours; part: with its assumption d_n = l_n."""
    ours = {
        name: [r.rmse for r in part.rows if (r.positions, r.law, r.reference) == ("workspace", name, "gravload")]
        for name in ("exact", "EQ2-EQ5")
    }
    seconds = f"{sum(result.seconds for result in part.trained):.1f} s for all three"
    yield f"{'RMSE against gravload in Nm':<34}{'joint 2':>10}{'joint 3':>10}{'joint 4':>10}   training"
    for name, values, training in (
        ("EQ3-EQ5, the paper", PAPER_ANALYTICAL, ""),
        ("EQ3-EQ5, here", ours["EQ2-EQ5"][1:], ""),
        ("exact law, here", ours["exact"][1:], ""),
        ("ANFIS, the paper", PAPER_ANFIS, f"{PAPER_SECONDS:.0f} s per joint"),
        ("ANFIS, here", part.law.error["training"], seconds),
        ("ANFIS, here, between the positions", part.law.error["held_out"], ""),
    ):
        yield f"{name:<34}{''.join(f'{value:>10.2e}' for value in values)}   {training}".rstrip()


def _law_table(rows: Iterable[Row]) -> Iterator[str]:
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


def write(validation: Validation, output: Path) -> list[str]:
    """Write the rows as CSV, one column per field in Nm (`limit` in degrees), and the figures; return the names."""
    rows, part = validation.rows, validation.as_configured
    with (output / "laws.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(asdict(rows[0])))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    arm, law = part.configured.robot, part.law
    torques: dict[str, Torque] = {
        "exact": lambda theta: gravity_torque(arm, theta),
        "EQ2-EQ5": lambda theta: paper_static_torque(arm, theta),
        "ANFIS": lambda theta: arm.gain * np.pad(law.torques(theta[:, 1:]), ((0, 0), (1, 0))),
    }
    _workspace_figure(part, torques).savefig(output / "workspace.png", dpi=130)
    _tilt_figure(rows).savefig(output / "tilt.png", dpi=130)
    return ["laws.csv", "workspace.png", "tilt.png"]


def _workspace_figure(part: Part, torques: Mapping[str, Torque]) -> Figure:
    """Draw the RMSE over the elbow of joints 2 to 4 (rows) and each law (columns) over abduction and flexion."""
    box = zip(part.configured.low[1:], part.configured.high[1:], FIGURE_GRID, strict=True)
    axes = [np.linspace(low, high, n) for low, high, n in box]
    theta = np.array(list(product((0.0,), *axes)))
    expected = gravload(part.configured.robot)(theta, np.tile((0.0, 0.0, 1.0), (len(theta), 1)))
    degrees = [np.degrees(axis) for axis in axes[:2]]
    figure = Figure(figsize=(3.2 * len(torques) + 1.6, 8.4), layout="constrained")
    grid = figure.subplots(3, len(torques), sharex=True, sharey=True)
    for column, (name, torque) in zip(grid.T, torques.items(), strict=True):
        error = (torque(theta) - expected).reshape(*FIGURE_GRID, 4)
        values = rms(np.moveaxis(error, 2, 0))
        for joint, axis in enumerate(column, start=2):
            shown = np.clip(values[..., joint - 1].T, FLOOR, CEILING)
            image = axis.pcolormesh(*degrees, shown, norm=LogNorm(FLOOR, CEILING), cmap="viridis", rasterized=True)
            axis.set_title(f"{name}: joint {joint}", fontsize=10)
    for axis in grid[-1]:
        axis.set_xlabel("joint 2, abduction (degrees)")
    for axis in grid[:, 0]:
        axis.set_ylabel("joint 3, flexion (degrees)")
    figure.colorbar(image, ax=grid, label="RMSE over the elbow's range (Nm)", extend="min")
    figure.suptitle("Error against gravload over the workspace, trunk upright, configured centres of gravity")
    return figure


def _tilt_figure(rows: Sequence[Row]) -> Figure:
    """Draw the RMSE of each law over the tilt limit: one column per joint, one row per set of centres of gravity."""
    rows = [row for row in rows if row.positions == "random" and row.reference == "gravload"]
    cogs = list(dict.fromkeys(row.cog for row in rows))
    figure = Figure(figsize=(13, 6.4), layout="constrained")
    grid = figure.subplots(len(cogs), 4, sharex=True, sharey="col", squeeze=False)
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
    return figure
