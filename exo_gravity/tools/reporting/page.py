"""The report's HTML page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby

from exo_gravity.core.trial.analysis import TrialAnalysis
from exo_gravity.core.trial.recording import Recording
from exo_gravity.tools.reporting import html
from exo_gravity.tools.reporting.table import Row, hold_rows, joint_labels, motion_rows, per_minute, shown

Column = tuple[str, str, int]  # heading, key of a row, decimal places
HOLD_COLUMNS = (
    ("Pose\ndeg", "pose_deg", 1),
    ("Drift\ndeg/min", "drift_deg_per_min", 2),
    ("±\ndeg/min", "drift_uncertainty_deg_per_min", 2),
    ("Total drift\ndeg", "drift_deg", 2),
    ("Within 10 s\ndeg", "stray_in_10_s_deg", 2),
    ("RMS velocity\ndeg/s", "rms_velocity_deg_per_s", 2),
    ("RMS torque\nNm", "rms_torque_nm", 2),
    ("Torque error\nNm", "torque_error_nm", 3),
)
MOTION_COLUMNS = (
    ("Peak\ndeg", "peak_deg", 1),
    ("Residual\ndeg", "residual_deg", 1),
    ("Peak speed\ndeg/s", "peak_speed_deg_per_s", 0),
)
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


def arm_section(recording: Recording, analysis: TrialAnalysis, figures: Iterable[str]) -> Iterator[str]:
    """Yield the section of one arm: its key numbers, figures and tables."""
    labels = joint_labels(recording)
    yield html.heading(f"Arm: {recording.name}", 2)
    yield html.key_numbers(_key_numbers(recording, analysis))
    yield from figures
    if analysis.holds:
        yield html.heading("Holds")
        yield _table("hold", "For\ns", labels, hold_rows(recording, analysis), HOLD_COLUMNS)
    else:
        yield html.paragraph("No hold was found.")
    if analysis.motions:
        yield html.heading("Motions between holds")
        yield _table("motion", "Still after\ns", labels, motion_rows(recording, analysis), MOTION_COLUMNS)


def parameters(nodes: dict[str, str]) -> str:
    """Return the parameters of every node, folded, as a ROS 2 parameter file."""
    return html.folded("Parameters at the start", "\n".join(nodes[node].rstrip() for node in sorted(nodes)))


def _key_numbers(recording: Recording, analysis: TrialAnalysis) -> Iterator[tuple[str, str]]:
    """Yield the holds, their total time and the fastest drift."""
    yield str(len(analysis.holds)), "holds"
    yield f"{sum(h.duration for h in analysis.holds):.0f} s", "total hold time"
    if analysis.holds:
        _, number, joint = max(
            (abs(rate), number, joint)
            for number, hold in enumerate(analysis.holds)
            for joint, rate in enumerate(hold.drift_rate)
        )
        hold = analysis.holds[number]
        rate, error = per_minute(hold.drift_rate[joint]), per_minute(hold.drift_rate_uncertainty[joint])
        label = f"fastest drift: {joint_labels(recording)[joint]}, hold {number + 1}"
        yield f"{shown(rate, 2)} ± {shown(error, 2)} deg/min", label


def _table(key: str, length: str, labels: Sequence[str], rows: Iterable[Row], columns: Sequence[Column]) -> str:
    heads = (key.capitalize(), "At\ns", length, "", *(head for head, _, _ in columns))
    groups = (list(group) for _, group in groupby(rows, lambda row: row[key]))
    return html.joint_table(heads, (_group(group, labels, columns) for group in groups))


def _group(
    rows: Sequence[Row], labels: Sequence[str], columns: Sequence[Column]
) -> tuple[tuple[str, ...], list[list[str]]]:
    """Return the cells that all joints of a hold or motion share, and a row for each joint."""
    first = rows[0]
    what, length = (str(first["hold"]), "duration_s") if "hold" in first else (first["kind"], "until_still_s")
    joints = [
        [joint, *(shown(row[name], digits) for _, name, digits in columns)]
        for row, joint in zip(rows, labels, strict=True)
    ]
    return (what, shown(first["start_s"], 1), shown(first[length], 1)), joints
