"""The numbers of a report, in degrees: for the CSV files, for the page, and for the terminal."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from exo_gravity.core.trial.analysis import Hold, Motion, TrialAnalysis
from exo_gravity.core.trial.recording import Recording
from exo_gravity.tools.reporting import html

Numbers = TypeVar("Numbers", float, np.ndarray)
Row = dict[str, Any]
# Dropped in this order where the terminal is too narrow
SPARE_COLUMNS = ("v deg/s", "peak speed deg/s", "error Nm", "torque Nm", "at s", "deg in 10 s")


def degrees(values: Numbers) -> Numbers:
    """Return radians in degrees, or rad/s in degrees per second."""
    return values * math.degrees(1.0)


def per_minute(values: Numbers) -> Numbers:
    """Return rad/s in degrees per minute."""
    return values * math.degrees(60.0)


class Column(NamedTuple):
    """A number of each joint in each hold or motion."""

    key: str  #: in the CSV file
    heading: str  #: on the page
    digits: int  #: decimal places on the page
    of: Callable[[Any], np.ndarray]  #: Hold or Motion -> (4,)
    short: str = ""  #: heading on the terminal, '' to leave the column out there
    short_digits: int = 2
    largest: bool = False  #: the terminal shows the largest of the four only


HOLD_COLUMNS = (
    Column("pose_deg", "Pose\ndeg", 1, lambda hold: degrees(hold.pose), "pose deg", 0),
    Column("drift_deg_per_min", "Drift\ndeg/min", 2, lambda hold: per_minute(hold.drift_rate), "drift deg/min"),
    Column(
        "drift_uncertainty_deg_per_min", "±\ndeg/min", 2, lambda hold: per_minute(hold.drift_rate_uncertainty),
        "±", largest=True,
    ),
    Column("drift_deg", "Total drift\ndeg", 2, lambda hold: degrees(hold.drift)),
    Column("stray_in_10_s_deg", "Within 10 s\ndeg", 2, lambda hold: degrees(hold.stray), "deg in 10 s", largest=True),
    Column(
        "rms_velocity_deg_per_s", "RMS velocity\ndeg/s", 2, lambda hold: degrees(hold.velocity_rms),
        "v deg/s", largest=True,
    ),
    Column("rms_torque_nm", "RMS torque\nNm", 2, lambda hold: hold.torque_rms, "torque Nm"),
    Column("torque_error_nm", "Torque error\nNm", 3, lambda hold: hold.torque_error, "error Nm", largest=True),
)  # fmt: skip
MOTION_COLUMNS = (
    Column("peak_deg", "Peak\ndeg", 1, lambda motion: degrees(motion.peak), "peak deg", 1),
    Column("residual_deg", "Residual\ndeg", 1, lambda motion: degrees(motion.residual), "residual deg", 1),
    Column("peak_speed_deg_per_s", "Peak speed\ndeg/s", 0, lambda motion: degrees(motion.speed), "peak speed deg/s", 0),
)
# What the columns on the page mean
TERMS = {
    "Drift": "is the slope of a robust line (Huber) through the hold. Its uncertainty is at least one position code "
    "over the length of the hold.",
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


def hold_rows(recording: Recording, analysis: TrialAnalysis) -> Iterator[Row]:
    """Yield one row for each hold and joint."""
    for number, hold in enumerate(analysis.holds, 1):
        shared = {"hold": number, "start_s": hold.start, "duration_s": hold.duration, "after": hold.after}
        yield from _rows(recording, shared, hold, HOLD_COLUMNS)


def motion_rows(recording: Recording, analysis: TrialAnalysis) -> Iterator[Row]:
    """Yield one row for each motion between holds and joint."""
    for number, motion in enumerate(analysis.motions, 1):
        shared = {"motion": number, "kind": motion.kind, "start_s": motion.start, "until_still_s": motion.until_still}
        yield from _rows(recording, shared, motion, MOTION_COLUMNS)


def _rows(recording: Recording, shared: Row, of: Hold | Motion, columns: Sequence[Column]) -> Iterator[Row]:
    for joint, name in enumerate(recording.joint_names):
        yield {
            "arm": recording.name,
            **shared,
            "joint": name,
            **{column.key: column.of(of)[joint] for column in columns},
        }


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    """Write rows with a header; an unknown number is an empty cell. Without rows no file is written."""
    rows = [{key: _csv_value(value) for key, value in row.items()} for row in rows]
    if rows:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)


def _csv_value(value: Any) -> Any:
    if isinstance(value, str | int):
        return value
    return f"{value:.6g}" if math.isfinite(value) else ""


def arm_section(recording: Recording, analysis: TrialAnalysis, figures: Iterable[str]) -> Iterator[str]:
    """Yield the page's section of one arm: its key numbers, figures and tables."""
    yield html.heading(f"Arm: {recording.name}", 2)
    yield html.key_numbers(_key_numbers(recording, analysis))
    yield from figures
    labels = joint_labels(recording)
    if analysis.holds:
        yield html.heading("Holds")
        shared = [(str(n), hold.start, hold.duration) for n, hold in enumerate(analysis.holds, 1)]
        yield _page_table(("Hold", "At\ns", "For\ns"), labels, shared, analysis.holds, HOLD_COLUMNS)
    else:
        yield html.paragraph("No hold was found.")
    if analysis.motions:
        yield html.heading("Motions between holds")
        shared = [(motion.kind, motion.start, motion.until_still) for motion in analysis.motions]
        yield _page_table(("Motion", "At\ns", "Still after\ns"), labels, shared, analysis.motions, MOTION_COLUMNS)


