"""The rows of the tools: training the ANFIS, an offline trial against real time, recordings against rosbags."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from exo_gravity.lab.anfis_training import from_gravload, train_law
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.report import trial_report
from exo_gravity.lab.trial.from_file import simulated_trials
from exo_gravity.sim.script import TrialScript

from .table import Row

TRAINING_LIMIT = 10.0  # s that a user waits without concern
JOINT_STATE = "sensor_msgs/msg/JointState"
RATE = 500  # Hz of the recording


def measure_work(quick: bool) -> Iterator[Row]:
    """Yield the rows of the tools."""
    repeats = 3 if quick else 5
    configured = configured_arm(None, "right")
    samples = from_gravload(configured)
    seconds = _timed(lambda: train_law(samples, configured.robot, 4), repeats)
    yield Row("ANFIS, training: limit", float(np.median(seconds)), TRAINING_LIMIT, "s", _range(seconds))

    speeds = [length / taken for length, taken in (_offline(60.0 if quick else 300.0) for _ in range(repeats))]
    yield Row("trial offline: real time", float(np.median(speeds)), 1.0, "x", _range(speeds), more_is_better=True)

    with tempfile.TemporaryDirectory() as folder:
        bag = _recording(Path(folder, "bag"), 30 if quick else 300)
        size = sum(file.stat().st_size for file in bag.iterdir()) / 1e6
        yield from _reading(Path(folder), 30 if quick else 120, repeats)
        ours = [size / taken for taken in _timed(lambda: _report(bag, Path(folder, "report")), repeats)]
        peer = [size / taken for taken in _timed(lambda: _read_all(bag), 1)]
    yield Row(
        "report, whole: rosbags reading the messages alone",
        float(np.median(ours)),
        peer[0],
        "MB/s",
        _range(ours),
        more_is_better=True,
    )


FORMS = {
    "MCAP": (StoragePlugin.MCAP, None),
    "MCAP, zstd": (StoragePlugin.MCAP, CompressionMode.STORAGE),
    "sqlite3": (StoragePlugin.SQLITE3, None),
}


def _reading(folder: Path, seconds: int, repeats: int) -> Iterator[Row]:
    """Yield a row for each storage: MB of messages in a second, here and by rosbags, in turn."""
    for number, (name, (plugin, compression)) in enumerate(FORMS.items()):
        bag = _recording(folder / f"form_{number}", seconds, plugin, compression)
        with Reader(bag) as reader:
            size = sum(len(data) for _, _, data in reader.messages()) / 1e6
        ours, peer = [], []
        for _ in range(repeats):
            ours += [size / taken for taken in _timed(partial(read_bag, bag), 1)]
            peer += [size / taken for taken in _timed(partial(_read_all, bag), 1)]
        row = f"reading, {name}: rosbags"
        yield Row(row, float(np.median(ours)), float(np.median(peer)), "MB/s", _range(ours), more_is_better=True)


def _timed(call: Callable[[], object], repeats: int) -> list[float]:
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        taken.append(time.perf_counter() - begin)
    return taken


def _range(values: list[float]) -> str:
    return f"{min(values):.3g} to {max(values):.3g}"


def _offline(hold: float) -> tuple[float, float]:
    """Return the simulated length of a trial on the right arm, and its run time, in s."""
    steps = [{"move": [0.1, 0.8, 0.7, 0.6], "over": 3.0}, {"hold": hold}]
    script = TrialScript.parse({"name": "bench", "steps": steps})
    params = packaged_config("sim.yaml")
    (trial,) = simulated_trials(params, script)
    begin = time.perf_counter()
    return float(trial.run().time[-1]), time.perf_counter() - begin


def _recording(
    path: Path, seconds: int, plugin: StoragePlugin = StoragePlugin.MCAP, compression: CompressionMode | None = None
) -> Path:
    """Write a rosbag2 with joint states and efforts of an arm that moves from pose to pose."""
    store = get_typestore(Stores.ROS2_JAZZY)
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    names = yaml.safe_load(packaged_config("sim.yaml").read_text())["/right/compensator"]["ros__parameters"]
    rng = np.random.default_rng(1)
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        states, commands = (
            writer.add_connection(f"/right/{topic}", JOINT_STATE, typestore=store)
            for topic in ("joint_states", "effort_commands")
        )
        for index in range(seconds * RATE):
            at = 1_700_000_000_000_000_000 + index * 1_000_000_000 // RATE
            when = header(stamp(at // 10**9, at % 10**9), "")
            moving = 0.3 * np.sin(min(index / RATE % 15.0, 3.0) * np.ones(4)) + 1e-4 * rng.standard_normal(4)
            for connection, arrays in ((states, (moving, np.zeros(4), moving)), (commands, ([], [], moving))):
                message = store.types[JOINT_STATE](when, names["joint_names"], *map(np.asarray, arrays))
                writer.write(connection, at, bytes(store.serialize_cdr(message, JOINT_STATE)))
    return path


def _report(bag: Path, folder: Path) -> None:
    trial_report.write(trial_report.analyse(read_bag(bag)), folder)


def _read_all(bag: Path) -> None:
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
