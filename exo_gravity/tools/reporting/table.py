"""The numbers of a report, in degrees: for the CSV files, for the page, and for the terminal."""

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from exo_gravity.core.trial.analysis import Hold, Motion, TrialAnalysis
from exo_gravity.core.trial.recording import Recording
from exo_gravity.tools.reporting import html

ROWS = 100_000  # of a time series, that are written at once
UNMOVED = 1e-9  # rad; the means of equal positions differ by less


def per_minute(values: Any) -> Any:
    """Return rad/s in degrees per minute."""
    return 60.0 * np.degrees(values)


class Column(NamedTuple):
    """A number of each joint in each hold or motion."""

    key: str  #: in the CSV file
    heading: str
    digits: int  #: decimal places
    of: Callable[[Any], np.ndarray]  #: Hold or Motion -> (4,)
    largest: bool = False  #: the terminal shows the largest of the four only
    spare: int = 0  #: a narrow terminal drops these, from the largest number on
    below: bool = False  #: a joint that read one position throughout a hold has "<" and its uncertainty

    def texts(self, one: Any) -> list[str]:
        """Return the numbers of a hold or motion as text."""
        texts = [shown(value, self.digits) for value in self.of(one)]
        if not self.below:
            return texts
        bounds = zip(texts, per_minute(one.drift_rate_uncertainty), one.stray < UNMOVED, strict=True)
        return [f"<{shown(bound, self.digits)}" if unmoved else text for text, bound, unmoved in bounds]


HOLDS = (
    Column("pose_deg", "Pose\ndeg", 1, lambda hold: np.degrees(hold.pose)),
    Column("drift_deg_per_min", "Drift\ndeg/min", 2, lambda hold: per_minute(hold.drift_rate), below=True),
    Column(
        "drift_uncertainty_deg_per_min", "±\ndeg/min", 2, lambda hold: per_minute(hold.drift_rate_uncertainty), True
    ),
    Column("drift_deg", "Total drift\ndeg", 2, lambda hold: np.degrees(hold.drift), spare=5),
    Column("stray_in_10_s_deg", "Within 10 s\ndeg", 2, lambda hold: np.degrees(hold.stray), True, 1),
    Column("rms_velocity_deg_per_s", "RMS velocity\ndeg/s", 2, lambda hold: np.degrees(hold.velocity_rms), True, 4),
    Column("rms_torque_nm", "RMS torque\nNm", 2, lambda hold: hold.torque_rms, spare=2),
    Column("torque_error_nm", "Torque error\nNm", 3, lambda hold: hold.torque_error, True, 3),
)
MOTIONS = (
    Column("peak_deg", "Peak\ndeg", 1, lambda motion: np.degrees(motion.peak)),
    Column("residual_deg", "Residual\ndeg", 1, lambda motion: np.degrees(motion.residual)),
    Column("peak_speed_deg_per_s", "Peak speed\ndeg/s", 0, lambda motion: np.degrees(motion.speed), spare=1),
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


def write_csv(
    path: Path,
    arms: Iterable[tuple[Recording, TrialAnalysis]],
    columns: Mapping[str, Callable[[float], Mapping[str, str]]],
) -> None:
    """Write holds.csv or motions.csv, a row for each joint; an unknown number is an empty cell.

    columns: by arm, a function from a time in s to the first columns of a row. Without holds or motions no file is
    written.
    """
    rows: list[dict[str, str]] = []
    for recording, analysis in arms:
        for number, one in enumerate(getattr(analysis, path.stem), 1):
            if isinstance(one, Hold):
                shared = {"hold": number, "start_s": one.start, "duration_s": one.duration, "after": one.after}
            else:
                shared = {"motion": number, "kind": one.kind, "start_s": one.start, "until_still_s": one.until_still}
            numbers = {column.key: column.of(one) for column in (HOLDS if isinstance(one, Hold) else MOTIONS)}
            for joint, name in enumerate(recording.joint_names):
                row = {**columns[recording.name](one.start), **shared, "joint": name}
                row |= {key: values[joint] for key, values in numbers.items()}
                rows.append({key: _csv_value(value) for key, value in row.items()})
    if rows:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)


