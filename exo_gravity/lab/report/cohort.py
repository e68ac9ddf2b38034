# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Many recordings -> tidy rows: one for each recording, arm and joint.

`summary` is a pure function from a path to rows of plain values: processes or the workers of a cluster run it, and a
recording that fails becomes a row that says why. Rows are kept in a cache by the content of the recording, so that one
that has not changed is not read again. `overview` shows the rows.
"""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from exo_gravity import version
from exo_gravity.core.errors import DataError, ExoGravityError
from exo_gravity.lab.bag.storage import REPAIRED, Storage, kind_of
from exo_gravity.lab.parallel import Outcome
from exo_gravity.lab.trial.analysis import HoldCriteria, TrialAnalysis
from exo_gravity.lab.trial.recording import Recording

SPEED_RATE = 50.0  # Hz, at which the speed of a movement is taken
BLOCK = 2**22  # bytes that are hashed at once
HIGHEST = 10.0  # Hz, of a movement
LEAST = 0.05  # of the largest amplitude
PADDING = 4  # powers of two
COLUMNS = (
    "recording", "date", "subject", "protocol", "arm", "source", "mode", "support", "held", "verdict", "problem",
    "holds", "held_s", "wearer_share", "smoothness_sparc", "joint", "drift_deg_per_min", "stray_in_10_s_deg",
    "range_of_motion_deg", "rms_torque_nm", "wearer_share_of_joint",
)  # fmt: skip

Row = dict[str, Any]  # by COLUMNS; None where unknown
Summaries = Iterable[Outcome[str, list[Row]]]


@dataclass(frozen=True)
class Judging:
    """How recordings are read and judged."""

    criteria: HoldCriteria
    min_hold: float  #: s
    every: int  #: see `read_bag`


def recordings_below(path: Path) -> list[Path]:
    """Return the recordings in a folder and below, in order: folders with a bag's files.

    Copies that `report --repair` wrote are left out where what they are copies of is there.
    """
    files = (file for file in path.rglob("*") if kind_of(file) and file.is_file() and not file.name.startswith("."))
    folders = {file.parent for file in files if not file.parent.name.startswith(".")}
    repaired = {folder for folder in folders if folder.name.endswith(REPAIRED)}
    copies = {f for f in repaired if folders & {f.parent, f.with_name(f.name.removesuffix(REPAIRED))}}
    return sorted(folders - copies)


def summary(path: str, judging: Judging) -> list[Row]:
    """Return the rows of a recording, for each arm and joint; of one that cannot be read, one with the `problem`."""
    from exo_gravity.lab.bag.reader import read_bag
    from exo_gravity.lab.report import trial_report

    try:
        report = trial_report.analyse(read_bag(path, judging.every), judging.criteria, judging.min_hold)
    except (ExoGravityError, OSError) as error:
        return [_failed(path, str(error))]
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
        settings = report.settings[recording.name].at(math.inf)
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
        for joint, name in enumerate(recording.joint_names):
            of_joint = {"joint": name, **_of_joint(recording, analysis, joint)}
            of_joint["wearer_share_of_joint"] = part and float(part.joints.value[joint])
            row = dict.fromkeys(COLUMNS) | of_arm | of_joint
            unknown = {key: None for key, value in row.items() if isinstance(value, float) and not math.isfinite(value)}
            rows.append(row | unknown)  # JSON has no NaN
    return rows


def _failed(path: str, problem: str) -> Row:
    return {**dict.fromkeys(COLUMNS), "recording": path, "problem": problem}


def _of_joint(recording: Recording, analysis: TrialAnalysis, joint: int) -> Row:
    """Return drift (largest), stray, range of motion while carried, and torque of a joint."""
    spans = list(recording.while_carried(-math.inf, math.inf))
    time, position = recording.time, recording.position[:, joint]
    inside = [position[slice(*np.searchsorted(time, span))] for span in spans]
    carried = np.concatenate(inside) if inside else position[:0]
    holds = analysis.holds
    return {
        "drift_deg_per_min": math.degrees(60.0 * max((h.drift_rate[joint] for h in holds), key=abs, default=math.nan)),
        "stray_in_10_s_deg": math.degrees(max((h.stray[joint] for h in holds), default=math.nan)),
        "range_of_motion_deg": math.degrees(float(np.ptp(carried))) if len(carried) else None,
        "rms_torque_nm": float(np.mean([hold.torque_rms[joint] for hold in holds])) if holds else None,
    }


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


class Cache:
    """Rows by the content of their recording and how it is judged: a line of JSON for each in a file."""

    def __init__(self, path: Path, judging: Judging) -> None:
        self._path, self._settings = path, repr((version(), COLUMNS, judging))
        self.rows: dict[str, list[Row]] = {}
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
            try:
                key, rows = json.loads(line)
                self.rows[key] = [dict(row) for row in rows]
            except (ValueError, TypeError):  # a line that was cut off: that recording is read again
                continue

    def key(self, recording: Path) -> str:
        """Return the key of a recording's content. Raises DataError or OSError if it cannot be read."""
        digest = blake2b(self._settings.encode(), digest_size=16)
        metadata = [path] if (path := recording / "metadata.yaml").is_file() else []
        for file in (*metadata, *Storage(recording).files):
            digest.update(f"{file.name}\0{file.stat().st_size}\0".encode())
            with file.open("rb") as stream:
                while block := stream.read(BLOCK):
                    digest.update(block)
        return digest.hexdigest()

    def put(self, key: str, rows: list[Row]) -> None:
        """Keep the rows of a key."""
        self.rows[key] = rows
        with self._path.open("a", encoding="utf-8") as file:
            file.write(f"{json.dumps([key, rows])}\n")


def summaries(
    recordings: Sequence[Path],
    judging: Judging,
    cache: Cache,
    run: Callable[[Callable[[str], list[Row]], Sequence[str]], Summaries],
    done: Callable[[], object],
) -> tuple[list[Row], int]:
    """Return the rows of the recordings in their order, and how many were in the cache.

    run: yields the outcome of a function for each path, see `lab.parallel`.
    done: called for each recording that is finished.
    """
    found: dict[str, list[Row]] = {}
    keys: dict[str, str] = {}
    paths = {str(recording.resolve()): recording for recording in recordings}
    for path, recording in paths.items():
        try:
            keys[path] = cache.key(recording)
        except (DataError, OSError) as error:
            found[path] = [_failed(path, str(error))]
        else:
            if keys[path] in cache.rows:
                found[path] = cache.rows[keys[path]]
        if path in found:
            done()
    known = sum(path in keys for path in found)
    for outcome in run(partial(summary, judging=judging), [path for path in paths if path not in found]):
        path = outcome.item
        found[path] = outcome.result or [_failed(path, f"{path}: {outcome.problem}")]
        if found[path][0]["verdict"]:  # what failed is tried again
            cache.put(keys[path], found[path])
        done()
    return [{**row, "recording": str(named)} for path, named in paths.items() for row in found[path]], known
