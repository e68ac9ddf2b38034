# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The table and the picture of the study."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from exo_gravity.core.numbers import COVER
from exo_gravity.lab.observer.contact import ContactWatch
from exo_gravity.lab.observer.momentum import WearerEstimate
from exo_gravity.lab.observer.share import SHARE, share_of
from exo_gravity.lab.report.html import FAINT, INK, JOINT_COLOURS, PUSH_COLOUR, make_plain

from ..device_study import Row
from .study import KINDS, METHODS, Trial

COVERAGE = (0.92, 0.98)
SHARE_ERROR = 0.05
JOINT = 1  # of the picture: shoulder abduction


def verdict(trials: Sequence[Trial]) -> list[Row]:
    """Return the rows of the table."""
    rows = []
    for number, kind in enumerate(KINDS):
        error = np.concatenate([trial.error[:, trial.kind == number] for trial in trials], axis=1)
        rms = np.sqrt(np.mean(error**2, axis=1))
        for name, values in zip(METHODS, rms, strict=True):
            rows.append(Row(f"{kind}: RMS error, {name}", " ".join(f"{v:.2f}" for v in values) + " Nm", "", True))
        rows.append(Row(f"{kind}: within the 95 % band", f"{covered(trials, [number]):.1%}", "", True))
    whole, (low, high) = covered(trials, range(len(KINDS))), COVERAGE
    rows.append(Row("all: within the 95 % band", f"{whole:.1%}", f"{low:.0%} to {high:.0%}", low <= whole <= high))
    error = np.array([float(trial.share.value) - trial.true_share for trial in trials])
    worst = float(np.abs(error).max())
    rows.append(Row("share over a trial, largest error", points(worst), points(SHARE_ERROR), worst < SHARE_ERROR))
    rows.append(Row("the same, root mean square", points(float(np.sqrt(np.mean(error**2)))), "", True))
    for part, name in enumerate(("lifting", "resting", "tiring")):
        found = [trial.parts[part] for trial in trials]
        largest = max(abs(float(share.value) - true) for share, true in found)
        inside = sum(abs(float(share.value) - true) < COVER * float(share.deviation) for share, true in found)
        shown = f"{points(largest)}; {inside} of {len(found)} within their band"
        rows.append(Row(f"share while {name}, largest error", shown, "", True))
    counts, seconds = [contacts(trial) for trial in trials], sum(float(np.ptp(trial.curve.time)) for trial in trials)
    rows.append(Row("false contacts", f"{sum(counts)} in {seconds / 60.0:.0f} min", "", True))
    carried = sum(not trial.trouble for trial in trials)
    rows.append(Row("arms carried to the end", f"{carried} of {len(trials)}", "all", carried == len(trials)))
    return rows


def contacts(trial: Trial) -> int:
    """Return how many contacts the estimate shows."""
    watch, curve = ContactWatch(), trial.curve
    for time, *row in zip(curve.time.tolist(), *curve[1:], strict=True):
        watch.update(time, WearerEstimate(*(tuple(values.tolist()) for values in row)))
    return watch.count


def covered(trials: Sequence[Trial], kinds: Sequence[int]) -> float:
    """Return the share of times and joints at which the 95 % band covers the truth."""
    inside = [(np.abs(trial.error[0]) <= COVER * trial.curve.deviation)[np.isin(trial.kind, kinds)] for trial in trials]
    return float(np.concatenate(inside).mean())


def points(share: float) -> str:
    """Return a difference of two shares as text."""
    return f"{100.0 * share:.1f} percentage points"


def picture(trial: Trial) -> Figure:
    """Return one trial: the torque of shoulder abduction and the share, as estimated and true."""
    curve, truth = trial.curve, trial.truth
    time = curve.time - curve.time[0]
    figure = Figure(figsize=(11.0, 6.2), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.2, 1.0))
    others = {METHODS[2]: FAINT, METHODS[0]: JOINT_COLOURS[0]}
    for name, colour in others.items():
        estimate = trial.error[METHODS.index(name), :, JOINT] + truth.torque[:, JOINT]
        upper.plot(time, estimate, color=colour, lw=1.0, label=name)
    band = COVER * curve.deviation[:, JOINT]
    low, high = curve.torque[:, JOINT] - band, curve.torque[:, JOINT] + band
    upper.fill_between(time, low, high, color=JOINT_COLOURS[0], alpha=0.2, lw=0, label="its 95 % band")
    upper.plot(time, truth.torque[:, JOINT], color=INK, lw=0.9, ls=(0, (4, 2)), label="the simulated muscles")
    upper.set_ylabel("Shoulder abduction (Nm)")
    found, true = share_of(curve, SHARE.window), share_of(truth, SHARE.window)
    value, width = 100.0 * found.value, 100.0 * COVER * found.deviation
    lower.fill_between(time, value - width, value + width, color=JOINT_COLOURS[2], alpha=0.25, lw=0)
    lower.plot(time, value, color=JOINT_COLOURS[2], lw=1.2, label="share over 1 s, with its 95 % band")
    lower.plot(time, 100.0 * true.value, color=INK, lw=0.9, ls=(0, (4, 2)), label="true share")
    lower.set(ylabel="Share of their arm's weight (%)", xlabel="Time (s)", ylim=(-40.0, 140.0), xlim=(0.0, time[-1]))
    moving = trial.kind == KINDS.index("trunk in motion")
    for axis in (upper, lower):
        axis.fill_between(
            time, 0, 1, where=moving, transform=axis.get_xaxis_transform(), color=PUSH_COLOUR, lw=0, zorder=0,
            label="the trunk bows or walks",
        )  # fmt: skip
        axis.axhline(0.0, color=FAINT, lw=0.6, zorder=0)
        make_plain(axis)
        axis.legend(frameon=False, fontsize=9, ncols=5, loc="upper left", bbox_to_anchor=(0.0, 1.17))
    return figure
