# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings of known content: what motors measure of a known motion, its messages, and bags of them, by rosbags."""

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.lab.bag.content import TILT_TOPIC, TILT_TYPE, Bag
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.trial.analysis import Recording, ScriptedStep, Span

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"
START = 1_700_000_000_000_000_000  # ns
NAMES = ("right_joint_1", "right_joint_2", "right_joint_3", "right_joint_4")
POSES = [[0.1, 0.4, 0.5, 0.6], [-0.2, 0.8, 0.3, 0.9]]  # rad
PUSH = [0.05, 0.25, -0.15, 0.1]  # rad, by which the push moves each joint
ARM = ArmModel((0.05, 0.13, 0.3, 0.3), (0.03, 0.07, 0.15, 0.15), (0.6, 0.7, 0.6, 0.4))
POSITION_CODE, VELOCITY_CODE, TORQUE_CODE = 25 / 65535, 90 / 4095, 30 / 4095  # rad, rad/s, Nm
RATE = 500.0  # Hz

Entry = tuple[str, str, int, bytes]  # topic, type, time of arrival in ns, serialised message


# Motions and what is measured of them


def smooth(begin: ArrayLike, end: ArrayLike, seconds: float, rate: float = RATE) -> np.ndarray:
    """Return a minimum-jerk motion, (n, joints) rad."""
    s = np.arange(round(seconds * rate))[:, None] / (seconds * rate)
    return np.asarray(begin) + np.subtract(end, begin) * (10 * s**3 - 15 * s**4 + 6 * s**5)


def still(pose: ArrayLike, seconds: float, drift: ArrayLike = 0.0, rate: float = RATE) -> np.ndarray:
    """Return a pose that drifts by `drift` (rad/s, one number or one for each joint), (n, joints) rad."""
    return np.asarray(pose) + np.arange(round(seconds * rate))[:, None] / rate * np.asarray(drift)


def measured(
    exact: np.ndarray,
    *,
    rate: float = RATE,
    noise: float = 0.0,
    effort: np.ndarray | None = None,
    command: np.ndarray | None = None,
    steps: Sequence[ScriptedStep] = (),
    carried: Sequence[Span] | None = None,
) -> Recording:
    """Return what motors measure of the angles `exact` (n, joints) rad: quantised, with no velocity of 0.

    noise: rad.
    effort, command: (n, joints) Nm; 1 Nm, and as the effort, where they are not given.
    """
    time = np.arange(len(exact)) / rate
    noisy = exact + noise * np.random.default_rng(1).standard_normal(exact.shape)
    position = (np.round(noisy / POSITION_CODE) * POSITION_CODE).astype(np.float32)
    velocity = np.round(np.gradient(exact, time, axis=0) / VELOCITY_CODE - 0.5) + 0.5
    effort = np.ones_like(exact) if effort is None else effort
    command = effort if command is None else command
    spans = None if carried is None else tuple(carried)
    return Recording("right", NAMES, time, position, velocity * VELOCITY_CODE, effort, command, tuple(steps), spans)


def trial(
    poses: Iterable[ArrayLike],
    hold: float = 10.0,
    push: ArrayLike | None = None,
    drift: float = 0.0,
    rate: float = RATE,
    fall_after: float = math.inf,
) -> Recording:
    """Return a trial in which the arm moves to each pose in 2 s and holds it for `hold` s.

    push: (joints,) rad by which the arm is moved in 0.4 s after the first hold.
    drift: rad/s in every hold.
    rate: Hz.
    fall_after: s after which the arm falls.
    """
    pieces: list[np.ndarray] = []
    steps: list[ScriptedStep] = []
    pose, now = np.zeros(len(NAMES)), 0.0

    def add(action: str, piece: np.ndarray) -> None:
        nonlocal pose, now
        pieces.append(piece)
        pose, begin = piece[-1], now
        now += len(piece) / rate
        steps.append(ScriptedStep(action, begin, now))

    for number, target in enumerate(poses):
        add("move", smooth(pose, target, 2.0, rate))
        add("hold", still(pose, hold, drift, rate))
        if push is not None and number == 0:
            add("push", smooth(pose, pose + np.asarray(push), 0.4, rate))
            add("hold", still(pose, hold, drift, rate))
    exact = np.concatenate(pieces)
    fallen = exact * np.exp(-2.0 * np.maximum(np.arange(len(exact)) / rate - fall_after, 0.0))[:, None]
    command = gravity_torque(ARM, fallen)
    noisy = command + 0.02 * np.random.default_rng(2).standard_normal(command.shape)
    effort = (np.round(noisy / TORQUE_CODE - 0.5) + 0.5) * TORQUE_CODE
    return measured(fallen, rate=rate, noise=2e-4, effort=effort, command=command, steps=steps)


