# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The numbers of a report, in degrees: for the CSV files, for the page, and for the terminal."""

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from exo_gravity.lab.report import html
from exo_gravity.lab.trial.analysis import Hold, Motion, Recording, TrialAnalysis

Arm = tuple[Recording, TrialAnalysis]
Row = Mapping[str, Any]

UNMOVED = 1e-9  # rad; the means of equal positions differ by less


def per_minute(values: Any) -> Any:
    """Return rad/s in degrees per minute."""
    return 60.0 * np.degrees(values)


# From SI units
UNITS: dict[str, Callable[[Any], Any]] = {"deg": np.degrees, "deg/s": np.degrees, "deg/min": per_minute, "Nm": np.array}


class Quantity(NamedTuple):
    """A number of each joint in each hold or motion."""

    field: str  #: of Hold or Motion, (joints,)
    key: str  #: in the CSV file
    heading: str  #: with the unit in the second line
    digits: int  #: decimal places
    largest: bool = False  #: the terminal shows the largest of a row only
    spare: int = 0  #: a narrow terminal drops these, from the largest number on
    below: bool = False  #: a joint that read one position throughout a hold has "<" and its uncertainty

    def of(self, one: Any) -> np.ndarray:
        """Return the numbers (joints,) of a hold or motion in the column's unit."""
        return np.asarray(UNITS[self.heading.partition("\n")[2]](getattr(one, self.field)))

    def texts(self, one: Any) -> list[str]:
        """Return the numbers of a hold or motion as text."""
        texts = [shown(value, self.digits) for value in self.of(one)]
        if not self.below:
            return texts
        bounds = [shown(bound, self.digits) for bound in per_minute(one.drift_rate_uncertainty)]
        columns = zip(texts, bounds, one.stray < UNMOVED, strict=True)
        return [f"<{bound}".replace("<–", "–") if unmoved else text for text, bound, unmoved in columns]


class Kind(NamedTuple):
    """A table: its rows, what stands before the numbers of each, and the numbers."""

    name: str  #: of the field of `TrialAnalysis` with the rows, and of the CSV file
    title: str
    lead: Callable[[int, Any], dict[str, Any]]  #: number, and Hold or Motion -> the first columns of the CSV file
    headings: dict[str, str]  #: of those that page and terminal show too
    columns: tuple[Quantity, ...]

    def texts(self, number: int, one: Any) -> list[str]:
        """Return the first cells of a row, as page and terminal show them."""
        lead = self.lead(number, one)
        # An arm on its way down need not come to rest.
        unknown = "–" if lead.get("kind") == "let down" else "never"
        shared = (lead[key] for key in self.headings)
        return [str(x) if isinstance(x, str | int) else unknown if math.isnan(x) else shown(x, 1) for x in shared]


KINDS = (
    Kind(
        "holds",
        "Holds",
        lambda n, hold: {"hold": n, "start_s": hold.start, "duration_s": hold.duration, "after": hold.after},
        {"hold": "Hold", "start_s": "At\ns", "duration_s": "For\ns"},
        (
            Quantity("pose", "pose_deg", "Pose\ndeg", 1),
            Quantity("drift_rate", "drift_deg_per_min", "Drift\ndeg/min", 2, below=True),
            Quantity("drift_rate_uncertainty", "drift_uncertainty_deg_per_min", "±\ndeg/min", 2, largest=True),
            Quantity("drift", "drift_deg", "Total drift\ndeg", 2, spare=5),
            Quantity("stray", "stray_in_10_s_deg", "Within 10 s\ndeg", 2, largest=True, spare=1),
            Quantity("velocity_rms", "rms_velocity_deg_per_s", "RMS velocity\ndeg/s", 2, largest=True, spare=4),
            Quantity("torque_rms", "rms_torque_nm", "RMS torque\nNm", 2, spare=2),
            Quantity("torque_error", "torque_error_nm", "Torque error\nNm", 3, largest=True, spare=3),
        ),
    ),
    Kind(
        "motions",
        "Motions between holds",
        lambda n, one: {"motion": n, "kind": one.kind, "start_s": one.start, "until_still_s": one.until_still},
        {"kind": "Motion", "start_s": "At\ns", "until_still_s": "Still after\ns"},
        (
            Quantity("peak", "peak_deg", "Peak\ndeg", 1),
            Quantity("residual", "residual_deg", "Residual\ndeg", 1),
            Quantity("speed", "peak_speed_deg_per_s", "Peak speed\ndeg/s", 0, spare=1),
        ),
    ),
)
# What the columns mean
TERMS = {
    "Drift": "is the slope of a robust line (Huber) through the hold. Its uncertainty is at least one position code "
    "over the length of the hold. A joint that read one code throughout drifts less than that.",
    "Within 10 s": "is the widest range of a joint in any 10 s.",
    "RMS velocity": "is as the motors report it: at rest half a velocity code, 0.6 to 0.7 deg/s, since no code stands "
    "for zero.",
    "Torque error": "is the RMS of commanded minus measured torque.",
    "Residual": "is the pose after a motion minus the pose before it: feed-forward compensation has no stiffness, so a "
    "pushed arm stays where it was pushed.",
    "Let down": "is the way down under the motors' own damping, after a stop, a fault or the end of the trial: neither "
    "a hold nor a slip.",
}