def write_time_series(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write the columns of `Bag.columns` as CSV; an unknown number is an empty cell."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for start in range(0, len(columns["time_s"]), ROWS):
            parts = (column[start : start + ROWS] for column in columns.values())
            writer.writerows(zip(*(_cells_of(part) for part in parts), strict=True))


def _cells_of(column: np.ndarray) -> list[Any]:
    if column.dtype.kind != "f":
        return column.tolist()
    return [value if math.isfinite(value) else "" for value in column.astype(float).round(6).tolist()]


def _csv_value(value: Any) -> str:
    if isinstance(value, str | int):
        return str(value)
    return f"{value:.6g}" if math.isfinite(value) else ""


def _shared(number: int, one: Hold | Motion) -> tuple[str, str, str]:
    """Return the first three cells of a hold or motion: what it is, when, and how long."""
    if isinstance(one, Hold):
        return str(number), shown(one.start, 1), shown(one.duration, 1)
    # An arm on its way down need not come to rest.
    never = math.isnan(one.until_still) and one.kind != "let down"
    return one.kind, shown(one.start, 1), "never" if never else shown(one.until_still, 1)


def _tables(analysis: TrialAnalysis) -> Iterator[tuple[str, Sequence[Hold | Motion], Sequence[str], Sequence[Column]]]:
    """Yield title, content, first headings and columns of both tables."""
    yield "Holds", analysis.holds, ("Hold", "At\ns", "For\ns"), HOLDS
    yield "Motions between holds", analysis.motions, ("Motion", "At\ns", "Still after\ns"), MOTIONS


def arm_section(recording: Recording, analysis: TrialAnalysis, figures: Iterable[str]) -> Iterator[str]:
    """Yield the page's section of one arm: its figures and tables."""
    yield html.heading(f"Arm: {recording.name}", 2)
    yield from figures
    if not analysis.holds:
        yield "<p>No hold was found.</p>"
    for title, found, heads, columns in _tables(analysis):
        groups = []
        for number, one in enumerate(found, 1):
            cells = [column.texts(one) for column in columns]
            groups.append((_shared(number, one), list(zip(joint_labels(recording), *cells, strict=True))))
        if groups:
            yield html.heading(title)
            yield html.table((*heads, "", *(column.heading for column in columns)), groups, "joints")


def print_tables(console: Console, recording: Recording, analysis: TrialAnalysis) -> None:
    """Print the holds and motions of one arm; a cell holds the four joints in order.

    Where the table is wider than the console, spare columns are left out: they are in the CSV files.
    """
    console.print(f"\n[bold]{recording.name}[/], joints in order: {', '.join(joint_labels(recording))}")
    for _, found, heads, columns in _tables(analysis):
        rows = [one for one in found if isinstance(one, Hold) or one.kind != "move"]
        if not rows:
            continue
        shared = zip(*(_shared(number, one) for number, one in enumerate(rows, 1)), strict=True)
        cells = {head: list(column) for head, column in zip(heads, shared, strict=True)}
        cells |= {column.heading: _cells(rows, column) for column in columns}
        for column in sorted(columns, key=lambda column: -column.spare):
            used = sum(2 + max(map(len, (*head.split("\n"), *texts))) for head, texts in cells.items())
            if used > console.width and column.spare:
                del cells[column.heading]
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
        for head in cells:
            table.add_column(head, justify="right", no_wrap=True)
        for row in zip(*cells.values(), strict=True):
            table.add_row(*row)
        console.print(table)


def _cells(rows: Sequence[Hold | Motion], column: Column) -> list[str]:
    """Return one cell per row: its largest number, or its four numbers, aligned with those of the other rows."""
    if column.largest:
        known = ([value for value in column.of(row) if math.isfinite(value)] for row in rows)
        return [shown(max(values, default=math.nan), column.digits) for values in known]
    texts = [column.texts(row) for row in rows]
    width = max(len(text) for row in texts for text in row)
    return [" ".join(text.rjust(width) for text in row) for row in texts]
