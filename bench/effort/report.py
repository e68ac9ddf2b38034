# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The results of the study: tables, CSV files, a figure, and a comparison with what others have measured."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from exo_gravity.lab.report.html import FAINT, JOINT_COLOURS, make_plain

from .exertion import Exertion
from .study import NOTHING, ONE_G, ZERO_G

JOINTS = ("rotation", "abduction", "flexion", "elbow")


class Results(NamedTuple):
    """Everything that was measured."""

    #: By setting and task.
    exertions: dict[tuple[str, str], Exertion]
    #: Share of the grid that is reached, by setting and share of strength.
    workspaces: dict[tuple[str, float], float]

    @property
    def settings(self) -> list[str]:
        """The names of the settings, in order."""
        return list(dict.fromkeys(setting for setting, _ in self.exertions))

    def has(self, task: str) -> bool:
        """Return whether a task was performed."""
        return any(name == task for _, name in self.exertions)

    def saved(self, setting: str, task: str) -> float:
        """Return the per cent of the exertion of `nothing` that a setting saves in a task."""
        return 100.0 * (1.0 - self.exertions[setting, task].total / self.exertions[NOTHING, task].total)


def tables(results: Results) -> Iterator[Table]:
    """Yield the tables: the exertion in each task, what sweeps feel, and the workspace of a weak arm."""
    for task in filter(results.has, ("reach", "poses")):
        heads = [f"{name} (Nm)" for name in (*JOINTS, "all")]
        heads += ["saved", "peak (Nm)", "work (W)", "jerk (rad/s^3)", "in holds (Nm)"]
        table = _table(f"{task}: the wearer's exertion, RMS torque", heads)
        for setting in results.settings:
            found = results.exertions[setting, task]
            numbers = [f"{value:.2f}" for value in (*found.rms, found.total)]
            rest = f"{found.peak.max():.2f}", f"{found.work:.2f}", f"{found.jerk:.0f}", f"{found.held:.2f}"
            table.add_row(setting, *numbers, f"{results.saved(setting, task):.0f} %", *rest)
        yield table
    if results.has("sweep 1"):
        table = _table("sweeps, 0.1 to 2 Hz: reflected inertia (kg m^2) / Coulomb friction (Nm)", JOINTS)
        for setting in results.settings:
            table.add_row(setting, *(f"{felt[0]:.3f} / {felt[1]:.2f}" for felt in _felt_by_joint(results, setting)))
        yield table
    strengths = sorted({share for _, share in results.workspaces})
    table = _table(
        "workspace that a weak arm reaches", [f"{100.0 * share:.0f} % of the strength" for share in strengths]
    )
    for setting in dict.fromkeys(setting for setting, _ in results.workspaces):
        table.add_row(setting, *(f"{100.0 * results.workspaces[setting, share]:.0f} %" for share in strengths))
    yield table


def _table(title: str, heads: list[str] | tuple[str, ...]) -> Table:
    table = Table("setting", title=title)
    for head in heads:
        table.add_column(head, justify="right")
    return table


def _felt_by_joint(results: Results, setting: str) -> list[tuple[float, float, float]]:
    felt = [results.exertions[setting, f"sweep {joint}"].felt for joint in range(1, 5)]
    return [values for values in felt if values]


def comparisons(results: Results) -> Iterator[str]:
    """Yield the measures of other devices, each with the same measure here; the conditions differ."""
    for task in filter(results.has, ("reach", "poses")):
        one, zero = (results.saved(setting, task) for setting in (ONE_G, ZERO_G))
        yield (
            f"ARMin: weight compensation saved 26 % of the exertion, mean of subjects (as the paper quotes it). "
            f"Here, {task}: One-G saves {one:.0f} %, Zero-G {zero:.0f} %."
        )
    one, zero = (100.0 * results.workspaces[setting, 0.5] for setting in (ONE_G, ZERO_G))
    yield (
        "Freebal: support enlarges the workspace of a weak arm. Here, with half of the strength: "
        f"One-G {one:.0f} %, Zero-G {zero:.0f} %."
    )
    if results.has("poses"):
        zero, one = (results.exertions[setting, "poses"].held for setting in (ZERO_G, ONE_G))
        yield (
            "CyberForce: fatigue at rest = Zero-G < One-G. Here, exertion while a pose is held: "
            f"rest 0, Zero-G {zero:.2f} Nm, One-G {one:.2f} Nm: {'the same' if zero < one else 'another'} order."
        )


