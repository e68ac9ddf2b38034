"""The figure and the HTML page of `trial effort`."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from exo_gravity.tools.reporting import html
from exo_gravity.tools.reporting.colours import FAINT, JOINT_COLOURS, make_plain
from exo_gravity.tools.reporting.effort_table import JOINTS, ZERO_G, EffortResults, comparisons, contents

CAPTION = (
    "The wearer's torque in each task by joint (top, parts add up to the root of the sum of squares), the inertia and "
    "friction that he feels in the sweeps, and the share of the workspace that a weak arm reaches."
)
TERMS = {
    "How it is measured:": "a virtual wearer, an impedance controller, moves the simulated arm.",
    "Saved": "compares with motors without torque.",
    "In holds": "is the RMS torque while a pose is held.",
    "Reflected inertia": "and friction are what a sine sweep of one joint feels.",
}


def write_page(results: EffortResults, folder: Path, when: datetime, how: str) -> None:
    """Write effort.png and report.html into `folder`; how: one line on how the efforts were measured."""
    png = html.png_of(effort_figure(results), 120)
    (folder / "effort.png").write_bytes(png)
    body = [html.picture(png, CAPTION)]
    body += [html.heading(title) + html.table(heads, rows) for title, heads, rows in contents(results)]
    body += [html.bullets("Measures of other devices, and the same measure here", comparisons(results))]
    body += [html.explained(TERMS)]
    title = "How hard the arm is to move"
    (folder / "report.html").write_text(html.document(title, f"{when:%Y-%m-%d %H:%M}, {how}", body), encoding="utf-8")


def effort_figure(results: EffortResults) -> Figure:
    """Return the figure of all that was measured."""
    tasks = [task for task in ("reach", "poses") if task in results.tasks]
    below = ["felt"] * ("sweep 1" in results.tasks) + ["workspace"] * bool(results.workspaces)
    figure = Figure(figsize=(11.0, 5.0 + 4.2 * bool(below)), layout="constrained")
    figure.suptitle("How hard the arm is to move", x=0.01, ha="left", weight="bold")
    top, *rest = figure.subfigures(1 + bool(below), 1, squeeze=False)[:, 0]
    for axis, task in zip(np.atleast_1d(top.subplots(1, len(tasks), sharey=True)), tasks, strict=True):
        _efforts(axis, results, task)
    top.axes[0].legend(loc="lower right", edgecolor="none", fontsize=8)
    if below:
        axes = dict(zip(below, np.atleast_1d(rest[0].subplots(1, len(below))), strict=True))
        if "felt" in axes:
            _felt(axes["felt"], results)
        if "workspace" in axes:
            _workspace(axes["workspace"], results)
    return figure


def _efforts(axis: Axes, results: EffortResults, task: str) -> None:
    """Draw the RMS effort of each setting in a task, by joint."""
    names = results.settings  # those without this task too, because the panels share an axis
    places, left = np.arange(len(names))[::-1], np.zeros(len(names))
    missing = np.full(4, np.nan)
    found = [results.efforts.get((name, task)) for name in names]
    squares = np.array([effort.rms**2 if effort else missing for effort in found])
    totals = np.sqrt(squares.sum(axis=1))
    for joint, colour in enumerate(JOINT_COLOURS):
        share = squares[:, joint] / totals  # the lengths add up to the root of the sum of squares
        axis.barh(places, share, left=left, color=colour, label=JOINTS[joint])
        left += share
    for place, total in zip(places[~np.isnan(totals)], totals[~np.isnan(totals)], strict=True):
        axis.annotate(f"{total:.2f}", (total, place), (3, 0), textcoords="offset points", va="center", fontsize=8)
    if (ZERO_G, task) in results.efforts:
        half = 0.5 * results.efforts[ZERO_G, task].total
        axis.axvline(half, color=FAINT, ls="--", lw=1.0, label="half of Zero-G")
    axis.set_yticks(places, names)
    axis.set_xlabel(f"{task}: RMS torque of all joints (Nm)")
    axis.margins(x=0.1)
    axis.spines[["top", "right"]].set_visible(False)


def _felt(axis: Axes, results: EffortResults) -> None:
    """Draw the reflected inertia of each joint under each setting, and its Coulomb friction."""
    names = [name for name in results.settings if (name, "sweep 1") in results.efforts]
    place = np.arange(len(names))
    for joint, colour in enumerate(JOINT_COLOURS):
        felt = [
            effort.felt if (effort := results.efforts.get((name, f"sweep {joint + 1}"))) else None for name in names
        ]
        inertia = [f[0] if f else np.nan for f in felt]
        axis.plot(place, inertia, "o-", color=colour, ms=4, lw=1.0, label=JOINTS[joint])
    axis.set_xticks(place, names, rotation=60, ha="right", fontsize=8)
    axis.set_ylabel("reflected inertia (kg m²)")
    axis.legend(edgecolor="none", fontsize=8)
    make_plain(axis)


def _workspace(axis: Axes, results: EffortResults) -> None:
    """Draw the share of the workspace that a weak arm reaches, against the setting."""
    names: Sequence[str] = list(dict.fromkeys(setting for setting, _ in results.workspaces))
    for share, colour in zip(results.strengths, JOINT_COLOURS, strict=False):
        values = [100.0 * results.workspaces[name, share] for name in names]
        axis.plot(values, "o-", color=colour, ms=4, lw=1.2, label=f"{100.0 * share:.0f} % of the strength")
    axis.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=8)
    axis.set_ylabel("workspace reached by a weak arm (%)")
    axis.set_ylim(-3.0, 103.0)
    axis.legend(edgecolor="none", fontsize=8)
    make_plain(axis)