def _page_table(
    heads: Sequence[str],
    labels: Sequence[str],
    shared: Sequence[tuple[str, float, float]],
    found: Sequence[Hold | Motion],
    columns: Sequence[Column],
) -> str:
    """Return a table of what was found; shared: the cells of each that its joints share."""
    groups = []
    for (what, start, length), one in zip(shared, found, strict=True):
        cells = [[shown(value, column.digits) for value in column.of(one)] for column in columns]
        groups.append(((what, shown(start, 1), shown(length, 1)), list(zip(labels, *cells, strict=True))))
    return html.joint_table((*heads, "", *(column.heading for column in columns)), groups)


def _key_numbers(recording: Recording, analysis: TrialAnalysis) -> Iterator[tuple[str, str]]:
    """Yield the holds, their total time and the fastest drift."""
    yield str(len(analysis.holds)), "holds"
    yield f"{sum(hold.duration for hold in analysis.holds):.0f} s", "total hold time"
    if analysis.holds:
        rates = np.array([hold.drift_rate for hold in analysis.holds])
        number, joint = divmod(int(np.argmax(np.abs(rates))), rates.shape[1])
        error = per_minute(analysis.holds[number].drift_rate_uncertainty[joint])
        label = f"fastest drift: {joint_labels(recording)[joint]}, hold {number + 1}"
        yield f"{shown(per_minute(rates[number, joint]), 2)} ± {shown(error, 2)} deg/min", label


def print_tables(console: Console, recording: Recording, analysis: TrialAnalysis) -> None:
    """Print the holds and motions of one arm; a cell holds the four joints in order."""
    console.print(f"\n[bold]{recording.name}[/], joints in order: {', '.join(joint_labels(recording))}")
    if holds := analysis.holds:
        first = {
            "hold": [str(number) for number, _ in enumerate(holds, 1)],
            "at s": [shown(hold.start, 1) for hold in holds],
            "for s": [shown(hold.duration, 1) for hold in holds],
        }
        console.print(_table(first | _short(holds, HOLD_COLUMNS), console.width))
    if pushes := [motion for motion in analysis.motions if motion.kind != "move"]:
        first = {
            "motion": [motion.kind for motion in pushes],
            "at s": [shown(motion.start, 1) for motion in pushes],
            "still after s": [_until_still(motion) for motion in pushes],
        }
        console.print(_table(first | _short(pushes, MOTION_COLUMNS), console.width))


def _until_still(motion: Motion) -> str:
    # An arm on its way down need not come to rest.
    known = math.isfinite(motion.until_still) or motion.kind == "let down"
    return shown(motion.until_still, 1) if known else "never"


def _short(found: Sequence[Hold | Motion], columns: Sequence[Column]) -> dict[str, list[str]]:
    """Return the terminal's columns."""
    return {
        column.short: [shown(column.of(one).max(), column.short_digits) for one in found]
        if column.largest
        else _fours([column.of(one) for one in found], column.short_digits)
        for column in columns
        if column.short
    }


def _fours(rows: Iterable[np.ndarray], digits: int) -> list[str]:
    """Return one cell per row: its four numbers, aligned with those of the other rows."""
    texts = [[shown(value, digits) for value in row] for row in rows]
    width = max((len(text) for row in texts for text in row), default=0)
    return [" ".join(text.rjust(width) for text in row) for row in texts]


def _table(columns: dict[str, list[str]], width: int) -> Table:
    """Return the columns as a table; a narrow terminal drops `SPARE_COLUMNS`, which are in the CSV files."""
    for spare in SPARE_COLUMNS:
        if sum(2 + max(map(len, (head, *cells))) for head, cells in columns.items()) > width:
            columns.pop(spare, None)
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for head in columns:
        table.add_column(head, justify="right", no_wrap=True)
    for row in zip(*columns.values(), strict=True):
        table.add_row(*row)
    return table
