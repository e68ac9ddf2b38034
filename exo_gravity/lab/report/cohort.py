"""Many recordings -> one tidy table: a row for each recording, arm and joint.

`summary` is a pure function from a path to rows of plain values: a pool of processes runs it, and a recording that
fails becomes a row that says why. Rows are kept in a cache by the content of the recording, so that one that has not
changed is not read again.
"""

import csv
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from hashlib import blake2b
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from exo_gravity import version
from exo_gravity.core.errors import DataError, ExoGravityError
from exo_gravity.lab.bag.storage import Storage
from exo_gravity.lab.report.smoothness import spectral_arc_length
from exo_gravity.lab.report.table import shown
from exo_gravity.lab.trial.analysis import HoldCriteria, TrialAnalysis
from exo_gravity.lab.trial.recording import Recording

SUFFIXES = (".mcap", ".db3", ".zstd")
SPEED_RATE = 50.0  # Hz, at which the speed of a movement is taken
BLOCK = 2**22  # bytes that are hashed at once
SPAWNED = get_context("spawn")  # the progress bar has a thread, which a forked process would lack
COLUMNS = (
    "recording", "date", "subject", "protocol", "arm", "source", "mode", "support", "held", "verdict", "problem",
    "holds", "held_s", "wearer_share", "smoothness_sparc", "joint", "drift_deg_per_min", "stray_in_10_s_deg",
    "range_of_motion_deg", "rms_torque_nm",
)  # fmt: skip

Row = dict[str, Any]  # by COLUMNS; None where unknown


def recordings_below(path: Path) -> list[Path]:
    """Return the recordings in a folder and below, in order: folders with a bag's files."""
    files = (file for file in path.rglob("*") if file.suffix in SUFFIXES and not file.name.startswith("."))
    return sorted({file.parent for file in files if not file.parent.name.startswith(".")})


def summary(path: str, criteria: HoldCriteria, min_hold: float) -> list[Row]:
    """Return the rows of a recording, for each arm and joint; of one that cannot be read, one with the `problem`."""
    from exo_gravity.lab.bag.reader import read_bag
    from exo_gravity.lab.report import trial_report

    try:
        report = trial_report.analyse(read_bag(path), criteria, min_hold)
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
    rows = []
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
            row = dict.fromkeys(COLUMNS) | of_arm | of_joint
            rows.append({key: _plain(value) for key, value in row.items()})
    return rows


def _failed(path: str, problem: str) -> Row:
    return {**dict.fromkeys(COLUMNS), "recording": path, "problem": problem}


