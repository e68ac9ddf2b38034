"""The numbers of a report, in degrees: rows for the CSV files and the page, and the tables on the terminal."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from exo_gravity.core.trial.analysis import Hold, Motion, TrialAnalysis
from exo_gravity.core.trial.recording import Recording

Row = dict[str, Any]
Numbers = TypeVar("Numbers", float, np.ndarray)
# Dropped in this order where the terminal is too narrow
SPARE_COLUMNS = ("v deg/s", "peak speed deg/s", "error Nm", "torque Nm", "at s", "deg in 10 s")


def degrees(values: Numbers) -> Numbers:
    """Return radians in degrees, or rad/s in degrees per second."""
    return values * math.degrees(1.0)


def per_minute(values: Numbers) -> Numbers:
    """Return rad/s in degrees per minute."""
    return values * math.degrees(60.0)


def joint_labels(recording: Recording) -> list[str]:
    """Return readable joint names: without the arm's name, with spaces."""
    return [name.removeprefix(f"{recording.name}_").replace("_", " ") for name in recording.joint_names]


def hold_rows(recording: Recording, analysis: TrialAnalysis) -> Iterator[Row]:
    """Yield one row for each hold and joint."""
    for number, hold in enumerate(analysis.holds, 1):
        for joint, name in enumerate(recording.joint_names):
            yield {
                "arm": recording.name,
                "hold": number,
                "start_s": hold.start,
                "duration_s": hold.duration,
                "after": hold.after,
                "joint": name,
                "pose_deg": degrees(hold.pose[joint]),
                "drift_deg_per_min": per_minute(hold.drift_rate[joint]),
                "drift_uncertainty_deg_per_min": per_minute(hold.drift_rate_uncertainty[joint]),
                "drift_deg": degrees(hold.drift[joint]),
                "stray_in_10_s_deg": degrees(hold.stray[joint]),
                "rms_velocity_deg_per_s": degrees(hold.velocity_rms[joint]),
                "rms_torque_nm": hold.torque_rms[joint],
                "torque_error_nm": hold.torque_error[joint],
            }


def motion_rows(recording: Recording, analysis: TrialAnalysis) -> Iterator[Row]:
    """Yield one row for each motion between holds and joint."""
    for number, motion in enumerate(analysis.motions, 1):
        for joint, name in enumerate(recording.joint_names):
            yield {
                "arm": recording.name,
                "motion": number,
                "kind": motion.kind,
                "start_s": motion.start,
                "until_still_s": motion.until_still,
                "joint": name,
                "peak_deg": degrees(motion.peak[joint]),
                "residual_deg": degrees(motion.residual[joint]),
                "peak_speed_deg_per_s": degrees(motion.speed[joint]),
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


def shown(value: float, digits: int) -> str:
    """Return a readable number: a dash if unknown, and no minus sign on a rounded 0."""
    return f"{round(float(value), digits) + 0.0:.{digits}f}" if math.isfinite(value) else "–"


def print_tables(console: Console, recording: Recording, analysis: TrialAnalysis) -> None:
    """Print the holds and motions of one arm; a cell holds the four joints in order."""
    console.print(f"\n[bold]{recording.name}[/], joints in order: {', '.join(joint_labels(recording))}")
    if analysis.holds:
        console.print(_table(_hold_columns(analysis.holds), console.width))
    if pushes := [motion for motion in analysis.motions if motion.kind != "move"]:
        console.print(_table(_push_columns(pushes), console.width))


def _hold_columns(holds: Sequence[Hold]) -> dict[str, list[str]]:
    return {
        "hold": [str(number) for number, _ in enumerate(holds, 1)],
        "at s": [shown(hold.start, 1) for hold in holds],
        "for s": [shown(hold.duration, 1) for hold in holds],
        "pose deg": _fours((degrees(hold.pose) for hold in holds), 0),
        "drift deg/min": _fours((per_minute(hold.drift_rate) for hold in holds), 2),
        "±": [shown(per_minute(hold.drift_rate_uncertainty.max()), 2) for hold in holds],
        "deg in 10 s": [shown(degrees(hold.stray.max()), 2) for hold in holds],
        "v deg/s": [shown(degrees(hold.velocity_rms.max()), 2) for hold in holds],
        "torque Nm": _fours((hold.torque_rms for hold in holds), 2),
        "error Nm": [shown(hold.torque_error.max(), 2) for hold in holds],
    }


def _push_columns(motions: Sequence[Motion]) -> dict[str, list[str]]:
    return {
        "motion": [motion.kind for motion in motions],
        "at s": [shown(motion.start, 1) for motion in motions],
        "still after s": [_until_still(motion) for motion in motions],
        "peak deg": _fours((degrees(motion.peak) for motion in motions), 1),
        "residual deg": _fours((degrees(motion.residual) for motion in motions), 1),
        "peak speed deg/s": _fours((degrees(motion.speed) for motion in motions), 0),
    }


def _until_still(motion: Motion) -> str:
    # An arm on its way down need not come to rest.
    known = math.isfinite(motion.until_still) or motion.kind == "let down"
    return shown(motion.until_still, 1) if known else "never"


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


def _fours(rows: Iterable[np.ndarray], digits: int) -> list[str]:
    """Return one cell per row: its four numbers, aligned with those of the other rows."""
    texts = [[shown(value, digits) for value in row] for row in rows]
    width = max((len(text) for row in texts for text in row), default=0)
    return [" ".join(text.rjust(width) for text in row) for row in texts]
