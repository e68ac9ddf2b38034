# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What many trials show together: each condition over its wearers, conditions compared in the same wearers, a page.

A condition is an arm under one protocol, mode and support, or what of these the caller chooses, simulated or real. A
session is a day.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, combinations, groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from scipy import stats

from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.report import html
from exo_gravity.lab.report.cohort import Row
from exo_gravity.lab.report.table import print_table, shown
from exo_gravity.lab.report.trial_report import MODES

LEGEND = 10  # lines at most that a figure names
KEYS = ("protocol", "mode", "support")  # of a row, what may make a condition
HEADINGS = (
    "Subject", "Condition", "Date", "Recording", "Source", "Holds", "Drift\ndeg/min", "Within 10 s\ndeg",
    "In a step\ndeg", "Range\ndeg", "SPARC", "Share\n%", "Verdict",
)  # fmt: skip
TERMS = (
    "Drift, movements and range of motion are those of the joint that moved most. Drift and movement within 10 s are "
    "those of an arm that is still; in a scripted hold, from release to its end, it may also sink or fall. The drift "
    "has its standard uncertainty, and one of 0 is less than that. SPARC is the smoothness of the moves from pose to "
    "pose: a single bell-shaped movement has about -1.4, a jerky one less. Share is what the wearer carried of their "
    "arm's weight."
)
METHOD = (
    "Each wearer counts once in a condition, by the mean of their trials; among recordings of one wearer, or without "
    "codes, each recording counts, which says nothing of other people. SD and the 95 % interval of the mean (Student's "
    "t) are between wearers. Two conditions are compared in the wearers who have both, by the paired t test: each is "
    "their own control, and with fewer than six of them a rank test (Wilcoxon's) cannot fall below 0.05. It assumes "
    "that the differences are about normal: look at the lines of the figure. Holm's method corrects p for the number "
    "of comparisons of a measure."
)


class Measure(NamedTuple):
    """A number of a trial."""

    key: str  #: of a row
    name: str
    unit: str
    digits: int
    factor: float = 1.0  #: from the row's number to the unit

    def of(self, row: Row) -> float:
        """Return the number in its unit, NaN if it is unknown."""
        value = row[self.key]
        return math.nan if value is None else self.factor * value


MEASURES = (
    Measure("drift_deg_per_min", "drift", "deg/min", 2),
    Measure("stray_in_10_s_deg", "movement within 10 s", "deg", 2),
    Measure("moved_in_step_deg", "movement in a scripted hold", "deg", 2),
    Measure("range_of_motion_deg", "range of motion", "deg", 1),
    Measure("smoothness_sparc", "smoothness (SPARC)", "", 2),
    Measure("wearer_share", "wearer's share", "%", 1, 100.0),
)


class Condition(NamedTuple):
    """What trials have in common."""

    arm: str
    source: str
    settings: tuple[str, ...]

    @classmethod
    def of(cls, row: Row, keys: Iterable[str] = KEYS) -> "Condition":
        """Return the condition of a trial."""
        support = "" if row["support"] is None else f"support {100.0 * row['support']:g} %"
        words = {"protocol": row["protocol"], "mode": MODES.get(row["mode"], "unknown mode"), "support": support}
        return cls(row["arm"] or "", row["source"] or "", tuple(words[key] for key in keys if words[key]))

    def __str__(self) -> str:
        """Return the condition in words."""
        return ", ".join((self.arm, *self.settings, *[self.source] * (self.source == Source.SIMULATED.value)))


Values = Mapping[Condition, Mapping[str, float]]
Cells = tuple[str, Sequence[str], Sequence[Sequence[str]]]  # title, headings and cells of a table


