"""trial effort --offline: how hard the arm is to move, under every setting of the compensator.

A virtual wearer moves the simulated arm through 13 poses, a reach task and a sine sweep of each joint. A table, a
figure and a CSV file show the effort of each setting.
"""

from __future__ import annotations

import csv
from datetime import datetime
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from rich.table import Table

from exo_gravity.core.effort import Effort
from exo_gravity.core.errors import ParameterError
from exo_gravity.tools.cli.extras import extras
from exo_gravity.tools.reporting.colours import FAINT, JOINT_COLOURS

NAME = "effort"
BODY_MASS = 75.0  # kg, of a wearer that the parameter file does not give
JOINTS = ("rotation", "abduction", "flexion", "elbow")
# Figures of others, to compare with; the conditions differ.
ARMIN = "ARMin: weight compensation saved 26 % of the effort, mean of subjects (as the paper quotes it)"
HEAD = ("RMS of all joints (Nm)", "peak (Nm)", "work (W)", "jerk (rad/s^3)")

Rows = dict[tuple[str, str], Effort]  # by setting and task


def run(params: Path, output: Path, offline: bool, console: Console) -> int:
    """Run the study and write its results; return the exit code. Raises ParameterError."""
    if not offline:
        raise ParameterError("trial", NAME, "used with --offline: the effort of a person cannot be measured yet")
    with extras("trial", "sim"):
        from exo_gravity.tools.trials.simulated_effort import effort_study
    count, results = effort_study(params, BODY_MASS)
    quiet = not console.is_terminal
    rows: Rows = {}
    for setting, task, effort in track(results, "effort", count, console=console, transient=True, disable=quiet):
        rows[setting, task] = effort
    folder = output.resolve() / f"{NAME}_{datetime.now():%Y%m%d_%H%M%S}"
    folder.mkdir(parents=True)
    for task in ("reach", "poses"):
        console.print(_table(rows, task))
    console.print(_felt_table(rows))
    console.print(ARMIN, markup=False)
    _write_csv(rows, folder / "effort.csv")
    effort_figure(rows).savefig(folder / "effort.png", dpi=120)
    console.print(f"Table and figure: {folder}", markup=False, soft_wrap=True)
    return 0


def saved(rows: Rows, setting: str, task: str) -> float:
    """Return the share of the effort of `nothing` that a setting saves in a task."""
    return 1.0 - rows[setting, task].total / rows["nothing", task].total


def settings_of(rows: Rows) -> list[str]:
    """Return the names of the settings, in order."""
    return list(dict.fromkeys(setting for setting, _ in rows))


def _table(rows: Rows, task: str) -> Table:
    table = Table(title=f"{task}: the wearer's effort")
    for column in ("setting", *(f"{joint} RMS" for joint in JOINTS), *HEAD, "saved"):
        table.add_column(column, justify="left" if column == "setting" else "right")
    for setting in settings_of(rows):
        effort = rows[setting, task]
        numbers = [*effort.rms, effort.total, effort.peak.max(), effort.work]
        shown = [f"{value:.2f}" for value in numbers] + [
            f"{effort.jerk:.0f}",
            f"{100.0 * saved(rows, setting, task):.0f} %",
        ]
        table.add_row(setting, *shown)
    return table


def _felt_table(rows: Rows) -> Table:
    table = Table(title="sweeps, 0.1 to 2 Hz: reflected inertia (kg m^2) / Coulomb friction (Nm)")
    for column in ("setting", *JOINTS):
        table.add_column(column, justify="left" if column == "setting" else "right")
    for setting in settings_of(rows):
        felt = [rows[setting, f"sweep {n + 1}"].felt or (np.nan,) * 3 for n in range(4)]
        table.add_row(setting, *(f"{inertia:.3f} / {coulomb:.2f}" for inertia, coulomb, _ in felt))
    return table


def _write_csv(rows: Rows, path: Path) -> None:
    columns = ("rms", "peak")
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        heads = [f"{column}_{joint}_nm" for column in columns for joint in JOINTS]
        writer.writerow(
            ("setting", "task", *heads, "work_w", "jerk_rad_s3", "inertia_kg_m2", "coulomb_nm", "viscous_nm_s")
        )
        for (setting, task), effort in rows.items():
            felt = effort.felt or ("", "", "")
            writer.writerow((setting, task, *effort.rms, *effort.peak, effort.work, effort.jerk, *felt))


def effort_figure(rows: Rows) -> Figure:
    """Return the figure: RMS effort of each setting in the reach task and the poses, by joint."""
    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
    figure.suptitle("How hard the arm is to move: the wearer's torque", x=0.01, ha="left", weight="bold")
    names = settings_of(rows)
    places = np.arange(len(names))[::-1]
    for axis, task in zip(figure.subplots(1, 2, sharey=True), ("reach", "poses"), strict=True):
        left = np.zeros(len(names))
        squares = np.array([rows[name, task].rms ** 2 for name in names])
        totals = np.array([rows[name, task].total for name in names])
        for joint, colour in enumerate(JOINT_COLOURS):
            share = squares[:, joint] / totals  # the lengths add up to the root of the sum of squares
            axis.barh(places, share, left=left, color=colour, label=JOINTS[joint])
            left += share
        axis.axvline(0.5 * rows["Zero-G 100 %", task].total, color=FAINT, ls="--", lw=1.0, label="half of Zero-G")
        axis.set_yticks(places, names)
        axis.set_xlabel(f"{task}: RMS torque of all joints (Nm)")
        axis.spines[["top", "right"]].set_visible(False)
    figure.axes[0].legend(loc="lower right", edgecolor="none")
    return figure
