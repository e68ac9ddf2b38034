# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What many trials show together: a table, the trend of each subject over their sessions, and a page with both.

A session is a day. Trials of one subject, arm, mode and support, all real or all simulated, are compared with each
other, and with no others.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.stats import linregress

from exo_gravity.lab.report import html
from exo_gravity.lab.report.cohort import Row
from exo_gravity.lab.report.table import shown
from exo_gravity.lab.report.trial_report import MODES

LEAST_SESSIONS = 3  # for a trend
LEGEND = 10  # lines at most that a figure names


class Measure(NamedTuple):
    """A number of a trial that may change from session to session."""

    key: str  #: of a row
    name: str
    unit: str
    digits: int
    factor: float = 1.0  #: from the row's number to the unit


MEASURES = (
    Measure("drift_deg_per_min", "drift", " deg/min", 2),
    Measure("range_of_motion_deg", "range of motion", " deg", 1),
    Measure("smoothness_sparc", "smoothness (SPARC)", "", 2),
    Measure("wearer_share", "wearer's share", " %", 1, 100.0),
)
HEADINGS = (
    "Date", "Recording", "Arm", "Source", "Holds", "Drift\ndeg/min", "Within 10 s\ndeg", "Range\ndeg", "SPARC",
    "Share\n%", "Verdict",
)  # fmt: skip
TEXTS = 4  # of them, the others are numbers
TERMS = (
    "Drift, movement within 10 s and range of motion are those of the joint that moved most. SPARC is the smoothness "
    "of the moves from pose to pose: a single bell-shaped movement has about -1.4, a jerky one less. Share is what the "
    "wearer carried of their arm's weight."
)


def trials_of(rows: Iterable[Row]) -> list[Row]:
    """Return a row for each recording and arm, by subject and condition in order of date: the largest of its joints."""
    result = []
    for _, group in groupby(rows, lambda row: (row["recording"], row["arm"])):
        joints = list(group)
        largest = {
            key: max((abs(row[key]) for row in joints if row[key] is not None), default=None)
            for key in ("drift_deg_per_min", "stray_in_10_s_deg", "range_of_motion_deg")
        }
        result.append({**joints[0], **largest})
    return sorted(result, key=lambda row: (*_condition(row), str(row["date"])))


def _condition(row: Row) -> tuple[str, ...]:
    return tuple("" if row[key] is None else str(row[key]) for key in ("subject", "source", "mode", "support", "arm"))


def conditions_of(trials: Iterable[Row]) -> Iterator[tuple[str, list[Row]]]:
    """Yield each condition in words, with its trials (see `trials_of`) that could be read."""
    read = (row for row in trials if row["verdict"])
    for _, group in groupby(read, _condition):
        rows = list(group)
        yield f"{rows[0]['subject'] or 'no subject'}, {rows[0]['arm']}, {_settings(rows[0])}", rows


def _settings(row: Row) -> str:
    support = "" if row["support"] is None else f", support {100.0 * row['support']:g} %"
    return f"{MODES.get(row['mode'], 'unknown mode')}{support}"


def sessions_of(rows: Sequence[Row]) -> np.ndarray:
    """Return the number of the session of each trial, (n,), from 1 on."""
    days = np.unique([row["date"][:10] for row in rows], return_inverse=True)[1]
    return np.asarray(days) + 1


def _values(rows: Iterable[Row], measure: Measure) -> np.ndarray:
    """Return a measure of each trial in its unit, (n,), NaN where unknown."""
    found = (row[measure.key] for row in rows)
    return measure.factor * np.array([math.nan if value is None else value for value in found])


def trends_of(trials: Iterable[Row]) -> Iterator[str]:
    """Yield how the measures of each condition with LEAST_SESSIONS or more change, with their standard errors."""
    for condition, rows in conditions_of(trials):
        session, changes = sessions_of(rows), []
        for one in MEASURES:
            values = _values(rows, one)
            known = np.isfinite(values)
            if len(np.unique(session[known])) >= LEAST_SESSIONS:
                line = linregress(session[known], values[known])
                changes.append(f"{one.name} {line.slope:+.{one.digits}f} ± {line.stderr:.{one.digits}f}{one.unit}")
        if changes:
            yield f"{condition}: change from one of {session[-1]} sessions to the next: {', '.join(changes)}"