def joint_labels(recording: Recording) -> list[str]:
    """Return readable joint names: without the arm's name, with spaces."""
    return [name.removeprefix(f"{recording.name}_").replace("_", " ") for name in recording.joint_names]


def shown(value: float, digits: int) -> str:
    """Return a readable number: a dash if unknown, and no minus sign on a rounded 0."""
    return f"{round(float(value), digits) + 0.0:.{digits}f}" if math.isfinite(value) else "–"


def unmoved(hold: Hold) -> str:
    """Say that no joint moved in a hold, and below what angle a motion would not show: one position code."""
    code = math.degrees(np.max(hold.drift_rate_uncertainty) * hold.duration)
    return "no measurable movement" + (f" (below {code:.3f} degrees)" if math.isfinite(code) else "")


def write_csv(folder: Path, kind: Kind, arms: Iterable[Arm], row_head: Callable[[str, float], Row]) -> list[Path]:
    """Write a table as CSV, a row for each joint; return its path. Without rows, write nothing.

    row_head: returns the first cells of a row, from the arm's name and the time in s.
    """
    rows = []
    for recording, analysis in arms:
        for number, one in enumerate(getattr(analysis, kind.name), 1):
            shared = {**row_head(recording.name, one.start), **kind.lead(number, one)}
            numbers = {column.key: column.of(one) for column in kind.columns}
            for joint, name in enumerate(recording.joint_names):
                rows.append({**shared, "joint": name, **{key: values[joint] for key, values in numbers.items()}})
    return write_rows(folder / f"{kind.name}.csv", rows)


def write_rows(path: Path, rows: Sequence[Row]) -> list[Path]:
    """Write rows of the same columns as CSV; return its path. Without rows, write nothing.

    An unknown number is an empty cell.
    """
    if not rows:
        path.unlink(missing_ok=True)  # of an earlier report
        return []
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        for row in rows:
            numbers = {key: f"{value:.6g}" for key, value in row.items() if isinstance(value, float | np.floating)}
            unknown = {key: "" for key, text in numbers.items() if text in ("nan", "inf", "-inf")}
            writer.writerow({**row, **numbers, **unknown})
    return [path]


def arm_section(recording: Recording, analysis: TrialAnalysis, figures: Iterable[str]) -> Iterator[str]:
    """Yield the page's section of one arm: its figures and tables."""
    yield html.heading(f"Arm: {recording.name}", 2)
    yield from figures
    if not analysis.holds:
        yield "<p>No hold was found.</p>"
    for kind in KINDS:
        groups = []
        for number, one in enumerate(getattr(analysis, kind.name), 1):
            cells = [column.texts(one) for column in kind.columns]
            groups.append((kind.texts(number, one), list(zip(joint_labels(recording), *cells, strict=True))))
        if groups:
            yield html.heading(kind.title)
            yield html.table(
                (*kind.headings.values(), "", *(column.heading for column in kind.columns)), groups, "joints"
            )


def print_tables(console: Console, recording: Recording, analysis: TrialAnalysis) -> None:
    """Print the holds and motions of one arm; a cell holds the joints in order.

    Where the table is wider than the console, spare columns are left out: they are in the CSV files.
    """
    console.print(f"\n[bold]{recording.name}[/], joints in order: {', '.join(joint_labels(recording))}")
    for kind in KINDS:
        rows = [one for one in getattr(analysis, kind.name) if getattr(one, "kind", "") != "move"]
        if not rows:
            continue
        shared = zip(*(kind.texts(number, one) for number, one in enumerate(rows, 1)), strict=True)
        cells: dict[str, Sequence[str]] = dict(zip(kind.headings.values(), shared, strict=True))
        cells |= {column.heading: _cells(rows, column) for column in kind.columns}
        for column in sorted(kind.columns, key=lambda column: -column.spare):
            used = sum(2 + max(map(len, (*head.split("\n"), *texts))) for head, texts in cells.items())
            if used > console.width and column.spare:
                del cells[column.heading]
        print_table(console, cells, zip(*cells.values(), strict=True), justify="right", no_wrap=True)


def print_table(
    console: Console, heads: Iterable[str], rows: Iterable[Sequence[str]], title: str | None = None, **column: Any
) -> None:
    """Print a table of texts. column: how each column is set, as rich has it."""
    columns = (Column(escape(head), **column) for head in heads)
    table = Table(
        *columns, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=title, title_justify="left"
    )
    for row in rows:
        table.add_row(*map(escape, row))
    console.print(table)


def _cells(rows: Sequence[Hold | Motion], column: Quantity) -> list[str]:
    """Return one cell per row: its largest number, or those of all joints, aligned with those of the other rows."""
    if column.largest:
        known = ([value for value in column.of(row) if math.isfinite(value)] for row in rows)
        return [shown(max(values, default=math.nan), column.digits) for values in known]
    texts = [column.texts(row) for row in rows]
    width = max(len(text) for row in texts for text in row)
    return [" ".join(text.rjust(width) for text in row) for row in texts]
