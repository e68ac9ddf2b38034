"""The result of a calibration as one self-contained HTML page, figures embedded."""

from __future__ import annotations

import datetime
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from html import escape

import numpy as np
from matplotlib.figure import Figure

from exo_gravity.core.calibration.identification import Identified
from exo_gravity.core.model.moments import MOMENTS
from exo_gravity.tools.calibration.figures import friction_figure, prediction_figure, remainder_figure
from exo_gravity.tools.calibration.outcome import Change, Outcome
from exo_gravity.tools.calibration.torque_table import SMALL_FRICTION, TorqueTable, torque_table
from exo_gravity.tools.calibration.yaml_file import plain, value_text
from exo_gravity.tools.reporting.colours import JOINT_COLOURS
from exo_gravity.tools.reporting.page import STYLE, figure_html, list_html

DPI = 130
MOST_SHOWN = 99.0  # margins above are not worth a figure
POSE_COLUMNS = ("measured<br>Nm", "old file<br>Nm", "new file<br>Nm", "held out<br>Nm", "friction<br>Nm", "margin", "")
LEGEND = """<b>Measured</b> is the effort that holds the arm, the mean of both directions of motion, as commanded.
<b>Held out</b> is measured minus predicted, by a result that was found without that pose. <b>Margin</b> is friction
divided by that remainder: above 1 the arm stays where it is let go, below 1 it creeps."""
PREDICTION_CAPTION = "Predicted against measured torque: on the line, the file is right."
REMAINDER_CAPTION = "The torque that remains in each pose. Inside the band, friction holds the arm; outside, it creeps."
FRICTION_CAPTION = "Friction over speed, half the difference between both directions."


def page_of(outcome: Outcome, command: str, params: str, today: datetime.date | None = None) -> str:
    """Return the page of an outcome; command: 'gravity'. params: the old file, for the line below the title."""
    arm = f", {outcome.arm.name} arm" if outcome.arm else ""
    title = f"calibrate {command}{arm}"
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head><body>\n<h1>{escape(title)}</h1>"
        f"<p class='when'>{today or datetime.date.today()}, from {escape(params)}</p>{_verdict(outcome)}\n"
        f"{''.join(_sections(outcome))}</body></html>\n"
    )


def _verdict(outcome: Outcome) -> str:
    if not outcome.refusals:
        return '<div class="verdict"><b>Calibrated.</b></div>'
    reasons = "".join(f"<li>{escape(reason)}</li>" for reason in outcome.refusals)
    return f'<div class="verdict not"><b>Not calibrated; no file was written.</b><ul>{reasons}</ul></div>'


def _sections(outcome: Outcome) -> Iterator[str]:
    labels = outcome.arm.joint_names if outcome.arm else tuple(f"joint {n}" for n in (1, 2, 3, 4))
    yield list_html("Result", outcome.lines)
    if outcome.changes and not outcome.refusals:
        rows = (
            [c.node, c.name or "(comment)", value_text(plain(c.value)) if c.name else "", c.note]
            for c in outcome.changes
        )
        yield f"<h3>New values</h3>{_table(('node', 'parameter', 'value', 'note'), rows)}"
    table = torque_table(outcome)
    if outcome.identified is not None and table is not None:
        yield _embedded(prediction_figure(table, labels), PREDICTION_CAPTION)
        yield _embedded(remainder_figure(table, labels), REMAINDER_CAPTION)
        yield _creep(table)
        yield _moments(outcome.identified)
        yield from _untold(outcome)
        yield f"<h3>Poses</h3>{_poses(table, labels)}<footer><p>{LEGEND}</p></footer>"
    if outcome.curves:
        yield _embedded(friction_figure(outcome.curves, labels), FRICTION_CAPTION)


def _row(change: Change) -> list[str]:
    value = value_text(plain(change.value)) if change.name else ""
    return [change.node, change.name or "(comment)", value, change.note]


