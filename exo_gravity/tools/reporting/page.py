"""The report as one self-contained HTML page, figures embedded."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from itertools import groupby
from typing import Any

from exo_gravity.core.trial.analysis import TrialAnalysis
from exo_gravity.core.trial.recording import Recording
from exo_gravity.tools.reporting.colours import JOINT_COLOURS
from exo_gravity.tools.reporting.table import Row, hold_rows, joint_labels, motion_rows, per_minute, shown

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 72rem; margin: 2rem auto;
       padding: 0 1rem; }
h1 { margin: 0; font-size: 1.8rem; } h2 { margin: 2.5rem 0 .5rem; } h3 { margin: 1.5rem 0 .3rem; font-size: 1.05rem; }
.when, .note, footer { color: #5a646d; } figure { margin: 1rem 0; } img { width: 100%; height: auto; }
figcaption { color: #5a646d; font-size: .9rem; }
.verdict { border-left: .4rem solid #009E73; background: #eef7f3; padding: .7rem 1rem; margin: 1.2rem 0; }
.verdict.not { border-color: #D55E00; background: #fdf1ea; }
.verdict ul { margin: .3rem 0 0; padding-left: 1.2rem; }
.key { display: flex; flex-wrap: wrap; gap: 1rem 2.5rem; margin: 1rem 0; }
.key b { display: block; font-size: 1.5rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .15rem .6rem; text-align: right; white-space: nowrap; }
th { font-weight: 600; vertical-align: bottom; }
thead { border-bottom: 2px solid #9aa3ab; } tbody { border-bottom: 1px solid #d5dadf; }
td.joint, td.name { text-align: left; } td.joint::before { content: "●"; color: var(--c); margin-right: .4rem; }
pre { background: #f4f6f8; padding: .7rem 1rem; overflow-x: auto; font-size: .85rem; }
"""

HOLD_COLUMNS = (
    ("Pose<br>deg", "pose_deg", 1),
    ("Drift<br>deg/min", "drift_deg_per_min", 2),
    ("±<br>deg/min", "drift_uncertainty_deg_per_min", 2),
    ("Total drift<br>deg", "drift_deg", 2),
    ("Within 10 s<br>deg", "stray_in_10_s_deg", 2),
    ("RMS velocity<br>deg/s", "rms_velocity_deg_per_s", 2),
    ("RMS torque<br>Nm", "rms_torque_nm", 2),
    ("Torque error<br>Nm", "torque_error_nm", 3),
)
MOTION_COLUMNS = (
    ("Peak<br>deg", "peak_deg", 1),
    ("Residual<br>deg", "residual_deg", 1),
    ("Peak speed<br>deg/s", "peak_speed_deg_per_s", 0),
)
LEGEND = """<b>Drift</b> is the slope of a robust line (Huber) through the hold. Its uncertainty is at least one
position code over the length of the hold. <b>Within 10 s</b> is the widest range of a joint in any 10 s.
<b>RMS velocity</b> is as the motors report it: at rest half a velocity code, 0.6 to 0.7 deg/s, since no code stands for
zero. <b>Torque error</b> is the RMS of commanded minus measured torque. <b>Residual</b> is the pose after a motion
minus the pose before it: feed-forward compensation has no stiffness, so a pushed arm stays where it was pushed.
<b>Let down</b> is the way down under the motors' own damping, after a stop, a fault or the end of the trial: neither a
hold nor a slip."""


