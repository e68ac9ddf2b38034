"""The result of a calibration as an HTML page: figures, values, and what friction makes of the torque that remains.

An arm whose torque is wrong by less than the friction of a joint stays where it is. Beyond it creeps, until a viscous
torque balances the rest.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from exo_gravity.core.calibration.identification import Identified, columns
from exo_gravity.core.model.gravity import gravity_torque
from exo_gravity.core.model.moments import MOMENTS, load_moments, regressor
from exo_gravity.tools.calibration.result import CalibrationResult, Change, Curve, plain, value_text
from exo_gravity.tools.reporting import html
from exo_gravity.tools.reporting.html import FAINT, HOLD_COLOUR, INK, JOINT_COLOURS, make_plain

DPI = 130
FIGURE_WIDTH = 11.0  # inches
ROOM = 0.08  # of the data's range, around it
SMALL_FRICTION = 0.2  # of the friction that was measured: a well-run-in gear
MOST_SHOWN = 99.0  # margins above are not worth a figure
POSE_COLUMNS = ("measured", "old file", "new file", "held out", "friction")  # Nm
LEGEND = {
    "Measured": "is the effort that holds the arm, the mean of both directions of motion, as commanded.",
    "Held out": "is measured minus predicted, by a result that was found without that pose.",
    "Margin": ("is friction divided by that remainder: above 1 the arm stays where it is let go, below 1 it creeps."),
}


class TorqueTable(NamedTuple):
    """One row per pose, n in all, one column per joint, in Nm as commanded."""

    theta: np.ndarray  #: (n, 4) rad
    measured: np.ndarray  #: (n, 4), the effort that holds the arm
    spread: np.ndarray  #: (n, 4), its standard error
    before: np.ndarray  #: (n, 4), as the old file predicts
    after: np.ndarray  #: (n, 4), as the new file predicts, which cannot hold the motors' constant offset
    held_out: np.ndarray  #: (n, 4), measured minus predicted by a result that was found without that pose
    friction: np.ndarray  #: (4,)
    used: np.ndarray  #: (n,), false for poses left out

    @classmethod
    def of(cls, result: CalibrationResult) -> TorqueTable | None:
        """Return the table of a result, None if it has no poses or nothing was identified."""
        found, arm, poses = result.identified, result.arm, result.observations
        if found is None or arm is None or not poses:
            return None
        theta, direction, measured, spread = columns(poses)
        loads = np.array([load_moments(arm.robot.length, pose.load_mass, pose.load_lever) for pose in poses])
        weight = np.einsum("ijk,ik->ij", regressor(theta, direction, arm.robot.gravity), loads)
        used = np.ones(len(poses), dtype=bool)
        used[[index for index, _ in found.rejected]] = False
        before = gravity_torque(arm.robot, theta, direction) + weight
        after, held_out = measured - found.residual - found.offset, found.held_out + found.offset
        return cls(theta, measured, spread, before, after, held_out, found.friction, used)

    @property
    def margin(self) -> np.ndarray:
        """Friction divided by the torque that remains, (n, 4): above 1 the arm stays."""
        with np.errstate(divide="ignore"):
            return np.asarray(self.friction / np.abs(self.held_out))

    def creeping(self, share: float = 1.0) -> tuple[int, int]:
        """Return in how many poses the arm creeps before and after, if friction is `share` of the measured one."""
        limit = share * self.friction
        wrong = (self.measured - self.before, self.held_out)
        before, after = (int(np.any(np.abs(error[self.used]) > limit, axis=1).sum()) for error in wrong)
        return before, after


def page_of(result: CalibrationResult, command: str, params: str, today: datetime.date | None = None) -> str:
    """Return the page of a result; command: 'gravity'. params: the old file, for the line below the title."""
    arm = f", {result.arm.name} arm" if result.arm else ""
    when = f"{today or datetime.date.today()}, from {params}"
    return html.document(f"calibrate {command}{arm}", when, _sections(result))


def _sections(result: CalibrationResult) -> Iterator[str]:
    labels = result.arm.joint_names if result.arm else tuple(f"joint {n}" for n in (1, 2, 3, 4))
    if result.refusals:
        yield html.verdict("Not calibrated; no file was written.", result.refusals, good=False)
    else:
        yield html.verdict("Calibrated.")
    yield html.bullets("Result", result.lines)
    if result.changes and not result.refusals:
        yield html.heading("New values")
        yield html.table(("node", "parameter", "value", "note"), map(_row, result.changes))
    found, table = result.identified, TorqueTable.of(result)
    if found is not None and table is not None:
        caption = "Predicted against measured torque: on the line, the file is right."
        yield _figure(prediction_figure(table, labels), caption)
        caption = "The torque that remains in each pose. Inside the band, friction holds the arm; outside, it creeps."
        yield _figure(remainder_figure(table, labels), caption)
        yield html.bullets("Drift to expect", _drift(table))
        yield from _moments(found)
        values = " ".join(f"{value:.3g}" for value in found.singular_values)
        lines = [*found.unknown, f"Singular values of the information: {values}"]
        yield html.bullets("What these poses do not show", lines)
        yield html.bullets("Poses left out", [f"pose {index + 1}: {reason}" for index, reason in found.rejected])
        if result.suggestion is not None:
            yield html.paragraph(f"{_degrees(result.suggestion)} degrees.", "Next best pose, if more is wanted:")
        yield html.heading("Poses")
        yield _poses(table, labels)
        yield html.explained(LEGEND)
    if result.curves:
        caption = "Friction over speed, half the difference between both directions."
        yield _figure(friction_figure(result.curves, labels), caption)


def _figure(figure: Figure, caption: str) -> str:
    return html.picture(html.png_of(figure, DPI), caption)


def _row(change: Change) -> tuple[str, str, str, str]:
    value = value_text(plain(change.value)) if change.name else ""
    return change.node, change.name or "(comment)", value, change.note


def _drift(table: TorqueTable) -> Iterator[str]:
    for share, friction in ((1.0, "the friction measured"), (SMALL_FRICTION, f"{SMALL_FRICTION:g} times that")):
        before, after = table.creeping(share)
        count = f"in {before} of {int(table.used.sum())} poses with the old file, in {after} with the new"
        yield f"With {friction} the arm creeps {count}."
    peak = np.maximum(np.abs(table.measured).max(axis=0), 1e-9)
    error = np.sqrt(np.mean(table.held_out[table.used] ** 2, axis=0)) / peak
    yield f"Held-out error, RMS, of each joint's peak torque: {' '.join(f'{e:.1%}' for e in error)}."


def _moments(found: Identified) -> Iterator[str]:
    rows = (
        (name, f"{value:.4f}", f"±{error:.5f}" if math.isfinite(error) else "not known")
        for name, value, error in zip(MOMENTS, found.moments, found.error, strict=True)
    )
    scales = " ".join(f"{s:.3f} ±{e:.3f}" for s, e in zip(found.scale, found.scale_error, strict=True))
    offsets = " ".join(f"{offset:+.3f}" for offset in found.offset)
    yield html.heading("First moments")
    yield html.table(("", "kg m, of commanded torque" if found.relative else "kg m", "standard error"), rows)
    yield html.paragraph(f"True torque per commanded torque{', relative' if found.relative else ''}: {scales}")
    yield html.paragraph(f"Constant offset of the motors, for which there is no parameter: {offsets} Nm")


def _poses(table: TorqueTable, labels: Sequence[str]) -> str:
    groups = []
    for number, theta in enumerate(table.theta):
        values = [column[number] for column in (table.measured, table.before, table.after, table.held_out)]
        rows = []
        for joint, (label, margin) in enumerate(zip(labels, table.margin[number], strict=True)):
            shown = f"{margin:.1f}" if margin < MOST_SHOWN else f"> {MOST_SHOWN:g}"
            verdict = "" if np.isnan(margin) else "stays" if margin > 1.0 else "creeps"
            torques = [f"{torque:.3f}" for torque in (*(row[joint] for row in values), table.friction[joint])]
            rows.append((label, *torques, shown, verdict))
        angles = _degrees(theta) if table.used[number] else f"{_degrees(theta)}\nleft out"
        groups.append(((f"{number + 1}", angles), rows))
    return html.joint_table(("Pose", "deg", "", *(f"{name}\nNm" for name in POSE_COLUMNS), "margin", ""), groups)


def _degrees(theta: Iterable[float]) -> str:
    return " ".join(str(round(math.degrees(angle))) for angle in theta)


def prediction_figure(table: TorqueTable, labels: Sequence[str]) -> Figure:
    """Return predicted against measured torque, a panel per joint, with the old file's predictions behind."""
    figure = Figure(figsize=(FIGURE_WIDTH, 3.4), layout="constrained")
    for joint, axis in enumerate(figure.subplots(1, 4)):
        measured, before, after = (column[:, joint] for column in (table.measured, table.before, table.after))
        everything = np.concatenate((measured, before, after))
        room = max(ROOM * np.ptp(everything), 0.05)
        limits = everything.min() - room, everything.max() + room
        axis.plot(limits, limits, color=FAINT, lw=0.8, zorder=0)
        axis.plot(measured, before, "o", ms=4.5, mfc="none", color=FAINT, label="old file")
        axis.plot(measured[table.used], after[table.used], "o", ms=4.5, color=JOINT_COLOURS[joint], label="new file")
        if not table.used.all():
            axis.plot(measured[~table.used], after[~table.used], "x", ms=6, color=INK, label="left out")
        axis.set(xlim=limits, ylim=limits, aspect="equal", xlabel="Measured (Nm)")
        axis.legend(frameon=False, fontsize=8, loc="upper left", handletextpad=0.1)
        _finish(axis, joint, labels)
    figure.axes[0].set_ylabel("Predicted (Nm)")
    return figure


