# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The demo of `make study NAME=calibrate-demo`: a simulated arm with a wrong file, calibrated, and a picture of both.

The device is that of config/sim.yaml with centres of gravity off its links' axes and motors that give more or less than
commanded; the file's masses are a fifth off. `calibrate gravity` runs on the nodes as on a real arm, for 4 minutes.
Then the arm is let go in poses that the calibration did not see, with a fifth of the friction, by either file.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from exo_gravity.lab.calibration.result import Change, write_changes
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.report.html import FAINT, INK, JOINT_COLOURS, make_plain
from exo_gravity.lab.report.table import joint_labels
from exo_gravity.lab.trial.from_file import OfflineTrial, simulated_trials
from exo_gravity.lab.trial.recording import Recording, ScriptedStep
from exo_gravity.sim.script import TrialScript
from exo_gravity.tools import calibrate

SIMULATOR, COMPENSATOR = "/right/simulator", "/right/compensator"
DEVICE = (
    Change(SIMULATOR, "robot.cog_y", [0.0, 0.008, -0.010, 0.012], "m, the demo's device"),
    Change(SIMULATOR, "robot.cog_z", [0.006, -0.010, 0.008, 0.005], "m, the demo's device"),
    Change(SIMULATOR, "torque_scale", [1.0, 1.08, 0.94, 1.05], "the demo's device"),
    Change(COMPENSATOR, "robot.mass", [0.70, 0.56, 0.73, 0.25], "a fifth off, on purpose"),
)
FRICTION = 0.2  # of the device's, once the arm is carried: a fifth
POSES = ((0.3, 0.9, 0.2, 0.6), (-0.4, 0.6, 0.9, 0.4), (0.2, 1.3, -0.1, 1.2))  # rad
HOLD = 20.0  # s
SETTLING = 0.5  # s after letting go, before which an arm that stays is not judged
GONE = 10.0  # deg, after which the arm has left its pose


def held(params: Path) -> list[Recording]:
    """Return what happens when the arm of `params` is let go in each of POSES, simulated offline, with less friction.

    The friction falls when the motors carry the arm: with so little, no arm hangs still before that.
    """
    recordings = []
    for pose in POSES:
        steps = [{"move": list(pose), "over": 4.0}, {"hold": HOLD}]
        (trial,) = simulated_trials(params, TrialScript.parse({"name": "let go", "steps": steps}))
        little = FRICTION * trial.arm.device.arm.model.dof_frictionloss

        def on_second(now: float, trial: OfflineTrial = trial, little: np.ndarray = little) -> bool:
            if trial.wearer.step is not None:
                trial.arm.device.arm.model.dof_frictionloss[:] = little
            return False

        recordings.append(trial.run(on_second))
    return recordings


def away(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return time (n,) in s since the arm was let go, and its way (n, 4) in degrees since then."""
    hold = _hold(recording)
    first, last = np.searchsorted(recording.time, (hold.start, hold.end))
    position = recording.position[first:last]
    return recording.time[first:last] - hold.start, np.degrees(position - position[0])


def _hold(recording: Recording) -> ScriptedStep:
    return next(step for step in recording.steps if step.action == "hold")


def creep(recordings: Sequence[Recording]) -> float:
    """Return the fastest drift of any joint in any pose, in degrees per minute; until GONE degrees, if it leaves."""
    rates = []
    for recording in recordings:
        time, way = away(recording)
        gone = np.flatnonzero(np.abs(way).max(axis=1) > GONE)
        first, last = (0, int(gone[0])) if len(gone) else (int(np.searchsorted(time, SETTLING)), len(way) - 1)
        rates.append(float(np.abs(way[last] - way[first]).max() / (time[last] - time[first]) * 60.0))
    return max(rates)


def picture(before: Sequence[Recording], after: Sequence[Recording]) -> Figure:
    """Return the figure: how far each joint moved by itself, one line per pose, before and after."""
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for axis, recordings, name, digits in (
        (axes[0], before, "Old file", 0),
        (axes[1], after, "After calibrate gravity", 2),
    ):
        for recording in recordings:
            time, way = away(recording)
            for joint, colour in enumerate(JOINT_COLOURS):
                label = joint_labels(recording)[joint] if recording is recordings[0] else None
                axis.plot(time, way[:, joint], color=colour, lw=1.3, label=label)
            if recording.carried and recording.carried[-1][1] < _hold(recording).end:
                end = recording.carried[-1][1] - _hold(recording).start
                axis.axvline(end, color=FAINT, lw=0.8, ls=":", zorder=0)
        title = f"{name}: up to {creep(recordings):,.{digits}f} degrees per minute"
        axis.set_title(title, loc="left", fontsize=11, color=INK)
        make_plain(axis)
        axis.set(xlim=(0.0, HOLD), xlabel="Time since it was let go (s)")
    legend = "dotted: a limit is exceeded, and the bridge lets the arm down"
    axes[0].text(0.08, 0.97, legend, transform=axes[0].transAxes, fontsize=9, color=INK, va="top")
    axes[0].set_ylabel("Moved by itself since it was let go (deg)")
    axes[1].legend(frameon=False, fontsize=9, loc="upper right")
    return figure


def main(folder: Path | None = None) -> int:
    """Run the demo in a new folder; return the exit code of the calibration, 1 if the arm creeps afterwards."""
    folder = folder or Path("trials", f"calibrate_demo_{datetime.now():%Y%m%d_%H%M%S}")
    folder.mkdir(parents=True)
    old = folder / "old.yaml"
    write_changes(packaged_config("sim.yaml"), old, DEVICE, "make study NAME=calibrate-demo")
    for name in ("new.yaml", "second.yaml", "third.yaml"):  # a busy computer can be late, which ends a tour
        new = folder / name
        code = calibrate.main(["gravity", "--params", str(old), "--output", str(new)])
        if not code:
            break
    else:
        return code
    recordings = [held(path) for path in (old, new)]
    picture(*recordings).savefig(folder / "before_and_after.png", dpi=150)
    rates = [creep(part) for part in recordings]
    print(f"With a fifth of the friction, by itself: {rates[0]:,.0f} degrees per minute before, {rates[1]:.2f} after")
    print(f"Written: {folder / 'before_and_after.png'}")
    return int(rates[1] > 0.2)


if __name__ == "__main__":
    sys.exit(main())
