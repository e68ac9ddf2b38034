"""A rosbag2 recording -> the arrays of each arm, what the wearer was told, faults and parameters.

An arm is a namespace with a `joint_states` topic. Its `effort_commands` carry the stamp of the joint state that they
answer, so a joint state is set beside the last command that answered an earlier one. Time is that of the header stamps
or, where these run back or are far from the clock of the recorder, the time of arrival.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from exo_gravity.bag.joints import FIELDS, JointArrays
from exo_gravity.bag.storage import Batch, Storage
from exo_gravity.core.errors import DataError
from exo_gravity.core.recording import Recording, ScriptedStep, Span
from exo_gravity.core.safety import State

JOINT_STATE = "sensor_msgs/msg/JointState"
STATES, COMMANDS, STEPS = "joint_states", "effort_commands", "wearer_step"
OTHERS = {  # read whole, message by message: they are few
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/parameter_events": "rcl_interfaces/msg/ParameterEvent",
    "/recorder/parameters": "std_msgs/msg/String",
}
CARRIED = (State.RAMPING_IN.value, State.ACTIVE.value)  # as a bridge says of itself on /diagnostics
MAX_COMMAND_AGE = 200_000_000  # ns, after which no command counts as in force
MAX_CLOCK_OFFSET = 1_000_000_000  # ns between stamp and arrival

Progress = Callable[[int, int], None]  # (bytes done, bytes in all)


class Event(NamedTuple):
    """Something worth telling: s since the start of the recording, and a text."""

    time: float
    text: str


@dataclass(frozen=True)
class Bag:
    """What a recording holds.

    start: ns since 1970 of time 0. recordings: one an arm. events: warnings, errors and changed parameters. parameters:
    YAML text by node. notes: what is missing but does no harm. problems: what could not be read, one sentence each.
    """

    path: Path
    start: int
    recordings: tuple[Recording, ...]
    events: tuple[Event, ...]
    parameters: dict[str, str]
    notes: tuple[str, ...]
    problems: tuple[str, ...]


def read_bag(path: str | Path, progress: Progress = lambda done, size: None) -> Bag:
    """Read a recording: a folder of rosbag2, or an .mcap or .db3 file, whole or cut short.

    Raises DataError, one sentence, where nothing can be reported: no recording, an empty one, no arm in it.
    """
    contents = _Contents()
    storage = Storage(path)
    for batch in storage.batches(_wanted):
        contents.add(batch)
        progress(storage.done, storage.size)
    cut = f"the recording was cut short ({storage.cut_short}): what was written before is reported"
    notes = [cut] if storage.cut_short else []
    states = {name for name, arrays in contents.joints.items() if _leaf(name) == STATES}
    if not states and not contents.problems:
        topics = ", ".join(sorted(storage.topics)) or "nothing"
        if any(_leaf(topic) == STATES for topic in storage.topics) or not storage.topics:
            raise DataError(f"{path}: the recording is empty: it has no messages" + (f"; {cut}" if notes else ""))
        raise DataError(f"{path}: no topic {STATES} of type {JOINT_STATE} is in it; it has {topics}")
    start = min((int(contents.joints[name].first_arrival) for name in states), default=0)
    recordings = [r for name in sorted(states) if (r := contents.recording(name, start, notes))]
    if not recordings:
        raise DataError(f"{path}: {'; '.join(contents.problems)}")
    events = tuple(Event((stamp - start) / 1e9, text) for stamp, text in sorted(contents.events))
    return Bag(
        Path(path), start, tuple(recordings), events, contents.parameters, tuple(notes), tuple(contents.problems)
    )


def _leaf(topic: str) -> str:
    return topic.rpartition("/")[2]


def _arm(topic: str) -> str:
    return topic.rpartition("/")[0].strip("/") or "arm"


def _wanted(topic: str, msgtype: str) -> bool:
    if _leaf(topic) in (STATES, COMMANDS):
        return msgtype == JOINT_STATE
    return OTHERS.get(topic) == msgtype or (_leaf(topic) == STEPS and msgtype == "std_msgs/msg/String")


class _Contents:
    """Collects what comes out of a recording, topic by topic."""

    def __init__(self):
        self.joints: dict[str, JointArrays] = {}
        self.events: list[tuple[int, str]] = []
        self.parameters: dict[str, str] = {}
        self.problems: list[str] = []
        self._steps: dict[str, list[tuple[int, str, float]]] = {}
        self._said: dict[str, tuple[int, str]] = {}
        self._carried: dict[str, list[tuple[int, bool]]] = {}
        self._refused: set[str] = set()
        self._types = get_typestore(Stores.ROS2_JAZZY)

    def add(self, batch: Batch) -> None:
        """Take in a batch; a topic that can't be read becomes a problem and is left out from there on."""
        if batch.topic in self._refused:
            return
        try:
            if batch.msgtype == JOINT_STATE:
                if batch.topic not in self.joints:
                    fields = FIELDS if _leaf(batch.topic) == STATES else ("effort",)
                    self.joints[batch.topic] = JointArrays(batch.topic, fields)
                self.joints[batch.topic].add(batch.stamps, batch.data)
                return
            for stamp, data in zip(batch.stamps, batch.data, strict=True):
                self._other(batch, stamp, self._types.deserialize_cdr(data, batch.msgtype))
        except (DataError, SerdeError, ValueError, KeyError) as error:
            self._refused.add(batch.topic)
            self.joints.pop(batch.topic, None)
            text = str(error)
            self.problems.append(text if batch.topic in text else f"{batch.topic}: {text}")

    def _other(self, batch: Batch, stamp: int, message) -> None:
        if _leaf(batch.topic) == STEPS:
            try:
                step = json.loads(message.data)
                entry = stamp, str(step["action"]), float(step["duration"])
            except (ValueError, KeyError, TypeError):
                raise DataError(f"{batch.topic}: a message of it is no step that a wearer was told") from None
            self._steps.setdefault(_arm(batch.topic), []).append(entry)
        elif batch.topic == "/diagnostics":
            for status in message.status:
                level = int(status.level)
                before = self._said.get(status.name, (0, ""))
                if level > 0 and (level, status.message) != before:
                    self.events.append((stamp, f"{status.name}: {status.message}"))
                elif level == 0 and before[0] > 0:
                    self.events.append((stamp, f"{status.name}: OK, {status.message}"))
                self._said[status.name] = (level, status.message)
                if state := next((entry.value for entry in status.values if entry.key == "state"), ""):
                    told = self._carried.setdefault(_arm(status.name), [])
                    told.append((stamp, state in CARRIED))
        elif batch.topic == "/parameter_events":
            for parameter in message.changed_parameters:
                self.events.append((stamp, f"{message.node}: {parameter.name} = {_value(parameter.value)}"))
        else:
            node, _, text = message.data.partition(":")
            self.parameters[node.strip()] = f"{node}:{text}"

    def recording(self, states: str, start: int, notes: list[str]) -> Recording | None:
        """Return the arm whose joint states are on `states`, or None and a problem."""
        name = _arm(states)
        try:
            names = self.joints[states].names
            arrival, stamp, values = self.joints[states].arrays()
            stamped = bool(np.all(np.diff(stamp) >= 0) and abs(np.median(arrival - stamp)) < MAX_CLOCK_OFFSET)
            clock, values = _in_order(stamp if stamped else arrival, values)
            command = self._commands(states, names, clock, stamped, notes)
            position, velocity, effort = (values[:, FIELDS.index(field)] for field in FIELDS)
            time = (clock - start) / 1e9
            arrays = (time, position, velocity, effort, command)
            return Recording(name, names, *arrays, self._script(name, start), self._spans(name, start))
        except DataError as error:
            self.problems.append(str(error))
            return None

    def _commands(self, states: str, names, clock: np.ndarray, stamped: bool, notes: list[str]) -> np.ndarray:
        """Return the effort (n, 4) that was in force at each time of `clock`, NaN where none was."""
        result = np.full((len(clock), len(names)), np.nan, np.float32)
        topic = states.removesuffix(STATES) + COMMANDS
        if topic not in self.joints:
            notes.append(f"{topic} is not in it: torques are reported without their error")
            return result
        arrival, stamp, values = self.joints[topic].arrays()
        given = self.joints[topic].names
        if sorted(given) != sorted(names):
            problem = f"joint names differ: {', '.join(given)}; {states} has {', '.join(names)}"
            self.problems.append(f"{topic}: {problem}: torques are reported without their error")
            return result
        sent, values = _in_order(stamp if stamped else arrival, values)
        effort = values[:, 0, [given.index(name) for name in names]]
        last = np.searchsorted(sent, clock, "left") - 1
        known = (last >= 0) & (clock - sent[last] < MAX_COMMAND_AGE)
        result[known] = effort[last[known]]
        return result

    def _script(self, arm: str, start: int) -> tuple[ScriptedStep, ...]:
        steps = [((stamp - start) / 1e9, action, duration) for stamp, action, duration in self._steps.get(arm, [])]
        following = [*(begin for begin, _, _ in steps[1:]), float("inf")]
        return tuple(
            ScriptedStep(action, begin, min(begin + duration, then))
            for (begin, action, duration), then in zip(steps, following, strict=False)
        )

    def _spans(self, arm: str, start: int) -> tuple[Span, ...] | None:
        """Return when the arm was carried, each from the first word of that to the last; None if nobody said."""
        if arm not in self._carried:
            return None
        told = sorted(self._carried[arm])
        groups = (list(group) for carried, group in groupby(told, lambda word: word[1]) if carried)
        return tuple(((group[0][0] - start) / 1e9, (group[-1][0] - start) / 1e9) for group in groups)


def _in_order(clock: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if np.all(np.diff(clock) >= 0):
        return clock, values
    order = np.argsort(clock, kind="stable")
    return clock[order], values[order]


def _value(value) -> object:
    fields = ("", "bool", "integer", "double", "string", "byte_array", "bool_array", "integer_array", "double_array")
    if not 0 < value.type < len(fields):
        return list(value.string_array_value) if value.type == len(fields) else "not set"
    found = getattr(value, f"{fields[value.type]}_value")
    return found.tolist() if hasattr(found, "tolist") else found
