# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Observations from a recording: poses that were passed slowly in both directions give gravity and friction."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.content import TILT_TOPIC, Bag
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.bag.storage import Decoder, Storage
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.tracking import MOTION, Observation, Sweep, average
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.lab.trial.analysis import Recording


@dataclass(frozen=True)
class Detection:
    """What counts as a sweep there and back."""

    speed: tuple[float, float] = (0.008, 0.35)  #: rad/s: slower may stick, faster has inertia
    window: float = 0.2  #: s over which the speed is taken
    edge: float = 0.25  #: of the common way of two sweeps, left out at each end, where they turn
    least_way: float = 0.03  #: rad that each joint must turn in both directions
    longest_turn: float = 3.0  #: s between a sweep and the one back


DETECTION = Detection()


def observations_of(path: Path, arm: ConfiguredArm, model: MomentModel) -> list[Observation]:
    """Return the observations in the recording of `arm` at `path`: sweeps there and back.

    model: of the arm, which has its base frame.

    Raises DataError if there are none.
    """
    bag = read_bag(path)
    recording = recording_of(bag, arm)
    effort = np.where(np.isfinite(recording.command), recording.command, recording.effort)  # as commanded, where known
    recording = replace(recording, position=recording.position.astype(float), effort=effort)
    observations = list(_sweeps(recording, _down(bag, arm, model, recording.time)))
    if not observations:
        raise DataError(f"{path}: {arm.name} never passed a pose slowly there and back, all joints turning")
    return observations


def recording_of(bag: Bag, arm: ConfiguredArm) -> Recording:
    """Return the recording in `bag` that has the joints of `arm`, with its arrays in their order. Raises DataError."""
    recording = next((r for r in bag.recordings if sorted(r.joint_names) == sorted(arm.joint_names)), None)
    if recording is None:
        found = "; ".join(", ".join(r.joint_names) for r in bag.recordings)
        raise DataError(f"{bag.path}: the joints are {found}: must include {', '.join(arm.joint_names)}")
    return recording.in_order(arm.joint_names)


def _down(bag: Bag, arm: ConfiguredArm, model: MomentModel, times: np.ndarray) -> np.ndarray:
    """Return gravity's direction (n, 3) in the base frame at `times` (n,) s, from the trunk's tilts if it uses any."""
    if not arm.compensator["use_imu"]:
        return np.tile(model.down(Tilt.of(arm.side)), (len(times), 1))
    if not len(bag.tilt):
        raise DataError(f"{bag.path}: no samples of {TILT_TOPIC}, which gravity's direction comes from")
    components = np.array(list(map(model.down, tilts_of(bag, arm.side)))).T
    return np.stack([np.interp(times, bag.tilt[:, 0], component) for component in components], axis=1)


def tilts_of(bag: Bag, side: str) -> list[Tilt]:
    """Return the trunk's tilts of `bag.tilt`, for the `side` arm."""
    return [Tilt.of(side, pitch, roll) for _, pitch, roll in bag.tilt.tolist()]


def samples_of(path: Path, topic: str, msgtype: str) -> Iterator[np.ndarray]:
    """Yield the messages of `topic` in a recording, with their numbers as `layout.Decoder` names them.

    Raises DataError without any.
    """
    storage, decoder, found = Storage(path), Decoder(msgtype), False
    for rows in storage.rows(lambda name, kind: (name, kind) == (topic, msgtype)):
        for _, _, values in decoder.decode(rows):
            yield values
            found = True
    if not found:
        topics = decoder.problem or f"its topics: {', '.join(sorted(storage.topics)) or 'none'}"
        raise DataError(f"{path}: no samples of {topic} ({msgtype}); {topics}")


def _sweeps(recording: Recording, down: np.ndarray) -> Iterator[Observation]:
    """Yield an observation for every two runs one after the other in which all joints turn to and fro.

    It is what the middle of the way shows that both runs have in common.
    """
    time, position = recording.time, recording.position
    runs = [run for span in recording.while_carried(-math.inf, math.inf) for run in _runs(recording, *span)]
    used = 0  # samples: each run is used once
    for there, back in pairwise(runs):
        ends = position[[there.start, there.stop - 1, back.start, back.stop - 1]]
        way, way_back = ends[1] - ends[0], ends[3] - ends[2]
        is_late = time[back.start] - time[there.stop - 1] > DETECTION.longest_turn
        if there.start < used or is_late or np.any(way * way_back >= 0.0):
            continue
        low = np.maximum(ends[:2].min(axis=0), ends[2:].min(axis=0))
        high = np.minimum(ends[:2].max(axis=0), ends[2:].max(axis=0))
        middles = []
        for run in (there, back):
            is_inside = np.abs(position[run] - (low + high) / 2.0) <= (high - low) * (0.5 - DETECTION.edge)
            middles.append(np.flatnonzero(np.all(is_inside, axis=1)) + run.start)
        if np.any(high - low < DETECTION.least_way) or min(map(len, middles)) < 2 * MOTION.bins:
            continue
        used = back.stop
        speeds = [np.ptp(position[part[[0, -1]]], axis=0) / np.ptp(time[part]) for part in middles]
        seen, _ = average([Sweep(position[part], recording.effort[part], down[part]) for part in middles])
        yield seen._replace(friction=np.sign(way) * seen.friction, speed=np.mean(speeds, axis=0))


def _runs(recording: Recording, start: float, end: float) -> Iterator[slice]:
    """Yield the runs between `start` and `end` s in which every joint turns slowly without turning round."""
    first, beyond = np.searchsorted(recording.time, start), np.searchsorted(recording.time, end, "right")
    time, position = recording.time[first:beyond], recording.position[first:beyond]
    later = np.minimum(np.searchsorted(time, time + DETECTION.window), len(time) - 1)
    speed = (position[later] - position) / np.maximum(time[later] - time, 1e-3)[:, None]
    is_slow = np.all((np.abs(speed) >= DETECTION.speed[0]) & (np.abs(speed) <= DETECTION.speed[1]), axis=1)
    way = np.where(is_slow, np.sign(speed) @ 3.0 ** np.arange(speed.shape[1]), 0.5)
    edges = np.flatnonzero(np.diff(way, prepend=np.nan, append=np.nan) != 0.0)
    for low, high in pairwise(edges.tolist()):
        if is_slow[low] and high - low > 4 * MOTION.bins:
            yield slice(int(first) + low, int(first) + high)
