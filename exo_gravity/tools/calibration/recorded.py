"""Observations from a recording: poses that were passed slowly in both directions, and poses that were held.

A pose that was passed there and back gives gravity and friction. A held pose gives gravity to within friction only: the
arm would stay with any torque inside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from exo_gravity.bag.reader import read_bag
from exo_gravity.bag.storage import Storage
from exo_gravity.core.calibration.identification import Observation
from exo_gravity.core.calibration.motion import BINS, average
from exo_gravity.core.errors import DataError
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.trial.recording import Recording, in_blocks, still_spans
from exo_gravity.tools.inputs.arms import ConfiguredArm

TILT_TOPIC, TILT_TYPE = "/imu/pitch_yaw", "geometry_msgs/msg/Vector3Stamped"
SPEED = (0.008, 0.35)  # rad/s: slower is held, faster has inertia
SMOOTHING = 0.2  # s over which the speed is taken
EDGE = 0.25  # of the common way of two sweeps, left out at each end, where they turn
LEAST_WAY = 0.03  # rad that each joint must turn in both directions
LONGEST_TURN = 3.0  # s between a sweep and the one back
HELD_TIME = 1.0  # s
UNKNOWN_FRICTION = 0.4  # Nm, of a joint of which no sweep was recorded


def observations_of(path: Path, arm: ConfiguredArm, with_held: bool = True) -> list[Observation]:
    """Return the observations in the recording of `arm` at `path`: sweeps there and back, and poses held.

    with_held: False for sweeps alone, which show friction. Raises DataError if there are none.
    """
    recording, tilts = _recorded(path, arm)
    observations = list(_sweeps(recording, arm, tilts))
    if with_held:
        observations += list(_held(recording, arm, tilts, observations))
    if not observations:
        held = f", or held one for {HELD_TIME:g} s" if with_held else ""
        raise DataError(f"{path}: {arm.name} never passed a pose slowly there and back, all joints turning{held}")
    return observations


def _recorded(path: Path, arm: ConfiguredArm) -> tuple[Recording, np.ndarray | None]:
    """Return the recording of `arm`, and the trunk's tilts (n, 3), None where it uses none.

    The columns are time in s, pitch and roll in rad.
    """
    bag = read_bag(path)
    found = [recording for recording in bag.recordings if recording.name == arm.name]
    if not found:
        names = ", ".join(recording.name for recording in bag.recordings)
        raise DataError(f"{path}: no arm {arm.name}; it has {names}")
    tilts = None
    if arm.compensator["use_imu"]:
        vectors = ((stamp, message.vector) for stamp, message in messages_of(path, TILT_TOPIC, TILT_TYPE))
        tilts = np.array([((stamp - bag.start) / 1e9, vector.y, vector.x) for stamp, vector in vectors])
    return _in_order_of(found[0], arm), tilts


def _in_order_of(recording: Recording, arm: ConfiguredArm) -> Recording:
    order = [recording.joint_names.index(name) for name in arm.joint_names if name in recording.joint_names]
    if len(order) != len(arm.joint_names):
        raise DataError(f"joints = {', '.join(recording.joint_names)}: must be {', '.join(arm.joint_names)}")
    fields = ("position", "velocity", "effort", "command")
    columns = {name: getattr(recording, name)[:, order] for name in fields}
    return replace(recording, joint_names=arm.joint_names, **columns)


def messages_of(path: Path, topic: str, msgtype: str) -> Iterator[tuple[int, Any]]:
    """Yield stamp in ns and message of each message of `topic` in a recording. Raises DataError if there are none."""
    storage, types = Storage(path), get_typestore(Stores.ROS2_JAZZY)
    found = False
    for *_, stamp, data in storage.messages(lambda name, kind: (name, kind) == (topic, msgtype)):
        try:
            yield stamp, types.deserialize_cdr(data, msgtype)
        except (SerdeError, ValueError) as error:
            raise DataError(f"{path}: {topic}: {error}") from None
        found = True
    if not found:
        topics = ", ".join(sorted(storage.topics)) or "none"
        raise DataError(f"{path}: no samples of {topic} ({msgtype}); its topics: {topics}")


def _direction(arm: ConfiguredArm, tilts: np.ndarray | None, start: float, end: float) -> np.ndarray:
    """Return gravity's mean direction (3,) in the base frame between `start` and `end` s."""
    if tilts is None:
        return np.array(Tilt.of(arm.side).direction)
    chosen = tilts[(tilts[:, 0] >= start) & (tilts[:, 0] <= end)]
    nearest = chosen if len(chosen) else tilts[[np.argmin(np.abs(tilts[:, 0] - start))]]
    return np.array(Tilt.of(arm.side, *nearest[:, 1:].mean(axis=0)).direction)


