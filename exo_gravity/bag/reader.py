"""A rosbag2 recording -> the arrays of each arm, its script, faults and parameters.

An arm is a namespace with a `joint_states` topic. Each of its `effort_commands` carries the stamp of the joint state
that it answers, so each joint state is paired with the last command that answers an earlier one. Time is that of the
header stamps; where these run backwards or are far from the recorder's clock, it is the time of arrival.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from exo_gravity.bag.content import Bag
from exo_gravity.bag.events import EventLog
from exo_gravity.bag.joints import FIELDS, JointArrays
from exo_gravity.bag.mcap import Batch
from exo_gravity.bag.storage import Storage
from exo_gravity.bag.topics import COMMANDS, JOINT_STATE, STATES, arm_of, is_wanted, leaf
from exo_gravity.core.errors import DataError
from exo_gravity.core.trial.recording import Recording

MAX_COMMAND_AGE = 200_000_000  # ns; an older command is no longer in force
MAX_CLOCK_OFFSET = 1_000_000_000  # ns between stamp and arrival

Progress = Callable[[int, int], None]  # (bytes done, bytes in total)


def read_bag(path: str | Path, progress: Progress = lambda done, size: None) -> Bag:
    """Read a recording: a rosbag2 folder, or an .mcap or .db3 file, complete or cut short.

    Raises DataError, one sentence, if there is nothing to report: no recording, an empty one, or no arm in it.
    """
    storage, contents = Storage(path), _Contents()
    for batch in storage.batches(is_wanted):
        contents.add(batch)
        progress(storage.done, storage.size)
    if storage.cut_short:
        contents.is_cut = True
        contents.notes.append(f"the recording was cut short ({storage.cut_short}): what was written before is reported")
    states = sorted(name for name in contents.joints if leaf(name) == STATES)
    if not states and not contents.problems:
        raise DataError(f"{path}: {'; '.join((_nothing(storage.topics), *contents.notes))}")
    start = min((contents.joints[name].first_arrival for name in states), default=0)
    recordings = tuple(r for name in states if (r := contents.recording(name, start)))
    if not recordings:
        raise DataError(f"{path}: {'; '.join(contents.problems)}")
    log = contents.log
    if log.losses:
        contents.notes.append(f"the recorder lost messages: {log.losses}")
    return Bag(
        Path(path),
        start,
        recordings,
        log.events(start),
        log.parameters,
        tuple(contents.notes),
        tuple(contents.problems),
        contents.is_cut or contents.is_open,
    )


def _nothing(topics: dict[str, str]) -> str:
    """Return why a recording with these topics, and no joint states, can't be reported."""
    if not topics or any(leaf(topic) == STATES for topic in topics):
        return "the recording is empty: it has no messages"
    return f"the recording has no topic {STATES} of type {JOINT_STATE}; it has {', '.join(sorted(topics))}"


class _Contents:
    """Collects the messages of a recording, topic by topic."""

    def __init__(self) -> None:
        self.joints: dict[str, JointArrays] = {}
        self.log = EventLog()
        self.notes: list[str] = []
        self.problems: list[str] = []
        self.is_cut = False  # the file was cut short
        self.is_open = False  # an arm was not down at the end
        self._unreadable: set[str] = set()
        self._types = get_typestore(Stores.ROS2_JAZZY)

    def add(self, batch: Batch) -> None:
        """Add a batch. An unreadable topic becomes a problem, and its later messages are ignored."""
        if batch.topic in self._unreadable:
            return
        try:
            if batch.msgtype == JOINT_STATE:
                if batch.topic not in self.joints:
                    fields = FIELDS if leaf(batch.topic) == STATES else ("effort",)
                    self.joints[batch.topic] = JointArrays(batch.topic, fields)
                self.joints[batch.topic].add(batch.stamps, batch.data)
                return
            for stamp, data in zip(batch.stamps, batch.data, strict=True):
                self.log.add(batch.topic, stamp, self._types.deserialize_cdr(data, batch.msgtype))
        except (DataError, SerdeError, ValueError, KeyError) as error:
            self._unreadable.add(batch.topic)
            self.joints.pop(batch.topic, None)
            text = str(error)
            self.problems.append(text if batch.topic in text else f"{batch.topic}: {text}")

    def recording(self, states: str, start: int) -> Recording | None:
        """Return the arm whose joint states are on the topic `states`; None if it is unreadable, which is a problem."""
        name = arm_of(states)
        try:
            names = self.joints[states].names
            arrival, stamp, values = self.joints[states].arrays()
            stamped = bool(np.all(np.diff(stamp) >= 0) and abs(np.median(arrival - stamp)) < MAX_CLOCK_OFFSET)
            clock, values = _in_order(stamp if stamped else arrival, values)
            command = self._commands(states, names, clock, stamped)
            position, velocity, effort = (values[:, FIELDS.index(field)] for field in FIELDS)
            time = (clock - start) / 1e9
            end = float(time[-1])
            if open_end := self.log.open_end(name, start, end, self.is_cut):
                self.notes.append(open_end)
                self.is_open = True
            carried = self.log.carried(name, start, end)
            return Recording(
                name, names, time, position, velocity, effort, command, self.log.steps(name, start), carried
            )
        except DataError as error:
            self.problems.append(str(error))
            return None

    def _commands(self, states: str, names: Sequence[str], clock: np.ndarray, stamped: bool) -> np.ndarray:
        """Return the effort (n, 4) that was in force at each time of `clock`, NaN where there was none."""
        result = np.full((len(clock), len(names)), np.nan, np.float32)
        topic = states.removesuffix(STATES) + COMMANDS
        if topic not in self.joints:
            self.notes.append(f"{topic} was not recorded: the torque error is unknown")
            return result
        arrival, stamp, values = self.joints[topic].arrays()
        given = self.joints[topic].names
        if sorted(given) != sorted(names):
            problem = f"joint names differ: {', '.join(given)}; {states} has {', '.join(names)}"
            self.problems.append(f"{topic}: {problem}: the torque error is unknown")
            return result
        sent, values = _in_order(stamp if stamped else arrival, values)
        effort = values[:, 0, [given.index(name) for name in names]]
        last = np.searchsorted(sent, clock, "left") - 1
        known = (last >= 0) & (clock - sent[last] < MAX_COMMAND_AGE)
        result[known] = effort[last[known]]
        return result


def _in_order(clock: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return clock (n,) and values (n, ...) sorted by time."""
    if np.all(np.diff(clock) >= 0):
        return clock, values
    order = np.argsort(clock, kind="stable")
    return clock[order], values[order]