def _cells(row: Row) -> list[str]:
    """Return the cells below HEADINGS; a dash where a number is unknown."""
    share = None if row["wearer_share"] is None else 100.0 * row["wearer_share"]
    numbers = (
        (row["drift_deg_per_min"], 2), (row["stray_in_10_s_deg"], 2), (row["range_of_motion_deg"], 0),
        (row["smoothness_sparc"], 2), (share, 0),
    )  # fmt: skip
    texts = (row["date"], "/".join(Path(row["recording"]).parts[-2:]), row["arm"], row["source"], row["holds"])
    return [
        *("" if text is None else str(text) for text in texts),
        *("–" if number is None else shown(number, digits) for number, digits in numbers),
        row["verdict"] or row["problem"],
    ]


def problems_of(trials: Iterable[Row]) -> list[str]:
    """Return why recordings, or parts of them, could not be read: a sentence for each recording."""
    return [*{row["recording"]: row["problem"] for row in trials if row["problem"]}.values()]


def summary_of(trials: Sequence[Row]) -> str:
    """Return how many trials held."""
    read = [row for row in trials if row["verdict"]]
    unread = len(problems_of(trials))
    rest = f"; recordings not read, or not completely: {unread}" if unread else ""
    return f"{sum(row['held'] for row in read)} of {len(read)} trials held{rest}"


def print_trials(trials: Sequence[Row], console: Console) -> None:
    """Print a table with a row for each trial, the trends, what failed, and how many held."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in ("Subject", "Condition", *HEADINGS[:TEXTS]):
        table.add_column(heading)
    for heading in HEADINGS[TEXTS:-1]:
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column(HEADINGS[-1])
    for row in trials:
        condition = _settings(row) if row["verdict"] else ""
        table.add_row(*(escape(text) for text in (row["subject"] or "", condition, *_cells(row))))
    console.print(table)
    for trend in trends_of(trials):
        console.print(f"{trend}.", markup=False)
    for problem in problems_of(trials):
        console.print(f"Not reported: {problem}", markup=False)


def page(trials: Sequence[Row], name: str) -> str:
    """Return the trials as an HTML page. name: of the cohort."""
    read = [row for row in trials if row["verdict"]]
    problems = problems_of(trials)
    subjects = len({row["subject"] for row in read})
    dates = sorted(row["date"][:10] for row in read)
    when = f"{len(read)} trials, {subjects} subjects, {' to '.join(sorted({*dates[:1], *dates[-1:]}))}"
    groups = []
    for _, rows in conditions_of(trials):
        shared = (rows[0]["subject"] or "no subject", _settings(rows[0]))
        groups.append((shared, [_cells(row) for row in rows]))
    drawn = figure(trials)
    held = all(row["held"] for row in read)
    return html.document(
        name,
        when,
        [
            html.verdict(f"{summary_of(trials)}.", good=bool(read) and held and not problems),
            html.bullets("Not reported", problems),
            html.bullets("Trends, with standard errors", trends_of(trials)),
            html.picture(html.png_of(drawn), "Each subject and condition over their sessions.") if drawn else "",
            html.heading("Trials", 2),
            html.table(("Subject", "Condition", *HEADINGS), groups),
            f"<footer><p>{TERMS}</p></footer>",
        ],
    )


def figure(trials: Sequence[Row]) -> Figure | None:
    """Return the measures over the sessions, a line for each condition; None where nobody has two sessions."""
    series = [(name, rows, sessions_of(rows)) for name, rows in conditions_of(trials)]
    series = [(name, rows, session) for name, rows, session in series if session[-1] > 1]
    measures = [m for m in MEASURES if any(np.isfinite(_values(rows, m)).any() for _, rows, _ in series)]
    if not measures:
        return None
    drawn = Figure(figsize=(12.0, 2.6 * len(measures)), layout="constrained")
    axes: Any = drawn.subplots(len(measures), 1, sharex=True, squeeze=False)[:, 0]
    colours = html.joint_colours(len(series))
    for axis, measure in zip(axes, measures, strict=True):
        for (name, rows, session), colour in zip(series, colours, strict=True):
            values = _values(rows, measure)
            known = np.isfinite(values)
            days = np.unique(session[known])
            means = [values[known & (session == day)].mean() for day in days]
            axis.plot(session, values, "o", ms=4, color=colour, alpha=0.6)
            axis.plot(days, means, color=colour, lw=1.2, label=name)
        axis.set_ylabel(f"{measure.name}\n{measure.unit.strip()}")
        html.make_plain(axis)
    axes[-1].set_xlabel("Session")
    axes[-1].xaxis.get_major_locator().set_params(integer=True)
    if len(series) <= LEGEND:
        axes[0].legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=2, frameon=False, fontsize=9)
    return drawn
