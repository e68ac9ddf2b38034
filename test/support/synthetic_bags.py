"""Recordings of known content for the tests of the tools: a synthetic trial, and bags of it written with rosbags."""

from __future__ import annotations

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
from exo_gravity.lab.bag.content import Bag
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.trial.recording import Recording, ScriptedStep

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"
START = 1_700_000_000_000_000_000  # ns
NAMES = ("right_joint_1", "right_joint_2", "right_joint_3", "right_joint_4")
POSES = [[0.1, 0.4, 0.5, 0.6], [-0.2, 0.8, 0.3, 0.9]]  # rad
PUSH = [0.05, 0.25, -0.15, 0.1]  # rad, by which the push moves each joint
ARM = ArmModel((0.05, 0.13, 0.3, 0.3), (0.03, 0.07, 0.15, 0.15), (0.6, 0.7, 0.6, 0.4))
POSITION_CODE, VELOCITY_CODE, TORQUE_CODE = 25 / 65535, 90 / 4095, 30 / 4095  # rad, rad/s, Nm

Entry = tuple[str, str, int, bytes]  # topic, type, time of arrival in ns, serialised message


def smooth(begin: np.ndarray, end: ArrayLike, seconds: float, rate: float = 500.0) -> np.ndarray:
    """Return a minimum-jerk motion, (n, 4)."""
    s = np.arange(round(seconds * rate))[:, None] / (seconds * rate)
    return begin + (np.asarray(end) - begin) * (10 * s**3 - 15 * s**4 + 6 * s**5)


def trial(
    poses: Iterable[ArrayLike],
    hold: float = 10.0,
    push: ArrayLike | None = None,
    drift: float = 0.0,
    rate: float = 500.0,
    fall_after: float = math.inf,
) -> Recording:
    """Return a trial in which the arm moves to each pose in 2 s and holds it for `hold` s.

    push: (4,) rad by which the arm is moved in 0.4 s after the first hold. drift: rad/s in every hold. rate: Hz.
    fall_after: s after which the arm falls.
    """
    pieces: list[np.ndarray] = []
    steps: list[ScriptedStep] = []
    pose, now = np.zeros(4), 0.0

    def add(action: str, piece: np.ndarray) -> None:
        nonlocal pose, now
        pieces.append(piece)
        pose, begin = piece[-1], now
        now += len(piece) / rate
        steps.append(ScriptedStep(action, begin, now))

    def held() -> np.ndarray:
        return pose + drift * np.arange(round(hold * rate))[:, None] / rate

    for number, target in enumerate(poses):
        add("move", smooth(pose, target, 2.0, rate))
        add("hold", held())
        if push is not None and number == 0:
            add("push", smooth(pose, pose + np.asarray(push), 0.4, rate))
            add("hold", held())
    exact = np.concatenate(pieces)
    time = np.arange(len(exact)) / rate
    return _measured(time, exact * np.exp(-2.0 * np.maximum(time - fall_after, 0.0))[:, None], tuple(steps))


def _measured(time: np.ndarray, exact: np.ndarray, steps: tuple[ScriptedStep, ...]) -> Recording:
    """Return what motors measure of the angles `exact` (n, 4) in rad: noisy and quantised."""
    rng = np.random.default_rng(1)
    position = np.round((exact + 2e-4 * rng.standard_normal(exact.shape)) / POSITION_CODE) * POSITION_CODE
    velocity = (np.round(np.gradient(exact, time, axis=0) / VELOCITY_CODE - 0.5) + 0.5) * VELOCITY_CODE
    command = gravity_torque(ARM, exact)
    noisy = command + 0.02 * rng.standard_normal(command.shape)
    effort = (np.round(noisy / TORQUE_CODE - 0.5) + 0.5) * TORQUE_CODE
    return Recording("right", NAMES, time, position, velocity, effort, command, steps)


def joint_state(
    stamp: int,
    names: Iterable[str],
    position: ArrayLike = (),
    velocity: ArrayLike = (),
    effort: ArrayLike = (),
    frame: str = "",
) -> bytes:
    """Return a serialised sensor_msgs/JointState; `stamp` in ns."""
    types = STORE.types
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=frame
    )
    fields = (np.ascontiguousarray(values, dtype=float) for values in (position, velocity, effort))
    return bytes(STORE.serialize_cdr(types[JOINT_STATE](header, list(names), *fields), JOINT_STATE))


def string(text: str) -> bytes:
    """Return a serialised std_msgs/String."""
    return bytes(STORE.serialize_cdr(STORE.types[STRING](data=text), STRING))


def messages(recording: Recording, command_names: Sequence[str] | None = None, script: bool = True) -> Iterator[Entry]:
    """Yield the messages of a recording in their order of arrival.

    command_names: of the joints in the efforts, where they differ. script: whether the wearer's steps are published.
    """
    prefix = f"/{recording.name}"
    steps = [(START + round(step.start * 1e9), index, step) for index, step in enumerate(recording.steps)]
    for k, time in enumerate(recording.time):
        stamp = START + round(float(time) * 1e9)
        while script and steps and steps[0][0] <= stamp:
            at, index, step = steps.pop(0)
            content = {"step": index, "action": step.action, "duration": step.end - step.start}
            yield f"{prefix}/wearer_step", STRING, at, string(json.dumps(content))
        arrays = (recording.position[k], recording.velocity[k], recording.effort[k])
        state = joint_state(stamp, recording.joint_names, *arrays)
        yield f"{prefix}/joint_states", JOINT_STATE, stamp + 200_000, state
        command = joint_state(stamp, command_names or recording.joint_names, effort=recording.command[k])
        yield f"{prefix}/effort_commands", JOINT_STATE, stamp + 500_000, command


def write_bag(
    folder: Path,
    content: Iterable[Entry],
    plugin: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode | None = None,
    topics: Iterable[tuple[str, str]] = (),
) -> Path:
    """Write a bag with rosbags and return its folder; `topics` (topic, type) exist even without messages."""
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=STORE) for topic, kind in topics}
        for topic, kind, stamp, data in content:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], stamp, data)
    return folder


def bag_of(*recordings: Recording, **more: Any) -> Bag:
    """Return a bag with these recordings, not read from a file; `more` are its other fields."""
    empty: dict[str, Any] = {"events": (), "parameters": {}, "notes": (), "problems": ()}
    return Bag(Path("demo"), START, recordings, **{**empty, **more})


def only(path: Path) -> Recording:
    """Return the recording of the only arm in the bag at `path`."""
    (recording,) = read_bag(path).recordings
    return recording


def assert_same(read: Recording, written: Recording, count: int | None = None) -> None:
    """The arrays that were read are the first `count` rows of those that were written."""
    assert read.name == written.name and read.joint_names == written.joint_names
    for field in ("position", "velocity", "effort"):
        np.testing.assert_allclose(getattr(read, field), getattr(written, field)[:count], rtol=1e-6)
