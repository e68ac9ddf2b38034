"""The figures of a calibration: predicted against measured torque, the torque that remains, and friction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from exo_gravity.tools.calibration.outcome import Curve
from exo_gravity.tools.calibration.torque_table import TorqueTable
from exo_gravity.tools.reporting.colours import FAINT, HOLD_COLOUR, INK, JOINT_COLOURS, make_plain

WIDTH = 11.0  # inches
ROOM = 0.08  # of the data's range, around it


def prediction_figure(table: TorqueTable, labels: Sequence[str]) -> Figure:
    """Return predicted against measured torque, a panel per joint, with the old file's predictions behind."""
    figure = Figure(figsize=(WIDTH, 3.4), layout="constrained")
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
        axis.set_title(labels[joint], fontsize=10, color=JOINT_COLOURS[joint], loc="left", weight="bold")
        axis.legend(frameon=False, fontsize=8, loc="upper left", handletextpad=0.1)
        _plain(axis)
    figure.axes[0].set_ylabel("Predicted (Nm)")
    return figure


def remainder_figure(table: TorqueTable, labels: Sequence[str]) -> Figure:
    """Return the torque that remains unbalanced in each pose, with the friction that holds it, a panel per joint."""
    figure = Figure(figsize=(WIDTH, 6.2), layout="constrained")
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
        axis.set_title(labels[joint], fontsize=10, color=JOINT_COLOURS[joint], loc="left", weight="bold")
        _plain(axis)
    axes[1].set_ylabel("Measured minus predicted torque (Nm)", y=0.0)
    axes[-1].set_xlabel("Pose")
    axes[-1].set_xticks(numbers, [f"{n}" if used[n - 1] else f"{n}\nleft out" for n in numbers])
    axes[-1].set_xlim(0.4, len(numbers) + 0.6)
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return figure


def friction_figure(curves: Sequence[Curve], labels: Sequence[str]) -> Figure:
    """Return the friction of each joint over its speed, as measured and as fitted."""
    figure = Figure(figsize=(WIDTH, 3.2), layout="constrained")
    axes = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for joint, (axis, curve) in enumerate(zip(axes, curves, strict=True)):
        order = np.argsort(curve.speed)
        axis.plot(curve.speed, curve.torque, "o", ms=4.5, color=JOINT_COLOURS[joint], label="measured")
        axis.plot(curve.speed[order], curve.fit[order], color=INK, lw=1.0, label="fitted")
        axis.set_title(labels[joint], fontsize=10, color=JOINT_COLOURS[joint], loc="left", weight="bold")
        axis.set_xlabel("Speed (rad/s)")
        axis.legend(frameon=False, fontsize=8)
        _plain(axis)
    figure.axes[0].set_ylabel("Friction (Nm)")
    figure.axes[0].set_ylim(bottom=0.0)
    return figure


def _plain(axis: Axes) -> None:
    make_plain(axis)
    axis.margins(y=0.12)