def figure_html(png: bytes, caption: str) -> str:
    """Return a figure element with the PNG embedded."""
    data = base64.b64encode(png).decode()
    return (
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def arm_html(recording: Recording, analysis: TrialAnalysis, figures: Iterable[str]) -> str:
    """Return the section of one arm: its key numbers, figures and tables."""
    labels = joint_labels(recording)
    holds = _table("hold", labels, hold_rows(recording, analysis), HOLD_COLUMNS)
    motions = _table("motion", labels, motion_rows(recording, analysis), MOTION_COLUMNS)
    return "\n".join(
        (
            f"<h2>Arm: {escape(recording.name)}</h2>",
            _key(analysis, recording),
            *figures,
            f"<h3>Holds</h3>{holds}" if analysis.holds else "<p>No hold was found.</p>",
            f"<h3>Motions between holds</h3>{motions}" if analysis.motions else "",
        )
    )


def page_html(title: str, when: str, failures: Sequence[str], held: str, sections: Iterable[str], ending: str) -> str:
    """Return the page. when: the line below the title. held: the verdict if there are no `failures`."""
    reasons = "".join(f"<li>{escape(sentence)}</li>" for sentence in failures)
    banner = (
        f'<div class="verdict not"><b>It did not hold.</b><ul>{reasons}</ul></div>'
        if failures
        else f'<div class="verdict"><b>{escape(held)}</b></div>'
    )
    return document_html(title, when, [banner, "\n", *sections, f"\n<footer><p>{LEGEND}</p></footer>{ending}"])


def document_html(title: str, when: str, body: Iterable[str]) -> str:
    """Return a page with its heading. when: the line below the title."""
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head><body>\n<h1>{escape(title)}</h1><p class='when'>{escape(when)}</p>"
        f"{''.join(body)}</body></html>\n"
    )


def list_html(heading: str, lines: Sequence[str]) -> str:
    """Return a heading and a list, or '' if there are no lines."""
    return f"<h3>{heading}</h3><ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>" if lines else ""


def parameters_html(parameters: dict[str, str]) -> str:
    """Return the parameters of every node, collapsed, as a ROS 2 parameter file."""
    text = "\n".join(parameters[node].rstrip() for node in sorted(parameters))
    return f"<details><summary>Parameters at the start</summary><pre>{escape(text)}</pre></details>" if text else ""


def _key(analysis: TrialAnalysis, recording: Recording) -> str:
    """Return the key numbers: holds, their total time, the fastest drift."""
    numbers = [
        (str(len(analysis.holds)), "holds"),
        (f"{sum(h.duration for h in analysis.holds):.0f} s", "total hold time"),
    ]
    if analysis.holds:
        _, number, joint = max(
            (abs(rate), number, joint)
            for number, hold in enumerate(analysis.holds)
            for joint, rate in enumerate(hold.drift_rate)
        )
        hold = analysis.holds[number]
        rate, error = per_minute(hold.drift_rate[joint]), per_minute(hold.drift_rate_uncertainty[joint])
        label = f"fastest drift: {joint_labels(recording)[joint]}, hold {number + 1}"
        numbers.append((f"{shown(rate, 2)} ± {shown(error, 2)} deg/min", label))
    cells = "".join(f"<div><b>{number}</b>{escape(label)}</div>" for number, label in numbers)
    return f'<div class="key">{cells}</div>'


def _table(key: str, labels: Sequence[str], rows: Iterable[Row], columns: Sequence[tuple[str, str, int]]) -> str:
    heads = "".join(f"<th>{head}</th>" for head, _, _ in columns)
    extra = "For<br>s" if key == "hold" else "Still after<br>s"
    body = "".join(_group(list(group), labels, columns) for _, group in groupby(rows, lambda row: row[key]))
    return (
        f'<div class="scroll"><table><thead><tr><th>{key.capitalize()}</th><th>At<br>s</th><th>{extra}</th><th></th>'
        f"{heads}</tr></thead>{body}</table></div>"
    )


def _group(rows: Sequence[Row], labels: Sequence[str], columns: Sequence[tuple[str, str, int]]) -> str:
    """Return the rows of one hold or motion; cells that all joints share span them."""
    span = f'<td rowspan="{len(rows)}">'
    first: dict[str, Any] = rows[0]
    label = str(first["hold"]) if "hold" in first else escape(first["kind"])
    length = shown(first["duration_s"] if "hold" in first else first["until_still_s"], 1)
    lines = []
    for row, joint, colour in zip(rows, labels, JOINT_COLOURS, strict=True):
        cells = "".join(f"<td>{shown(row[name], digits)}</td>" for _, name, digits in columns)
        lines.append(f'<td class="joint" style="--c:{colour}">{escape(joint)}</td>{cells}')
    head = f"{span}{label}</td>{span}{shown(first['start_s'], 1)}</td>{span}{length}</td>"
    return f"<tbody><tr>{head}{'</tr><tr>'.join(lines)}</tr></tbody>"
