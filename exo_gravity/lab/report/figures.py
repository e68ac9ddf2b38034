# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The figures of a report: the paper's plot of positions, velocities and torques; the drift; the wearer's torque.

A long recording is drawn as the minimum and maximum of each of 2,000 intervals, so that no peak is lost.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import COVER
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.observer import WearerPart
from exo_gravity.lab.report.html import FAINT, HOLD_COLOUR, INK, PUSH_COLOUR, joint_colours, make_plain
from exo_gravity.lab.report.table import UNMOVED, joint_labels, per_minute, shown, unmoved
from exo_gravity.lab.trial.analysis import HoldCriteria, Recording, TrialAnalysis, in_blocks

INTERVALS = 2_000  # per curve
WIDTH = 11.0  # inches
LINES = ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (6, 1.5, 1.5, 1.5)))  # of the joints, which differ in grey, too
MARKERS = "osD^"
START = 5  # blocks of 0.1 s, from whose mean the drift is drawn
SEEN = math.radians(0.1)  # rad; a joint that strays less in every hold is a flat line, and is not drawn


@dataclass(frozen=True)
class Part:
    """What of a recording is drawn."""

    joints: Sequence[int] = ()  #: their numbers from 1 on; none: all
    start: float = -math.inf  #: s
    end: float = math.inf  #: s

    def of(self, recording: Recording) -> tuple[list[int], slice]:
        """Return which joints, from 0 on, and samples of a recording these are. Raises ParameterError for none."""
        count, time = len(recording.joint_names), recording.time
        if not {*self.joints} <= {*range(1, count + 1)}:
            raise ParameterError("joints", list(self.joints), f"numbers from 1 to {count}")
        within = slice(*np.searchsorted(time, (self.start, self.end)).tolist())
        if within.stop - within.start < 2:
            expected = f"a part of the recording, which lasts from {shown(time[0], 1)} to {shown(time[-1], 1)} s"
            raise ParameterError("from and to", [self.start, self.end], expected)
        return [joint - 1 for joint in self.joints] or [*range(count)], within


def overview(
    recording: Recording,
    analysis: TrialAnalysis,
    part: Part | None = None,
    limits: Limits | None = None,
) -> Figure:
    """Return positions, velocities and torques over time, with holds and pushes shaded and holds numbered.

    part: what of the recording is drawn. limits: of its joints, drawn where they are within what is shown.

    Raises ParameterError if it has none of that part.
    """
    shown_joints, within = (part or Part()).of(recording)
    time, joints = recording.time[within], len(shown_joints)
    figure = Figure(figsize=(WIDTH, 8.2), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, height_ratios=(1.25, 1.0, 1.25))
    panels = (
        ("Position (deg)", np.degrees(recording.position)),
        ("Velocity (deg/s)", np.degrees(recording.velocity)),
        ("Torque (Nm)", recording.effort),
    )
    colours = [joint_colours(len(recording.joint_names))[joint] for joint in shown_joints]
    labels = [joint_labels(recording)[joint] for joint in shown_joints]
    for axis, (label, values) in zip(axes, panels, strict=True):
        for n, joint in enumerate(shown_joints):
            curve = _envelope(time, values[within, joint])
            axis.plot(*curve, color=colours[n], ls=LINES[joint % len(LINES)], lw=1.1, label=labels[n])
        for hold in analysis.holds:
            axis.axvspan(hold.start, hold.end, color=HOLD_COLOUR, lw=0, zorder=0, label="hold")
        for motion in analysis.motions:
            if motion.kind in ("push", "slip", "load"):
                axis.axvspan(motion.start, motion.end, color=PUSH_COLOUR, lw=0, zorder=0, label=motion.kind)
        axis.set_ylabel(label)
        make_plain(axis)
    for n in range(joints) if np.isfinite(recording.command).any() else ():
        command = _envelope(time, recording.command[within, shown_joints[n]])
        axes[2].plot(*command, color=colours[n], alpha=0.6, lw=0.6, label="commanded" if not n else None)
    axes[2].set_xlabel("Time (s)")
    axes[2].set_xlim(time[0], time[-1])
    for number, hold in enumerate(analysis.holds, 1):
        if time[0] <= (middle := (hold.start + hold.end) / 2) <= time[-1]:
            _write_above(axes[0], middle, str(number))
    _keep_scale(axes[1], time, panels[1][1][within][:, shown_joints], analysis)
    if limits and limits.joint_names == recording.joint_names:
        _draw_limits(axes, limits, zip(shown_joints, colours, strict=True))
    handles, names = axes[2].get_legend_handles_labels()
    entries = dict(zip(names, handles, strict=True))  # each once
    columns = len(entries) if sum(map(len, entries)) < 90 else 4
    figure.legend(
        entries.values(), entries.keys(), loc="outside upper center", ncols=columns, frameon=False, fontsize=9
    )
    return figure


def _write_above(axis: Axes, time: float, text: str) -> None:
    axis.annotate(
        text, (time, 1.0), (0, 3), xycoords=("data", "axes fraction"), textcoords="offset points", ha="center",
        color=INK, fontsize=9,
    )  # fmt: skip


def _keep_scale(axis: Axes, time: np.ndarray, speeds: np.ndarray, analysis: TrialAnalysis) -> None:
    """Scale the velocities by those outside of pushes and let-downs, and write the peak of those that are beyond."""
    others = [slice(*np.searchsorted(time, (m.start, m.end))) for m in analysis.motions if m.kind != "move"]
    calm = np.abs(np.nan_to_num(speeds))
    peaks = [float(calm[other].max(initial=0.0)) for other in others]
    for other in others:
        calm[other] = 0.0
    reach = 1.15 * float(calm.max())
    beyond = [(other, peak) for other, peak in zip(others, peaks, strict=True) if peak > reach > 0.0]
    if beyond:
        axis.set_ylim(-reach, reach)
    for other, peak in beyond:
        _write_above(axis, float(time[other].mean()), f"to {peak:.0f}")


def _draw_limits(axes: Sequence[Axes], limits: Limits, joints: Iterable[tuple[int, str]]) -> None:
    """Draw the limits of the joints as dotted lines, where they are within what the axes show."""
    for joint, colour in joints:
        position = limits.position_min[joint], limits.position_max[joint]
        speed, torque = math.degrees(limits.max_velocity[joint]), limits.max_effort[joint]
        rows = np.degrees(position).tolist(), (-speed, speed), (-torque, torque)
        for axis, values in zip(axes, rows, strict=True):
            low, high = axis.get_ylim()
            for value in values:
                if low < value < high:
                    axis.axhline(value, color=colour, ls=":", lw=0.8)


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
    axes[0].set_ylabel("Deviation (deg)")
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
            beside, rates[:, joint], errors[:, joint], fmt=MARKERS[joint % len(MARKERS)], ms=4.5, lw=1.2, capsize=2,
            color=colours[joint], label=name,
        )  # fmt: skip
    axis.axhline(0.0, color=FAINT, lw=0.6, zorder=0)
    if math.isfinite(criteria.max_rate):
        bound = per_minute(criteria.max_rate)
        axis.axhspan(-bound, bound, color=HOLD_COLOUR, zorder=-1, label=f"allowed: ±{bound:g} deg/min")
    axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, frameon=False, fontsize=9)
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