# Messages


def serialised(kind: str, *fields: Any) -> bytes:
    """Return a message of the type `kind` in CDR."""
    return bytes(STORE.serialize_cdr(STORE.types[kind](*fields), kind))


def header(stamp: int = 0, frame: str = "") -> Any:
    """Return a std_msgs/Header; `stamp` in ns."""
    time = STORE.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return STORE.types["std_msgs/msg/Header"](time, frame)


def joint_state(
    stamp: int,
    names: Iterable[str],
    position: ArrayLike = (),
    velocity: ArrayLike = (),
    effort: ArrayLike = (),
    frame: str = "",
) -> bytes:
    """Return a serialised sensor_msgs/JointState; `stamp` in ns."""
    fields = (np.ascontiguousarray(values, dtype=float) for values in (position, velocity, effort))
    return serialised(JOINT_STATE, header(stamp, frame), list(names), *fields)


def text_entry(topic: str, seconds: float, text: str) -> Entry:
    """Return a std_msgs/String that arrives `seconds` s after START."""
    return topic, STRING, START + round(seconds * 1e9), serialised(STRING, text)


def status(seconds: float, text: str, level: int = 0, **values: str) -> Entry:
    """Return the right bridge's diagnostics, which arrive `seconds` s after START."""
    types = STORE.types
    pairs = [types["diagnostic_msgs/msg/KeyValue"](key, value) for key, value in values.items()]
    entry = types["diagnostic_msgs/msg/DiagnosticStatus"](level, "right/can_bridge", text, "", pairs)
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    return "/diagnostics", kind, START + round(seconds * 1e9), serialised(kind, header(), [entry])


def tilt(seconds: float, pitch: float, roll: float = 0.0) -> Entry:
    """Return the trunk's tilt in rad, which arrives `seconds` s after START."""
    vector = STORE.types["geometry_msgs/msg/Vector3"](roll, pitch, 0.0)
    return TILT_TOPIC, TILT_TYPE, START + round(seconds * 1e9), serialised(TILT_TYPE, header(), vector)


def messages(recording: Recording, command_names: Sequence[str] | None = None, script: bool = True) -> Iterator[Entry]:
    """Yield the messages of a recording in their order of arrival.

    command_names: of the joints in the efforts, where they differ.
    script: whether the wearer's steps are published.
    """
    prefix = f"/{recording.name}"
    steps = [(START + round(step.start * 1e9), index, step) for index, step in enumerate(recording.steps)]
    for k, time in enumerate(recording.time):
        stamp = START + round(float(time) * 1e9)
        while script and steps and steps[0][0] <= stamp:
            at, index, step = steps.pop(0)
            content = {"step": index, "action": step.action, "duration": step.end - step.start}
            yield f"{prefix}/wearer_step", STRING, at, serialised(STRING, json.dumps(content))
        arrays = (recording.position[k], recording.velocity[k], recording.effort[k])
        state = joint_state(stamp, recording.joint_names, *arrays)
        yield f"{prefix}/joint_states", JOINT_STATE, stamp + 200_000, state
        command = joint_state(stamp, command_names or recording.joint_names, effort=recording.command[k])
        yield f"{prefix}/effort_commands", JOINT_STATE, stamp + 500_000, command


# Bags


def write_bag(
    folder: Path,
    content: Iterable[Entry],
    plugin: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode | None = None,
    topics: Iterable[tuple[str, str]] = (),
    is_sorted: bool = True,
) -> Path:
    """Write a bag with rosbags; return its folder.

    topics: topic and type of those that exist even without messages. is_sorted: in the order of arrival, not as given.
    """
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=STORE) for topic, kind in topics}
        for topic, kind, stamp, data in sorted(content, key=lambda entry: entry[2] if is_sorted else 0):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], stamp, data)
    return folder


def cut(file: Path, share: float) -> Path:
    """Keep the first `share` of a file, as a killed process leaves it; return it."""
    file.write_bytes(file.read_bytes()[: round(share * file.stat().st_size)])
    return file


def bag_of(*recordings: Recording, **more: Any) -> Bag:
    """Return a bag with these recordings, not read from a file; `more` are its other fields."""
    empty: dict[str, Any] = {"events": (), "parameters": {}, "notes": (), "problems": ()}
    return Bag(Path("demo"), START, recordings, **{**empty, **more})


def only(path: Path) -> Recording:
    (recording,) = read_bag(path).recordings
    return recording


def assert_same(read: Recording, written: Recording, count: int | None = None) -> None:
    """The arrays that were read are the first `count` rows of those that were written."""
    assert read.name == written.name and read.joint_names == written.joint_names
    for field in ("position", "velocity", "effort"):
        np.testing.assert_allclose(getattr(read, field), getattr(written, field)[:count], rtol=1e-6)