def write_csv(results: Results, folder: Path) -> None:
    """Write exertion.csv and workspace.csv, in SI units."""
    with (folder / "exertion.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        heads = [f"{column}_{joint}_nm" for column in ("rms", "peak") for joint in JOINTS]
        rest = ("work_w", "jerk_rad_s3", "inertia_kg_m2", "coulomb_nm", "viscous_nm_s", "held_nm")
        writer.writerow(("setting", "task", *heads, *rest))
        for key, found in results.exertions.items():
            felt, held = found.felt or ("", "", ""), "" if math.isnan(found.held) else found.held
            writer.writerow((*key, *found.rms, *found.peak, found.work, found.jerk, *felt, held))
    with (folder / "workspace.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("setting", "strength", "reached"))
        writer.writerows((*key, share) for key, share in results.workspaces.items())


def figure(results: Results) -> Figure:
    """Return the figure of all that was measured."""
    tasks = list(filter(results.has, ("reach", "poses")))
    result = Figure(figsize=(11.0, 9.6), layout="constrained")
    top, bottom = result.subfigures(2, 1, squeeze=False)[:, 0]
    for axis, task in zip(np.atleast_1d(top.subplots(1, len(tasks), sharey=True)), tasks, strict=True):
        _draw_task(axis, results, task)
    top.legend(*top.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, frameon=False, fontsize=9)
    felt, workspace = bottom.subplots(1, 2)
    if results.has("sweep 1"):
        inertia = np.array([[f[0] for f in _felt_by_joint(results, setting)] for setting in results.settings])
        _draw_lines(felt, results.settings, dict(zip(JOINTS, inertia.T, strict=True)))
    felt.set(ylabel="Reflected inertia (kg m²)", ylim=(0.0, None))
    names = list(dict.fromkeys(setting for setting, _ in results.workspaces))
    strengths = sorted({share for _, share in results.workspaces})
    reached = {
        f"{100 * share:.0f} % of its strength": np.array([100.0 * results.workspaces[name, share] for name in names])
        for share in strengths
    }
    _draw_lines(workspace, names, reached)
    workspace.set(ylabel="Workspace that a weak arm reaches (%)", ylim=(-3.0, 103.0))
    return result


def _draw_task(axis: Axes, results: Results, task: str) -> None:
    """Draw the RMS torque of each setting in a task, by joint; the parts add up to the root of the sum of squares."""
    names = results.settings
    places, left = np.arange(len(names))[::-1], np.zeros(len(names))
    totals = np.array([results.exertions[name, task].total for name in names])
    for joint, colour in enumerate(JOINT_COLOURS):
        share = np.array([results.exertions[name, task].rms[joint] ** 2 for name in names]) / totals
        axis.barh(places, share, left=left, color=colour, label=JOINTS[joint])
        left += share
    for place, total in zip(places, totals, strict=True):
        axis.annotate(
            f"{total:.2f}", (total, place), (3, 0), textcoords="offset points", va="center", fontsize=8,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
        )  # fmt: skip
    half = 0.5 * results.exertions[ZERO_G, task].total
    axis.axvline(half, color=FAINT, ls="--", lw=1.0, label="half of Zero-G")
    axis.set_yticks(places, names)
    axis.set_xlabel(f"{task.capitalize()}: RMS torque of all joints (Nm)")
    axis.margins(x=0.1)
    make_plain(axis)
    axis.grid(visible=False)


def _draw_lines(axis: Axes, names: list[str], lines: dict[str, np.ndarray]) -> None:
    """Draw lines over the settings `names`, each with its label above the axes."""
    for (label, values), colour in zip(lines.items(), JOINT_COLOURS, strict=False):
        axis.plot(values, "o-", color=colour, ms=4, lw=1.0, label=label)
    axis.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=8)
    axis.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, frameon=False, fontsize=9)
    make_plain(axis)
