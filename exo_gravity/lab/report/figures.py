# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The figures of a report: the paper's plot of positions, velocities and torques; the drift; the wearer's torque.

A long recording is drawn as the minimum and maximum of each of 2,000 intervals, so that no peak is lost.
"""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from exo_gravity.core.numbers import COVER
from exo_gravity.lab.report.html import FAINT, HOLD_COLOUR, INK, PUSH_COLOUR, joint_colours, make_plain
from exo_gravity.lab.report.table import UNMOVED, joint_labels, per_minute, shown, unmoved
from exo_gravity.lab.report.wearer_share import WearerPart
from exo_gravity.lab.trial.analysis import HoldCriteria, TrialAnalysis
from exo_gravity.lab.trial.recording import Recording, in_blocks

INTERVALS = 2_000  # per curve
WIDTH = 11.0  # inches
START = 5  # blocks of 0.1 s, from whose mean the drift is drawn
SEEN = math.radians(0.1)  # rad; a joint that strays less in every hold is a flat line, and is not drawn


def overview(recording: Recording, analysis: TrialAnalysis) -> Figure:
    """Return positions, velocities and torques over time, with holds and pushes shaded and holds numbered."""
    figure = Figure(figsize=(WIDTH, 8.2), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, height_ratios=(1.25, 1.0, 1.25))
    panels = (
        ("Position (deg)", np.degrees(recording.position)),
        ("Velocity (deg/s)", np.degrees(recording.velocity)),
        ("Torque (Nm)", recording.effort),
    )
    colours = joint_colours(len(recording.joint_names))
    for axis, (label, values) in zip(axes, panels, strict=True):
        for column, name, colour in zip(values.T, joint_labels(recording), colours, strict=True):
            axis.plot(*_envelope(recording.time, column), color=colour, lw=1.1, label=name)
        for hold in analysis.holds:
            axis.axvspan(hold.start, hold.end, color=HOLD_COLOUR, lw=0, zorder=0, label="hold")
        for motion in analysis.motions:
            if motion.kind in ("push", "slip"):
                axis.axvspan(motion.start, motion.end, color=PUSH_COLOUR, lw=0, zorder=0, label="push")
        axis.set_ylabel(label)
        make_plain(axis)
    for command in recording.command.T if np.isfinite(recording.command).any() else ():
        time, torque = _envelope(recording.time, command)
        axes[2].plot(time, torque, color=INK, lw=0.6, ls=(0, (4, 3)), label="commanded")
    for number, hold in enumerate(analysis.holds, 1):
        middle = (hold.start + hold.end) / 2
        axes[0].annotate(
            str(number), (middle, 1.0), (0, 3), xycoords=("data", "axes fraction"), textcoords="offset points",
            ha="center", color=INK, fontsize=9,
        )  # fmt: skip
    axes[2].set_xlabel("Time (s)")
    axes[2].set_xlim(recording.time[0], recording.time[-1])
    handles, names = axes[2].get_legend_handles_labels()
    entries = dict(zip(names, handles, strict=True))  # each once
    columns = len(entries) if sum(map(len, entries)) < 90 else 4
    figure.legend(
        entries.values(), entries.keys(), loc="outside upper center", ncols=columns, frameon=False, fontsize=9
    )
    return figure


def _moved(analysis: TrialAnalysis) -> np.ndarray:
    """Return how far each joint moved in a hold at most, (n,) rad; (0,) without a hold."""
    moved = [np.fmax(hold.stray, np.abs(hold.drift)) for hold in analysis.holds]
    return np.max(moved, axis=0) if moved else np.empty(0)


def strayed(analysis: TrialAnalysis) -> np.ndarray:
    """Return which joints (n,) moved visibly in a hold; (0,) without a hold."""
    return _moved(analysis) >= SEEN


def stayed_text(recording: Recording, analysis: TrialAnalysis) -> str:
    """Return what the joints that `drift` does not draw did in the holds, in a line; '' if it draws all."""
    moved, still = _moved(analysis), ~strayed(analysis)
    if not still.any():
        return ""
    if moved.max() <= UNMOVED:
        return f"In the holds, {unmoved(analysis.holds[0])}."
    names = [name for name, is_still in zip(joint_labels(recording), still, strict=False) if is_still]
    who = "no joint" if still.all() else f"none of {', '.join(names)}"
    return f"In the holds {who} moved more than {shown(math.degrees(moved[still].max()), 3)} degrees: not drawn."


def drift(recording: Recording, analysis: TrialAnalysis, criteria: HoldCriteria) -> Figure:
    """Return the deviation from the start of each hold, of the joints that `strayed`, and the drift rate of all."""
    figure, blocks = Figure(figsize=(WIDTH, 6.6), layout="constrained"), in_blocks(recording)
    upper, lower = np.ravel(figure.subfigures(2, 1, height_ratios=(1.0, 1.1)))
    colours = joint_colours(len(recording.joint_names))
    names = joint_labels(recording)
    joints = np.flatnonzero(strayed(analysis)).tolist()
    axes = np.ravel(upper.subplots(1, len(joints), sharex=True, sharey=True))
    for joint, axis in zip(joints, axes, strict=True):
        for hold in analysis.holds:
            within = blocks.between(hold.start, hold.end)
            angle = np.degrees(blocks.mean[within, joint])
            time, away = blocks.time[within] - hold.start, angle - angle[:START].mean()
            axis.plot(time, away, color=colours[joint], lw=0.9, alpha=0.75)
        axis.set_title(names[joint], fontsize=10, color=colours[joint], loc="left", weight="bold")
        axis.set_xlabel("Time in the hold (s)")
        axis.axhline(0.0, color=FAINT, lw=0.6, zorder=0)
        make_plain(axis)
        axis.margins(x=0)
    axes[0].set_ylabel("Deviation from the start (deg)")
    drawn = np.abs([value for axis in axes for value in axis.dataLim.intervaly if math.isfinite(value)])
    reach = max([math.degrees(SEEN), *drawn])
    axes[0].set_ylim(-1.15 * reach, 1.15 * reach)
    _rates(lower.subplots(), recording, analysis, criteria)
    return figure


def _rates(axis: Axes, recording: Recording, analysis: TrialAnalysis, criteria: HoldCriteria) -> None:
    numbers = np.arange(1, len(analysis.holds) + 1)
    rates = per_minute([hold.drift_rate for hold in analysis.holds])
    errors = per_minute([hold.drift_rate_uncertainty for hold in analysis.holds])
    colours = joint_colours(len(recording.joint_names))
    for joint, name in enumerate(joint_labels(recording)):
        beside = numbers + 0.48 * ((joint + 0.5) / len(colours) - 0.5)
        axis.errorbar(
            beside, rates[:, joint], errors[:, joint], fmt="o", ms=4.5, lw=1.2, capsize=2, color=colours[joint],
            label=name,
        )  # fmt: skip
    axis.axhline(0.0, color=FAINT, lw=0.6, zorder=0)
    if math.isfinite(criteria.max_rate):
        bound = per_minute(criteria.max_rate)
        axis.axhspan(-bound, bound, color=HOLD_COLOUR, zorder=-1, label=f"allowed: ±{bound:g} deg/min")
        axis.legend(loc="upper left", bbox_to_anchor=(0, 1.14), ncols=5, frameon=False, fontsize=9)
    axis.set_xticks(numbers)
    axis.set_xlim(0.4, len(numbers) + 0.6)
    axis.set_xlabel("Hold")
    axis.set_ylabel("Drift (deg/min)")
    make_plain(axis)


def wearer(recording: Recording, part: WearerPart) -> Figure:
    """Return the wearer's torque at each joint and their share over time, with their 95 % bands."""
    figure, curve = Figure(figsize=(WIDTH, 8.2), layout="constrained"), part.curve
    colours = joint_colours(len(recording.joint_names))
    axes = figure.subplots(len(colours) + 1, 1, sharex=True, height_ratios=(*[1.0] * len(colours), 1.4))
    rows = [*curve.torque.T, 100.0 * part.sliding.value]
    bands = [*(COVER * curve.deviation.T), 100.0 * COVER * part.sliding.deviation]
    names = [f"{label} (Nm)" for label in joint_labels(recording)]
    columns = zip(
        axes, rows, bands, [*names, "Wearer's share of arm weight, over 1 s (%)"], [*colours, INK], strict=True
    )
    for axis, values, band, name, colour in columns:
        axis.fill_between(curve.time, values - band, values + band, color=colour, alpha=0.2, lw=0)
        axis.plot(curve.time, values, color=colour, lw=1.0)
        axis.axhline(0.0, color=FAINT, lw=0.6, zorder=0)
        axis.set_title(name, loc="left", fontsize=9, color=colour)
        make_plain(axis)
    axes[-1].set_ylim(-60.0, 160.0)
    axes[-1].set_xlabel("Time (s)")
    return figure


def _envelope(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a line through the minimum and maximum of each interval."""
    if len(time) <= 2 * INTERVALS:
        return time, values
    edges = np.linspace(0, len(time), INTERVALS, endpoint=False).astype(int)
    ends = np.stack([np.minimum.reduceat(values, edges), np.maximum.reduceat(values, edges)], axis=1)
    return np.repeat(time[edges], 2), ends.ravel()