def values_of(trials: Iterable[Row], measure: Measure, keys: Sequence[str] = KEYS) -> Values:
    """Return a measure, in its unit, by condition and wearer, or recording: see METHOD. trials: by `trials_of`."""
    read = [row for row in trials if row["verdict"] and math.isfinite(measure.of(row))]
    is_study = len({row["subject"] for row in read}) > 1
    found: dict[Condition, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in read:
        who = (is_study and row["subject"]) or row["recording"]
        found[Condition.of(row, keys)][who].append(measure.of(row))
    return {key: {who: float(np.mean(x)) for who, x in found[key].items()} for key in sorted(found)}


def spread(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean of values (n,), their SD, and half of the mean's 95 % interval: NaN of fewer than two."""
    count = len(values)
    deviation = float(np.std(values, ddof=1)) if count > 1 else math.nan
    return float(np.mean(values)), deviation, float(stats.t.ppf(0.975, count - 1)) * deviation / math.sqrt(count)


def statistics(trials: Sequence[Row], keys: Sequence[str] = KEYS) -> Iterator[Row]:
    """Yield count, mean, SD and 95 % interval of each condition and measure."""
    for measure in MEASURES:
        for condition, of_wearers in values_of(trials, measure, keys).items():
            yield {"condition": str(condition), **_numbers(measure, [*of_wearers.values()])}


def differences(trials: Sequence[Row], keys: Sequence[str] = KEYS) -> Iterator[Row]:
    """Yield the paired differences of two conditions of an arm, in at least two wearers who have both."""
    for measure in MEASURES:
        rows = []
        for (one, before), (other, after) in combinations(values_of(trials, measure, keys).items(), 2):
            both = [who for who in before if who in after]
            if one[:2] == other[:2] and len(both) > 1:
                away = np.array([after[who] - before[who] for who in both])
                p = float(stats.ttest_1samp(away, 0.0).pvalue) if np.ptp(away) else math.nan
                rows.append({"from": str(one), "to": str(other), **_numbers(measure, away.tolist()), "p": p})
        order = np.argsort([row["p"] for row in rows])  # NaN is last
        left = np.count_nonzero(np.isfinite([row["p"] for row in rows])) - np.arange(len(rows))
        holm = np.minimum(1.0, np.maximum.accumulate([rows[n]["p"] for n in order] * left))
        for n, p in zip(order, holm.tolist(), strict=True):
            rows[n]["p_holm"] = p
        yield from rows


def _numbers(measure: Measure, values: Sequence[float]) -> Row:
    mean, deviation, half = spread(values)
    of_what = {"measure": measure.name, "unit": measure.unit, "n": len(values)}
    return {**of_what, "mean": mean, "sd": deviation, "low_95": mean - half, "high_95": mean + half}


def trials_of(rows: Iterable[Row]) -> list[Row]:
    """Return a row for each recording and arm, by subject and condition in order of date: the largest of its joints."""
    result = []
    for _, group in groupby(rows, lambda row: (row["recording"], row["arm"])):
        joints = list(group)
        trial = dict(joints[0])
        for key in ("drift_deg_per_min", "stray_in_10_s_deg", "moved_in_step_deg", "range_of_motion_deg"):
            largest = max(joints, key=lambda row: abs(row[key] or 0.0))
            trial[key] = largest[key] and abs(largest[key])
            if key == "drift_deg_per_min":
                trial["drift_uncertainty_deg_per_min"] = largest["drift_uncertainty_deg_per_min"]
        result.append(trial)
    return sorted(result, key=lambda row: (row["subject"] or "", Condition.of(row), str(row["date"])))


def _series_of(trials: Iterable[Row], keys: Sequence[str]) -> Iterator[tuple[str, list[Row], np.ndarray]]:
    """Yield each subject's condition in words, its trials that could be read, and the session of each from 1 on."""
    groups: dict[tuple[str, Condition], list[Row]] = defaultdict(list)
    for row in trials:
        if row["verdict"]:
            groups[row["subject"] or "no subject", Condition.of(row, keys)].append(row)
    for (subject, condition), rows in sorted(groups.items()):
        days = np.unique([row["date"][:10] for row in rows], return_inverse=True)[1]
        yield f"{subject}, {condition}", rows, np.asarray(days) + 1


def _cells(row: Row) -> list[str]:
    """Return the cells below HEADINGS; a dash where a number is unknown."""
    drift, stray, moved, reach, sparc, share = (
        "–" if row[one.key] is None else shown(one.of(row), one.digits) for one in MEASURES
    )
    if (uncertainty := row["drift_uncertainty_deg_per_min"]) is not None:
        drift = f"{drift} ± {uncertainty:.2f}" if row["drift_deg_per_min"] > uncertainty else f"<{uncertainty:.2f}"
    condition = str(Condition.of(row)) if row["verdict"] else ""
    texts = row["subject"], condition, row["date"], "/".join(Path(row["recording"]).parts[-2:]), row["source"]
    numbers = "" if row["holds"] is None else str(row["holds"]), drift, stray, moved, reach, sparc, share
    return [*(text or "" for text in texts), *numbers, row["verdict"] or row["problem"]]


def tables_of(trials: Sequence[Row], conditions: Sequence[Row], compared: Sequence[Row]) -> list[Cells]:
    """Return the tables of a study: its statistics, as `statistics` and `differences` give them, and all trials."""
    tables: list[Cells] = []
    for title, rows in (("Conditions", conditions), ("Paired differences", compared)):
        if rows:
            cells = [[f"{x:#.4g}" if isinstance(x, float) else str(x) for x in row.values()] for row in rows]
            tables.append((title, [*rows[0]], cells))
    return [*tables, ("Trials", HEADINGS, [*map(_cells, trials)])]


def problems_of(trials: Iterable[Row]) -> list[str]:
    """Return why recordings, or parts of them, could not be read: a sentence for each recording."""
    return [*{row["recording"]: row["problem"] for row in trials if row["problem"]}.values()]


def summary_of(trials: Sequence[Row]) -> str:
    """Return how many trials held."""
    read = [row for row in trials if row["verdict"]]
    rest = f"; recordings not read, or not completely: {len(found)}" if (found := problems_of(trials)) else ""
    return f"{sum(row['held'] for row in read)} of {len(read)} trials held{rest}"


def print_trials(trials: Sequence[Row], tables: Iterable[Cells], console: Console) -> None:
    """Print the tables of `tables_of`, and what failed."""
    for title, heads, cells in tables:
        print_table(console, heads, cells, title)
    for problem in problems_of(trials):
        console.print(f"Not reported: {problem}", markup=False)


def page(trials: Sequence[Row], name: str, tables: Iterable[Cells], png: bytes) -> str:
    """Return the trials as an HTML page. name: of the cohort. tables: by `tables_of`. png: the picture of `figure`."""
    read = [row for row in trials if row["verdict"]]
    problems = problems_of(trials)
    dates = sorted(row["date"][:10] for row in read)
    subjects = {row["subject"] for row in read}
    when = f"{len(read)} trials, {len(subjects)} subjects, {' to '.join(sorted({*dates[:1], *dates[-1:]}))}"
    caption = (
        "Left, each condition: mean and 95 % interval, and a line for each wearer. Right, if there are several days, "
        "each wearer and condition over them."
    )
    return html.document(
        name,
        when,
        [
            html.verdict(
                f"{summary_of(trials)}.", good=bool(read) and all(row["held"] for row in read) and not problems
            ),
            html.bullets("Not reported", problems),
            html.picture(png, caption) if png else "",
            *chain.from_iterable(
                (html.heading(title, 2), html.table(heads, [((), cells)])) for title, heads, cells in tables
            ),
            f"<footer><p>{TERMS}</p><p>{METHOD}</p></footer>",
        ],
    )


def figure(trials: Sequence[Row], keys: Sequence[str]) -> Figure | None:
    """Return the measures by condition, and over sessions where a wearer has several; None if nothing was measured."""
    series = [one for one in _series_of(trials, keys) if one[2][-1] > 1]
    measured = {measure: found for measure in MEASURES if (found := values_of(trials, measure, keys))}
    if not measured:
        return None
    drawn = Figure(figsize=(12.0, 2.6 * len(measured)), layout="constrained")
    axes: Any = drawn.subplots(len(measured), 1 + bool(series), sharex="col", squeeze=False)
    for row, (measure, groups) in zip(axes, measured.items(), strict=True):
        for who in {who: None for group in groups.values() for who in group}:
            line = [group.get(who, np.nan) for group in groups.values()]
            row[0].plot(line, "o-", ms=3, lw=0.8, color=html.FAINT, zorder=1)
        for place, group in enumerate(groups.values()):
            mean, _, half = spread([*group.values()])
            look = {"fmt": "D", "ms": 6, "lw": 1.6, "capsize": 4, "color": html.JOINT_COLOURS[0], "zorder": 2}
            row[0].errorbar(place, mean, half, **look)
        row[0].set_xlim(-0.5, len(groups) - 0.5)
        row[0].set_ylabel(f"{measure.name}\n{measure.unit}")
        for (name, rows, session), colour in zip(series, html.joint_colours(len(series)), strict=True):
            values = np.array([measure.of(one) for one in rows])
            known = np.isfinite(values)
            days = np.unique(session[known])
            row[1].plot(session, values, "o", ms=4, color=colour, alpha=0.6)
            row[1].plot(days, [values[known & (session == d)].mean() for d in days], color=colour, lw=1.2, label=name)
        for axis in row:
            axis.ticklabel_format(axis="y", useOffset=False)
            html.make_plain(axis)
    drawn.align_ylabels()
    row[0].set_xticks(range(len(groups)), [str(condition).replace(", ", "\n") for condition in groups])
    if series:
        row[1].set_xlabel("Session")
        row[1].xaxis.get_major_locator().set_params(integer=True)
    if 0 < len(series) <= LEGEND:
        axes[0, 1].legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=2, frameon=False, fontsize=9)
    return drawn