def _plain(value: Any) -> Any:
    """Return a value that JSON and CSV hold; None for a number that is unknown."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


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


class Cache:
    """Rows by the content of their recording and the criteria, in a file."""

    def __init__(self, path: Path, *settings: object) -> None:
        self._path, self._settings = path, repr((version(), COLUMNS, *settings))
        try:
            self._rows: dict[str, list[Row]] = dict(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):  # none yet, or damaged: everything is read again
            self._rows = {}

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

    def get(self, key: str, recording: Path) -> list[Row] | None:
        """Return the rows of a key, as those of the recording at this path; None if it is unknown."""
        rows = self._rows.get(key)
        return rows and [{**row, "recording": str(recording)} for row in rows]

    def put(self, key: str, rows: list[Row]) -> None:
        """Keep the rows of a key."""
        self._rows[key] = rows

    def save(self) -> None:
        """Write the file."""
        whole = self._path.with_suffix(".new")
        whole.write_text(json.dumps(self._rows), encoding="utf-8")
        whole.replace(self._path)


def summaries(
    recordings: Sequence[Path], criteria: HoldCriteria, min_hold: float, cache: Cache, done: Callable[[Path], None]
) -> tuple[list[Row], int]:
    """Return the rows of the recordings in their order, and how many were in the cache.

    done: called for each that is finished.
    """
    found: dict[Path, list[Row]] = {}
    keys: dict[Path, str] = {}
    for recording in recordings:
        try:
            keys[recording] = cache.key(recording)
        except (DataError, OSError) as error:
            found[recording] = [_failed(str(recording), str(error))]
        else:
            if (rows := cache.get(keys[recording], recording)) is not None:
                found[recording] = rows
        if recording in found:
            done(recording)
    known = sum(recording in keys for recording in found)
    for recording, rows in _in_processes([r for r in recordings if r not in found], criteria, min_hold):
        found[recording] = rows
        if rows[0]["verdict"]:  # what failed is tried again
            cache.put(keys[recording], rows)
            cache.save()
        done(recording)
    return [row for recording in recordings for row in found[recording]], known


def _in_processes(
    recordings: Sequence[Path], criteria: HoldCriteria, min_hold: float
) -> Iterator[tuple[Path, list[Row]]]:
    """Yield each recording with its rows, in the order in which they are finished.

    A process that dies, for want of memory, takes the pool with it: those that were unfinished then run one by one, and
    the one that ends its process again is the one that fails.
    """
    left = dict.fromkeys(recordings)
    try:
        with ProcessPoolExecutor(mp_context=SPAWNED) as pool:
            futures = {pool.submit(summary, str(path), criteria, min_hold): path for path in recordings}
            for future in _finished(futures):
                path, rows = futures[future], future.result()
                del left[path]
                yield path, rows
    except BrokenProcessPool:
        pass
    for path in left:
        try:
            with ProcessPoolExecutor(1, SPAWNED) as pool:
                yield path, pool.submit(summary, str(path), criteria, min_hold).result()
        except BrokenProcessPool:
            yield path, [_failed(str(path), f"{path}: the process that read it was ended, perhaps for want of memory")]


def _finished(futures: Iterable[Future[list[Row]]]) -> Iterator[Future[list[Row]]]:
    waiting = set(futures)
    while waiting:
        done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
        yield from done


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows as CSV; an unknown value is an empty cell. Raises OSError."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        for row in rows:
            writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})


def trials_of(rows: Iterable[Row]) -> list[Row]:
    """Return a row for each recording and arm, by subject and condition in order of date: the largest of its joints."""
    result = []
    for _, group in groupby(rows, lambda row: (row["recording"], row["arm"])):
        joints = list(group)
        largest = {
            key: max((abs(row[key]) for row in joints if row[key] is not None), default=None)
            for key in ("drift_deg_per_min", "stray_in_10_s_deg", "range_of_motion_deg")
        }
        result.append({**joints[0], **largest})
    return sorted(result, key=lambda row: [str(row[key] or "") for key in ("subject", "mode", "support", "date")])


def trends_of(trials: Iterable[Row]) -> Iterator[str]:
    """Yield, for each subject and condition with three trials or more, how the drift changes from one to the next."""
    known = [row for row in trials if row["drift_deg_per_min"] is not None]
    for _, group in groupby(sorted(known, key=_condition), lambda row: _condition(row)[:-1]):
        rows = list(group)
        drifts = [row["drift_deg_per_min"] for row in rows]
        if len(drifts) > 2:
            slope = float(np.polyfit(np.arange(len(drifts)), drifts, 1)[0])
            support = "" if rows[0]["support"] is None else f", support {100 * rows[0]['support']:g} %"
            of = f"{rows[0]['subject'] or 'no subject'}, {rows[0]['arm']}, {rows[0]['mode'] or 'unknown mode'}{support}"
            yield f"{of}: drift changes by {slope:+.3f} deg/min from one of {len(drifts)} trials to the next"


def _condition(row: Row) -> list[str]:
    return [str(row[key] or "") for key in ("subject", "source", "mode", "support", "arm", "date")]


def print_trials(trials: Sequence[Row], console: Console) -> None:
    """Print a table with a row for each trial, then the trends."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in ("Subject", "Condition", "Date", "Recording", "Arm", "Source"):
        table.add_column(heading)
    for heading in ("Holds", "Drift\ndeg/min", "Within 10 s\ndeg", "Range\ndeg", "SPARC", "Share\n%"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("Verdict")
    for row in trials:
        support = "" if row["support"] is None else f" {100 * row['support']:g} %"
        share = None if row["wearer_share"] is None else 100.0 * row["wearer_share"]
        numbers = (
            (row["drift_deg_per_min"], 2), (row["stray_in_10_s_deg"], 2), (row["range_of_motion_deg"], 0),
            (row["smoothness_sparc"], 2), (share, 0),
        )  # fmt: skip
        texts = (
            row["subject"], f"{row['mode'] or ''}{support}", row["date"], "/".join(Path(row["recording"]).parts[-2:]),
            row["arm"], row["source"], row["holds"],
        )  # fmt: skip
        table.add_row(
            *("" if text is None else escape(str(text)) for text in texts),
            *("–" if number is None else shown(number, digits) for number, digits in numbers),
            escape(row["verdict"] or row["problem"]),
        )
    console.print(table)
    for trend in trends_of(trials):
        console.print(escape(trend))
