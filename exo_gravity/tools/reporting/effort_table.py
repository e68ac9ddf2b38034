"""The numbers of `trial effort`: tables on the terminal, CSV files, and a comparison with what others have measured."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rich.table import Table

from exo_gravity.core.effort import Effort
from exo_gravity.tools.reporting.table import shown

JOINTS = ("rotation", "abduction", "flexion", "elbow")
HEAD = ("all (Nm)", "saved", "peak (Nm)", "work (W)", "jerk (rad/s^3)", "in holds (Nm)")
NOTHING, ONE_G, ZERO_G = "nothing", "One-G", "Zero-G 100 %"

Content = tuple[str, list[str], list[list[str]]]  # title, heads and rows of a table


class EffortResults(NamedTuple):
    """efforts: by setting and task. workspaces: share of the grid reached, by setting and share of strength."""

    efforts: dict[tuple[str, str], Effort]
    workspaces: dict[tuple[str, float], float]

    @property
    def settings(self) -> list[str]:
        """The names of the settings, in order."""
        return list(dict.fromkeys(setting for setting, _ in self.efforts))

    @property
    def tasks(self) -> list[str]:
        """The names of the tasks, in order."""
        return list(dict.fromkeys(task for _, task in self.efforts))

    @property
    def strengths(self) -> list[float]:
        """The shares of strength, in order."""
        return sorted({share for _, share in self.workspaces})

    def saved(self, setting: str, task: str) -> float:
        """Return the share of the effort of `nothing` that a setting saves in a task, NaN if either is missing."""
        given = self.efforts.get((setting, task)), self.efforts.get((NOTHING, task))
        return 1.0 - given[0].total / given[1].total if given[0] and given[1] else math.nan


def contents(results: EffortResults) -> Iterator[Content]:
    """Yield the tables: the effort in each task, what sweeps feel, and the workspace of a weak arm."""
    for task in ("reach", "poses"):
        if task in results.tasks:
            yield _task_table(results, task)
    if "sweep 1" in results.tasks:
        yield _felt_table(results)
    if results.workspaces:
        yield _workspace_table(results)


def _task_table(results: EffortResults, task: str) -> Content:
    rows = []
    for setting in results.settings:
        if effort := results.efforts.get((setting, task)):
            saved = 100.0 * results.saved(setting, task)
            numbers = [shown(value, 2) for value in (*effort.rms, effort.total)]
            rest = [shown(effort.peak.max(), 2), shown(effort.work, 2), shown(effort.jerk, 0), shown(effort.held, 2)]
            rows.append([setting, *numbers, "–" if math.isnan(saved) else f"{saved:.0f} %", *rest])
    return f"{task}: the wearer's effort, RMS torque", ["setting", *(f"{joint} (Nm)" for joint in JOINTS), *HEAD], rows


def _felt_table(results: EffortResults) -> Content:
    rows = []
    for setting in results.settings:
        felt = [effort.felt if (effort := results.efforts.get((setting, f"sweep {n + 1}"))) else None for n in range(4)]
        rows.append([setting, *(f"{f[0]:.3f} / {f[1]:.2f}" if f else "-" for f in felt)])
    return "sweeps, 0.1 to 2 Hz: reflected inertia (kg m^2) / Coulomb friction (Nm)", ["setting", *JOINTS], rows


def _workspace_table(results: EffortResults) -> Content:
    names = list(dict.fromkeys(setting for setting, _ in results.workspaces))
    rows = [
        [name, *(f"{100.0 * results.workspaces[name, share]:.0f} %" for share in results.strengths)] for name in names
    ]
    heads = ["setting", *(f"{100.0 * share:.0f} % of the strength" for share in results.strengths)]
    return "workspace that a weak arm reaches", heads, rows


def rich_table(content: Content) -> Table:
    """Return a table for the terminal."""
    title, heads, rows = content
    table = Table(title=title)
    for n, head in enumerate(heads):
        table.add_column(head, justify="right" if n else "left")
    for row in rows:
        table.add_row(*row)
    return table


def comparisons(results: EffortResults) -> Iterator[str]:
    """Yield the measures of other devices, each with the same measure here; the conditions differ."""
    for task in ("reach", "poses"):
        if not math.isnan(results.saved(ZERO_G, task)):
            one, zero = (100.0 * results.saved(setting, task) for setting in (ONE_G, ZERO_G))
            yield (
                f"ARMin: weight compensation saved 26 % of the effort, mean of subjects (as the paper quotes it). "
                f"Here, {task}: One-G saves {one:.0f} %, Zero-G {zero:.0f} %."
            )
    if (ONE_G, 0.5) in results.workspaces:
        one, zero = (100.0 * results.workspaces[setting, 0.5] for setting in (ONE_G, ZERO_G))
        yield (
            "Freebal: support enlarges the workspace of a weak arm. Here, with half of the strength: "
            f"One-G {one:.0f} %, Zero-G {zero:.0f} %."
        )
    held = [
        results.efforts[setting, "poses"].held for setting in (ZERO_G, ONE_G) if (setting, "poses") in results.efforts
    ]
    if len(held) == 2:
        order = "the same order" if held[0] < held[1] else "another order"
        yield (
            "CyberForce: fatigue at rest = Zero-G < One-G. Here, effort while a pose is held: "
            f"rest 0, Zero-G {held[0]:.2f} Nm, One-G {held[1]:.2f} Nm: {order}."
        )


def write_csv(results: EffortResults, folder: Path) -> None:
    """Write effort.csv and, if it was measured, workspace.csv, in SI units."""
    with (folder / "effort.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        heads = [f"{column}_{joint}_nm" for column in ("rms", "peak") for joint in JOINTS]
        rest = ("work_w", "jerk_rad_s3", "inertia_kg_m2", "coulomb_nm", "viscous_nm_s", "held_nm")
        writer.writerow(("setting", "task", *heads, *rest))
        for (setting, task), effort in results.efforts.items():
            felt, held = effort.felt or ("", "", ""), "" if math.isnan(effort.held) else effort.held
            writer.writerow((setting, task, *effort.rms, *effort.peak, effort.work, effort.jerk, *felt, held))
    if results.workspaces:
        with (folder / "workspace.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(("setting", "strength", "reached"))
            writer.writerows((*key, share) for key, share in results.workspaces.items())
