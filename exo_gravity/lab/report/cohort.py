# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Many recordings -> tidy rows: one for each recording, arm and joint.

`summary` is a pure function from a path to rows of plain values: processes or the workers of a cluster run it, and a
recording that fails becomes a row that says why. `study` compares the rows.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from exo_gravity.core.errors import ExoGravityError
from exo_gravity.lab.bag.storage import kind_of
from exo_gravity.lab.parallel import Outcome
from exo_gravity.lab.trial.analysis import HoldCriteria, Recording, TrialAnalysis

SPEED_RATE = 50.0  # Hz, at which the speed of a movement is taken
HIGHEST = 10.0  # Hz, of a movement
LEAST = 0.05  # of the largest amplitude
PADDING = 4  # powers of two
COLUMNS = (
    "recording", "date", "subject", "protocol", "arm", "source", "mode", "support", "held", "verdict", "problem",
    "holds", "held_s", "wearer_share", "smoothness_sparc", "joint",
    "drift_deg_per_min", "drift_uncertainty_deg_per_min",
    "stray_in_10_s_deg", "moved_in_step_deg", "range_of_motion_deg", "rms_torque_nm", "wearer_share_of_joint",
)  # fmt: skip

Row = dict[str, Any]  # by COLUMNS; None where unknown


def recordings_below(path: Path) -> list[Path]:
    """Return the recordings in a folder and below, in order: folders with a bag's files."""
    files = (file for file in path.rglob("*") if kind_of(file) and file.is_file() and not file.name.startswith("."))
    return sorted({file.parent for file in files if not file.parent.name.startswith(".")})


def summary(path: str, criteria: HoldCriteria, min_hold: float, every: int) -> list[Row]:
    """Return the rows of a recording, for each arm and joint; of one that cannot be read, one with the `problem`.

    criteria, min_hold: see `trial_report.analyse`. every: see `read_bag`.
    """
    from exo_gravity.lab.bag.reader import read_bag
    from exo_gravity.lab.report import trial_report

    try:
        report = trial_report.analyse(read_bag(path, every), criteria, min_hold)
    except (ExoGravityError, OSError) as error:
        return [dict.fromkeys(COLUMNS) | {"recording": path, "problem": str(error)}]
    shared = {
        "recording": path,
        "date": f"{report.start:%Y-%m-%d %H:%M:%S}",
        "subject": report.bag.session.subject,
        "protocol": report.bag.session.protocol,
        "held": not report.failures,
        "verdict": report.verdict[0],
        "problem": "; ".join(report.bag.problems),
    }
    rows: list[Row] = []
    for recording, analysis in report.arms:
        # A session may end with other settings than those in which the arm was held.
        longest = max(analysis.holds, key=lambda hold: hold.duration, default=None)
        settings = report.settings[recording.name].at(longest.start if longest else math.inf)
        part = report.wearers.get(recording.name)
        of_arm = {
            **shared,
            "arm": recording.name,
            "source": report.bag.source(recording.name).value,
            "mode": settings.get("mode"),
            "support": None if settings.get("mode") == "one_g" else settings.get("support"),
            "holds": len(analysis.holds),
            "held_s": sum(hold.duration for hold in analysis.holds),
            "wearer_share": part and float(part.whole.value),
            "smoothness_sparc": smoothness(recording, analysis),
        }
        carried = recording.position[recording.is_carried]
        holds = analysis.holds
        for joint, name in enumerate(recording.joint_names):
            rates = [60.0 * np.degrees((h.drift_rate[joint], h.drift_rate_uncertainty[joint])) for h in holds]
            drift, uncertainty = max(rates, key=lambda rate: abs(rate[0]), default=(math.nan, math.nan))
            of_joint = {
                "joint": name,
                "drift_deg_per_min": float(drift),
                "drift_uncertainty_deg_per_min": float(uncertainty),
                "stray_in_10_s_deg": math.degrees(max((hold.stray[joint] for hold in holds), default=math.nan)),
                "moved_in_step_deg": math.degrees(
                    max((abs(release.offset[joint]) for release in analysis.releases), default=math.nan)
                ),
                "range_of_motion_deg": math.degrees(np.ptp(carried[:, joint])) if len(carried) else None,
                "rms_torque_nm": float(np.mean([hold.torque_rms[joint] for hold in holds])) if holds else None,
                "wearer_share_of_joint": part and float(part.joints.value[joint]),
            }
            row = dict.fromkeys(COLUMNS) | of_arm | of_joint
            unknown = {key: None for key, value in row.items() if isinstance(value, float) and not math.isfinite(value)}
            rows.append(row | unknown)
    return rows


def smoothness(recording: Recording, analysis: TrialAnalysis) -> float:
    """Return the median spectral arc length of the moves from pose to pose, of the length of the joints' speed; NaN."""
    found = []
    for motion in analysis.motions:
        if motion.kind == "move":
            time = np.arange(motion.start, motion.end, 1.0 / SPEED_RATE)
            angles = np.array([np.interp(time, recording.time, column) for column in recording.position.T])
            if len(time) > 1:
                speed = np.linalg.norm(np.diff(angles) * SPEED_RATE, axis=0)
                found.append(spectral_arc_length(speed, SPEED_RATE))
    return float(np.nanmedian(found)) if np.isfinite(found).any() else math.nan


def spectral_arc_length(speed: np.ndarray, rate: float) -> float:
    """Return the spectral arc length (SPARC) of a speed profile (n,) sampled at `rate` Hz; NaN where nothing moves.

    Balasubramanian, Melendez-Calderon, Roby-Brami and Burdet (2015), "On the analysis of movement smoothness", J.
    Neuroeng. Rehabil. 12:112: the length of the curve of the speed's normalised spectrum, up to the highest frequency
    below 10 Hz at which it reaches 5 %. A single bell-shaped movement has about -1.4; more negative is less smooth.
    """
    if len(speed) < 4 or not np.any(speed):
        return math.nan
    size = 2 ** (math.ceil(math.log2(len(speed))) + PADDING)
    frequency = np.arange(size // 2) * rate / size
    amplitude = np.abs(np.fft.fft(speed, size))[: size // 2]
    amplitude /= amplitude.max()
    low = frequency <= HIGHEST
    reached = np.flatnonzero(amplitude[low] >= LEAST)
    part = slice(reached[0], reached[-1] + 1)
    frequency, amplitude = frequency[low][part], amplitude[low][part]
    if len(frequency) < 2:
        return math.nan
    steps = np.diff(frequency) / (frequency[-1] - frequency[0])
    return -float(np.sum(np.hypot(steps, np.diff(amplitude))))


def summaries(
    recordings: Sequence[Path],
    work: Callable[[str], list[Row]],
    run: Callable[[Callable[[str], list[Row]], Sequence[str]], Iterable[Outcome[str, list[Row]]]],
    done: Callable[[], object],
) -> list[Row]:
    """Return the rows of the recordings in their order.

    work: `summary` with its arguments.
    run: yields the outcome of a function for each path, see `lab.parallel`.
    done: called for each recording that is finished.
    """
    found: dict[str, list[Row]] = {}
    paths = {str(recording.resolve()): str(recording) for recording in recordings}
    for outcome in run(work, [*paths]):
        path = outcome.item
        found[path] = outcome.result or [
            dict.fromkeys(COLUMNS) | {"recording": path, "problem": f"{path}: {outcome.problem}"}
        ]
        done()
    return [{**row, "recording": named} for path, named in paths.items() for row in found[path]]
