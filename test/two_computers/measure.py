# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What happened to one arm on two computers: from the recording on the robot, and from the arm's true motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from ..support.truth import Truth

SETTLING = 0.5  # s between release and the position from which drift is measured
COMMANDS, STATES = "/right/effort_commands", "/right/joint_states"


@dataclass(frozen=True)
class Measured:
    """Of the hold, until its end or until the arm was let down.

    duration: s.
    age: ms from a joint state's stamp to the arrival of its efforts at the bridge's computer: median, 99th percentile,
    largest.
    missed: share of the joint states that were never answered.
    gap: ms, the longest time without efforts.
    drift: deg, the largest of any joint by the simulator's truth.
    """

    duration: float
    age: tuple[float, float, float]
    missed: float
    gap: float
    drift: float


def measure(bag: Path, truth: Path, start: float, end: float) -> Measured:
    """Measure from `start` to `end`, wall clock in s; `bag` is the recording that was made on the robot."""
    arrivals, stamps, states = _read(bag)
    during = (arrivals > start) & (arrivals < end)
    age = 1000.0 * (arrivals - stamps)[during]
    asked = states[(states > start) & (states < end - 0.2)]  # the answers to the last may be on their way
    missed = 1.0 - np.isin(asked, stamps).mean() if len(asked) else float("nan")
    records = Truth(truth).since(start)
    position = records["position"][(records["time"] >= start + SETTLING) & (records["time"] <= end)]
    drift = np.degrees(np.abs(position - position[0]).max()) if len(position) else float("nan")
    gap = 1000.0 * np.diff(arrivals[during]).max(initial=0.0)
    figures = np.percentile(age, (50, 99, 100)) if len(age) else [float("nan")] * 3
    median, most, largest = map(float, figures)
    return Measured(end - start, (median, most, largest), float(missed), float(gap), float(drift))


def _read(bag: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return arrivals and stamps of the efforts, and the stamps of the joint states, in s."""
    arrivals, stamps, states = [], [], []
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        connections = [c for c in reader.connections if c.topic in (COMMANDS, STATES)]
        for connection, arrival, data in reader.messages(connections=connections):
            stamp = reader.deserialize(data, connection.msgtype).header.stamp  # type: ignore[attr-defined]
            time = stamp.sec + 1e-9 * stamp.nanosec
            if connection.topic == COMMANDS:
                arrivals.append(1e-9 * arrival)
                stamps.append(time)
            else:
                states.append(time)
    return np.array(arrivals), np.array(stamps), np.array(states)
