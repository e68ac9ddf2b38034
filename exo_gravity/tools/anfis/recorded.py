"""Samples for an ANFIS from a recording: the mean measured torque of each hold of a rosbag2.

A measured torque lacks the part that stiction carries, so approach each pose from both sides. Torques are in Nm at
gain 1, not scaled. Every fifth hold is held out.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from exo_gravity.bag.reader import read_bag
from exo_gravity.bag.storage import Storage
from exo_gravity.core.errors import DataError
from exo_gravity.core.model.anfis import INPUTS, UPRIGHT, scaled
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.trial.analysis import analyse
from exo_gravity.core.trial.recording import Recording
from exo_gravity.tools.anfis.data import Samples
from exo_gravity.tools.inputs.arms import ConfiguredArm

HELD_OUT = 5  # every fifth hold
TILT_TOPIC, TILT_TYPE = "/imu/pitch_yaw", "geometry_msgs/msg/Vector3Stamped"


def from_bag(path: str | Path, configured: ConfiguredArm, functions: int) -> Samples:
    """Return the mean measured torque of each hold of a rosbag2 during which the trunk was upright.

    The box spans the held poses within the joint limits. Raises DataError, one sentence, if they are too few for
    `functions` membership functions per input.
    """
    bag = read_bag(path)
    names = {recording.name: recording for recording in bag.recordings}
    recording = names.get(configured.side) or (next(iter(names.values())) if len(names) == 1 else None)
    if recording is None:
        raise DataError(f"{path}: the arms are {', '.join(names)}: must include {configured.side}")
    if sorted(recording.joint_names) != sorted(configured.joint_names):
        expected = ", ".join(configured.joint_names)
        raise DataError(f"{path}: the joints are {', '.join(recording.joint_names)}: must be {expected}")
    order = [recording.joint_names.index(name) for name in configured.joint_names]
    angle, torque = (part[:, order] for part in held(recording, _tilted(path, configured.side, bag.start)))
    kept = np.all((angle >= configured.low) & (angle <= configured.high), axis=1)
    angle, torque = angle[kept, 1:], torque[kept, 1:]
    checked = np.arange(len(angle)) % HELD_OUT == HELD_OUT - 1
    if len(angle) < HELD_OUT:
        raise DataError(f"{path}: {len(angle)} holds with an upright trunk: must be at least {HELD_OUT}")
    low, high = angle.min(axis=0), angle.max(axis=0)
    _check_coverage(scaled(angle[~checked], low, high), functions)
    source = f"recording {Path(path).name}, {len(angle)} holds"
    return Samples(angle[~checked], torque[~checked], angle[checked], torque[checked], low, high, source)


def held(recording: Recording, tilted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean angle (m, 4) rad and measured torque (m, 4) Nm of each hold.

    tilted: times in s at which the trunk was not upright; their holds are left out.
    """
    angle, torque = [], []
    for hold in analyse(recording).holds:
        within = (recording.time >= hold.start) & (recording.time <= hold.end)
        if not np.any((tilted >= hold.start) & (tilted <= hold.end)):
            angle.append(hold.pose)
            torque.append(recording.effort[within].mean(axis=0))
    angles, means = (np.array(values, dtype=float).reshape(-1, JOINT_COUNT) for values in (angle, torque))
    known = np.all(np.isfinite(means), axis=1)
    return angles[known], means[known]


def _tilted(path: str | Path, side: str, start: int) -> np.ndarray:
    """Return the times in s at which the trunk was not upright; without an IMU it counts as upright."""
    types = get_typestore(Stores.ROS2_JAZZY)
    times = []
    for batch in Storage(path).batches(lambda topic, msgtype: (topic, msgtype) == (TILT_TOPIC, TILT_TYPE)):
        for stamp, data in zip(batch.stamps, batch.data, strict=True):
            try:
                message: Any = types.deserialize_cdr(data, TILT_TYPE)
            except (SerdeError, ValueError) as error:
                raise DataError(f"{path}: cannot read {TILT_TOPIC} ({error})") from None
            if not Tilt.of(side, pitch=message.vector.y, roll=message.vector.x).axis_angle <= UPRIGHT:
                times.append((stamp - start) / 1e9)
    return np.array(times)


def _check_coverage(inputs: np.ndarray, functions: int) -> None:
    """Raise DataError if a cell of the grid partition has no sample to determine its rule."""
    cell = np.minimum(((inputs + 1) / 2 * functions).astype(int), functions - 1)
    empty = sorted(set(product(range(functions), repeat=len(INPUTS))) - set(map(tuple, cell.tolist())))
    if empty:
        where = ", ".join(f"{name} {part + 1}/{functions}" for name, part in zip(INPUTS, empty[0], strict=True))
        raise DataError(
            f"{len(empty)} of the {functions ** len(INPUTS)} cells of the box that the poses span have no hold "
            f"(the first: {where}): record holds there"
        )
