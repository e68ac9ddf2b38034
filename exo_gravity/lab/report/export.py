# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings -> data for other programs: one tidy table as CSV or Parquet, and a LeRobot dataset.

One recording at a time is in memory. The dataset has the layout of LeRobot's format v3.0
(https://huggingface.co/docs/lerobot/lerobot-dataset-v3), with a file for each episode.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow.csv import CSVWriter
from pyarrow.parquet import ParquetWriter, write_table

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.content import Bag
from exo_gravity.lab.report.trial_report import TIMESTAMP

FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
FILES = 1000  # in a folder
FEATURES = {  # each with what its numbers are, and the field of `Recording`
    "observation.state": ("pos", "position"),  # rad
    "observation.velocity": ("vel", "velocity"),  # rad/s
    "observation.effort": ("torque", "effort"),  # Nm, as measured
    "action": ("torque", "command"),  # Nm, as requested
}
INDICES = ("frame_index", "episode_index", "index", "task_index")
# The tasks' texts are the index of a pandas.DataFrame.
TASKS = {
    "pandas": json.dumps(
        {
            "index_columns": ["task"],
            "columns": [
                {
                    "name": "task",
                    "field_name": "task",
                    "pandas_type": "unicode",
                    "numpy_type": "object",
                    "metadata": None,
                }
            ],
            "column_indexes": [],
        }
    )
}


def write_time_series(path: Path, bags: Iterable[Bag]) -> None:
    """Write the columns of `Bag.columns` as one table, CSV or Parquet by the path's end; an unknown number is empty.

    A first column names the recording. Raises OSError.
    """
    with ExitStack() as stack:
        writer: Any = None
        for bag in bags:
            columns = {name: pa.array(column, from_pandas=True) for name, column in bag.columns().items()}
            table = pa.table({"recording": pa.repeat(str(bag.path), len(columns["arm"])), **columns})
            made = CSVWriter if path.suffix == ".csv" else ParquetWriter
            writer = writer or stack.enter_context(made(path, table.schema))
            writer.write_table(table)


def write_lerobot(folder: Path, bags: Iterable[Bag], rate: int) -> None:
    """Write recordings as a LeRobot dataset into a new folder: an episode each, of `rate` frames per s.

    An episode lasts while all arms of the recording have commands. Its task is the session's protocol, or the
    recording's name. Raises DataError for a recording without commands, or of other joints than the first.
    """
    if folder.exists():
        raise DataError(f"{folder}: a dataset is there already: move it away")
    episodes: list[dict[str, Any]] = []
    tasks: dict[str, int] = {}
    names: dict[str, list[str]] = {}
    total = 0
    for number, bag in enumerate(bags):
        joints, frames = _frames(bag, rate)
        names = names or joints
        if joints != names:
            raise DataError(f"{bag.path}: joints = {joints['action']}: must be {names['action']}, as in the others")
        place = {"chunk_index": number // FILES, "file_index": number % FILES}
        count, task = len(frames["action"]), bag.session.protocol or TIMESTAMP.sub("", bag.trial)
        task_index = tasks.setdefault(task, len(tasks))
        table: dict[str, Any] = {
            name: pa.FixedSizeListArray.from_arrays(values.astype(np.float32).ravel(), values.shape[1])
            for name, values in frames.items()
        }
        table["timestamp"] = (np.arange(count) / rate).astype(np.float32)
        indices = np.arange(count), np.full(count, number), np.arange(total, total + count), np.full(count, task_index)
        _write(folder / "data" / FILE.format(**place), {**table, **dict(zip(INDICES, indices, strict=True))})
        episodes.append({
            "episode_index": number, "tasks": [task], "length": count, "subject": bag.session.subject,
            **{f"data/{key}": value for key, value in place.items()},
            "dataset_from_index": total, "dataset_to_index": total + count,
            "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
            **{f"stats/{name}/count": [count] for name in frames},
            **{
                f"stats/{name}/{key}": getattr(values, key)(axis=0).tolist()
                for name, values in frames.items()
                for key in ("min", "max", "mean", "std")  # by which LeRobot normalises
            },
        })  # fmt: skip
        total += count
    columns = {key: [episode[key] for episode in episodes] for key in episodes[0]}
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(of)], "names": of} for name, of in names.items()
    }
    numbers = {"timestamp": "float32", **dict.fromkeys(INDICES, "int64")}
    features |= {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in numbers.items()}
    info = {
        "codebase_version": "v3.0", "robot_type": "exo_gravity", "total_episodes": len(episodes),
        "total_frames": total, "total_tasks": len(tasks), "chunks_size": FILES, "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200, "fps": rate, "splits": {"train": f"0:{len(episodes)}"},
        "data_path": f"data/{FILE}", "video_path": None, "features": features,
    }  # fmt: skip
    _write(folder / "meta/episodes" / FILE.format(chunk_index=0, file_index=0), columns)
    _write(folder / "meta/tasks.parquet", {"task_index": [*tasks.values()], "task": [*tasks]}, TASKS)
    (folder / "meta/info.json").write_text(json.dumps(info, indent=4), encoding="utf-8")
    stats = {name: _combined(columns, f"stats/{name}") for name in FEATURES}
    (folder / "meta/stats.json").write_text(json.dumps(stats, indent=4), encoding="utf-8")


def _frames(bag: Bag, rate: int) -> tuple[dict[str, list[str]], dict[str, np.ndarray]]:
    """Return the names of the numbers (k,) of each feature, and the numbers (frames, k) at `rate` Hz."""
    names: dict[str, list[str]] = {feature: [] for feature in FEATURES}
    times = [arm.time[np.isfinite(arm.command).all(axis=1)] for arm in bag.recordings]
    if not all(map(len, times)):
        raise DataError(f"{bag.path}: no commands were recorded, which are the actions of a LeRobot dataset")
    time = np.arange(max(known[0] for known in times), min(known[-1] for known in times), 1.0 / rate)
    frames: dict[str, np.ndarray] = {}
    for feature, (what, field) in FEATURES.items():
        columns = []
        for arm in bag.recordings:
            for joint, values in zip(arm.joint_names, getattr(arm, field).T, strict=True):
                known = np.isfinite(values)
                if not known.any():
                    raise DataError(f"{bag.path}: {joint} has no {field}, which a LeRobot dataset needs")
                names[feature].append(f"{joint if joint.startswith(arm.name) else f'{arm.name}_{joint}'}.{what}")
                columns.append(np.interp(time, arm.time[known], values[known]))
        frames[feature] = np.column_stack(columns)
    return names, frames


def _combined(columns: Mapping[str, Sequence[Any]], of: str) -> dict[str, list[float]]:
    """Return the statistics of all episodes from those of each."""
    low, high, mean, std, count = (np.array(columns[f"{of}/{key}"]) for key in ("min", "max", "mean", "std", "count"))
    middle = np.average(mean, axis=0, weights=count[:, 0])
    variance = np.average(std**2 + (mean - middle) ** 2, axis=0, weights=count[:, 0])
    found = {"min": low.min(axis=0), "max": high.max(axis=0), "mean": middle, "std": np.sqrt(variance)}
    return {**{key: column.tolist() for key, column in found.items()}, "count": [int(count.sum())]}


def _write(path: Path, columns: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_table(pa.table(dict(columns)).replace_schema_metadata(metadata), path)