def _effort(recording: Recording, part: slice | np.ndarray) -> np.ndarray:
    """Return the effort (n, 4) of a part: as commanded, where it is known, else as measured."""
    commanded, measured = recording.command[part], recording.effort[part]
    return np.where(np.isfinite(commanded), commanded, measured)


def _sweeps(recording: Recording, arm: ConfiguredArm, tilts: np.ndarray | None) -> Iterator[Observation]:
    """Yield an observation for every two runs one after the other in which all joints turn to and fro."""
    runs = [run for span in recording.while_carried(-math.inf, math.inf) for run in _runs(recording, *span)]
    last_end = -math.inf
    for there, back in pairwise(runs):
        way = [recording.position[run.stop - 1] - recording.position[run.start] for run in (there, back)]
        turn = recording.time[back.start] - recording.time[there.stop - 1]
        if np.any(way[0] * way[1] >= 0.0) or turn > LONGEST_TURN:
            continue
        if recording.time[there.start] < last_end:
            continue  # each run is used once
        direction = _direction(arm, tilts, *recording.time[[there.start, back.stop - 1]])
        if observation := _there_and_back(recording, there, back, direction):
            last_end = recording.time[back.stop - 1]
            yield observation


def _runs(recording: Recording, start: float, end: float) -> Iterator[slice]:
    """Yield the runs between `start` and `end` s in which every joint turns slowly without turning round."""
    inside = np.flatnonzero((recording.time >= start) & (recording.time <= end))
    if len(inside) < 2:
        return
    first, beyond = int(inside[0]), int(inside[-1]) + 1
    time, position = recording.time[first:beyond], recording.position[first:beyond].astype(float)
    later = np.minimum(np.searchsorted(time, time + SMOOTHING), len(time) - 1)
    speed = (position[later] - position) / np.maximum(time[later] - time, 1e-3)[:, None]
    is_slow = np.all((np.abs(speed) >= SPEED[0]) & (np.abs(speed) <= SPEED[1]), axis=1)
    way = np.where(is_slow, np.sign(speed) @ (27, 9, 3, 1), 0.5)
    edges = np.flatnonzero(np.diff(way, prepend=np.nan, append=np.nan) != 0.0)
    for low, high in pairwise(edges):
        if is_slow[low] and high - low > 4 * BINS:
            yield slice(first + int(low), first + int(high))


def _there_and_back(recording: Recording, there: slice, back: slice, direction: np.ndarray) -> Observation | None:
    """Return what is seen in the middle of the way that both runs have in common; None if that is short."""
    position = recording.position.astype(float)
    spans = [np.sort(position[[run.start, run.stop - 1]], axis=0) for run in (there, back)]
    low, high = np.maximum(spans[0][0], spans[1][0]), np.minimum(spans[0][1], spans[1][1])
    if np.any(high - low < LEAST_WAY):
        return None
    middle, reach = (low + high) / 2.0, (high - low) * (0.5 - EDGE)
    sweeps, speeds = [], []
    for run in (there, back):
        inside = np.flatnonzero(np.all(np.abs(position[run] - middle) <= reach, axis=1)) + run.start
        if len(inside) < 2 * BINS:
            return None
        ends = inside[[0, -1]]
        speeds.append(np.abs(np.diff(position[ends], axis=0)[0]) / np.diff(recording.time[ends]))
        sweeps.append((position[inside], _effort(recording, inside).astype(float)))
    result = average(sweeps)
    sign = np.sign(position[there.stop - 1] - position[there.start])
    speed = np.mean(speeds, axis=0)
    return Observation(result.theta, direction, result.effort, sign * result.friction, result.spread, speed=speed)


def _held(
    recording: Recording, arm: ConfiguredArm, tilts: np.ndarray | None, sweeps: list[Observation]
) -> Iterator[Observation]:
    """Yield an observation for every pose that was held, as uncertain as the friction of `sweeps`."""
    friction = np.median([s.friction for s in sweeps], axis=0) if sweeps else np.full(4, UNKNOWN_FRICTION)
    for start, end in still_spans(recording, in_blocks(recording)):
        if end - start < HELD_TIME:
            continue
        part = (recording.time >= start) & (recording.time <= end)
        effort = _effort(recording, part)
        spread = np.hypot(np.abs(friction) / math.sqrt(3.0), effort.std(axis=0))
        theta = recording.position[part].mean(axis=0)
        yield Observation(theta, _direction(arm, tilts, start, end), effort.mean(axis=0), np.abs(friction), spread)