def remainder_figure(table: TorqueTable, labels: Sequence[str]) -> Figure:
    """Return the torque that remains unbalanced in each pose, with the friction that holds it, a panel per joint."""
    figure = Figure(figsize=(FIGURE_WIDTH, 6.2), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    numbers, used = np.arange(1, len(table.theta) + 1), table.used
    for joint, axis in enumerate(axes):
        friction = table.friction[joint]
        axis.axhspan(-friction, friction, color=HOLD_COLOUR, lw=0, zorder=0, label="friction holds")
        axis.axhline(0.0, color=FAINT, lw=0.6, zorder=0)
        before = table.measured[:, joint] - table.before[:, joint]
        axis.plot(numbers[used] - 0.12, before[used], "o", ms=5, mfc="none", color=INK, label="old file")
        axis.errorbar(
            numbers[used] + 0.12, table.held_out[used, joint], 2.0 * table.spread[used, joint], fmt="o", ms=4.5, lw=1.2,
            color=JOINT_COLOURS[joint], label="new file, this pose held out, ± 2 standard errors",
        )  # fmt: skip
        _finish(axis, joint, labels)
    axes[1].set_ylabel("Measured minus predicted torque (Nm)", y=0.0)
    axes[-1].set_xlabel("Pose")
    axes[-1].set_xticks(numbers, [f"{n}" if used[n - 1] else f"{n}\nleft out" for n in numbers])
    axes[-1].set_xlim(0.4, len(numbers) + 0.6)
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return figure


def friction_figure(curves: Sequence[Curve], labels: Sequence[str]) -> Figure:
    """Return the friction of each joint over its speed, as measured and as fitted."""
    figure = Figure(figsize=(FIGURE_WIDTH, 3.2), layout="constrained")
    axes = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for joint, (axis, curve) in enumerate(zip(axes, curves, strict=True)):
        order = np.argsort(curve.speed)
        axis.plot(curve.speed, curve.torque, "o", ms=4.5, color=JOINT_COLOURS[joint], label="measured")
        axis.plot(curve.speed[order], curve.fit[order], color=INK, lw=1.0, label="fitted")
        axis.set_xlabel("Speed (rad/s)")
        axis.legend(frameon=False, fontsize=8)
        _finish(axis, joint, labels)
    axes[0].set_ylabel("Friction (Nm)")
    axes[0].set_ylim(bottom=0.0)
    return figure


def _finish(axis: Axes, joint: int, labels: Sequence[str]) -> None:
    axis.set_title(labels[joint], fontsize=10, color=JOINT_COLOURS[joint], loc="left", weight="bold")
    make_plain(axis)
    axis.margins(y=0.12)