def _creep(table: TorqueTable) -> str:
    count = int(table.used.sum())
    sentences = []
    for share, friction in (
        (1.0, "the friction measured"),
        (SMALL_FRICTION, f"{SMALL_FRICTION:g} times that friction"),
    ):
        before, after = table.creeping(share)
        creeps = f"creeps in {before} of {count} poses with the old file, in {after} with the new"
        sentences.append(f"With {friction} the arm {creeps}.")
    error = np.sqrt(np.mean(table.held_out[table.used] ** 2, axis=0)) / np.maximum(table.peak, 1e-9)
    sentences.append(f"Held-out error, RMS, of each joint's peak torque: {' '.join(f'{e:.1%}' for e in error)}.")
    return list_html("Drift to expect", sentences)


def _moments(result: Identified) -> str:
    unit = "kg m, of commanded torque" if result.relative else "kg m"
    rows = (
        [name, f"{value:.4f}", f"±{error:.5f}" if math.isfinite(error) else "not told"]
        for name, value, error in zip(MOMENTS, result.moments, result.error, strict=True)
    )
    scales = " ".join(f"{s:.3f} ±{e:.3f}" for s, e in zip(result.scale, result.scale_error, strict=True))
    offsets = " ".join(f"{offset:+.3f}" for offset in result.offset)
    return (
        f"<h3>First moments</h3>{_table(('', unit, 'standard error'), rows)}"
        f"<p>True torque per commanded torque{', relative' if result.relative else ''}: {scales}</p>"
        f"<p>Constant offset of the motors, for which there is no parameter: {offsets} Nm</p>"
    )


def _untold(outcome: Outcome) -> Iterator[str]:
    """Yield what the data do not tell, and what would."""
    result = outcome.identified
    assert result is not None
    values = " ".join(f"{value:.3g}" for value in result.singular_values)
    yield list_html("What these poses do not tell", [*result.unknown, f"Singular values of the information: {values}"])
    yield list_html("Poses left out", [f"pose {index + 1}: {reason}" for index, reason in result.rejected])
    if outcome.suggestion is not None:
        yield f"<p><b>Next best pose</b>, if more is wanted: {_degrees(outcome.suggestion)} degrees.</p>"


def _poses(table: TorqueTable, labels: Sequence[str]) -> str:
    heads = "".join(f"<th>{head}</th>" for head in POSE_COLUMNS)
    bodies = []
    for number, theta in enumerate(table.theta):
        lines = []
        for joint, (label, colour) in enumerate(zip(labels, JOINT_COLOURS, strict=True)):
            columns = (table.measured, table.before, table.after, table.held_out)
            cells = [f"{column[number, joint]:.3f}" for column in columns]
            margin = table.margin[number, joint]
            verdict = "" if np.isnan(margin) else "stays" if margin > 1.0 else "creeps"
            cells += [
                f"{table.friction[joint]:.3f}",
                f"{margin:.1f}" if margin < MOST_SHOWN else f"> {MOST_SHOWN:g}",
                verdict,
            ]
            numbers = "".join(f"<td>{cell}</td>" for cell in cells)
            lines.append(f'<td class="joint" style="--c:{colour}">{escape(label)}</td>{numbers}')
        left_out = "" if table.used[number] else "<br>left out"
        head = (
            f'<td rowspan="{len(lines)}">{number + 1}</td><td rowspan="{len(lines)}">{_degrees(theta)}{left_out}</td>'
        )
        bodies.append(f"<tbody><tr>{head}{'</tr><tr>'.join(lines)}</tr></tbody>")
    return (
        f'<div class="scroll"><table><thead><tr><th>Pose</th><th>deg</th><th></th>{heads}</tr></thead>'
        f"{''.join(bodies)}</table></div>"
    )


def _degrees(theta: Iterable[float]) -> str:
    return " ".join(str(round(math.degrees(angle))) for angle in theta)


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join(f"<tr>{''.join(f'<td>{escape(text)}</td>' for text in row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _embedded(figure: Figure, caption: str) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return figure_html(buffer.getvalue(), caption)
