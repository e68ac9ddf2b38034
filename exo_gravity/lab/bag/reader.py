"""A rosbag2 recording -> the arrays of each arm, its script, faults and parameters.

An arm is a namespace with a `joint_states` topic. Each of its `effort_commands` carries the stamp of the joint state
that it answers, so each joint state is paired with the last command that answers an earlier one. Time is that of the
header stamps; where these run backwards or are far from the recorder's clock, it is the time of arrival. Whether an arm
was carried comes from the key `state` of its can_bridge on /diagnostics, never from the text.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, islice
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.serde import SerdeError

from exo_gravity.core.arm.arm import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import up_in_body
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.safety.drive import State
from exo_gravity.core.trunk.inputs import NOT_REPORTED
from exo_gravity.lab.bag import content
from exo_gravity.lab.bag.content import COMMANDS, JOINT_STATE, STATES, STEPS, Bag, Event, arm_of, leaf
from exo_gravity.lab.bag.joints import FIELDS, TYPES, JointArrays
from exo_gravity.lab.bag.storage import Storage
from exo_gravity.lab.trial.recording import CARRIED, Recording, ScriptedStep, Span
from exo_gravity.lab.trial.session import Session

BATCH_SIZE = 5_000  # messages that are decoded at once


@dataclass(frozen=True)
class Pairing:
    """Which messages belong together."""

    command_age: int = 200_000_000  #: ns; an older command is no longer in force
    clock_offset: int = 1_000_000_000  #: ns between stamp and arrival
    state_gap: float = 1.0  #: s; can_bridge reports its state twice a second, except while it ends


PAIRING = Pairing()


TOPIC = itemgetter(0)


def read_bag(path: str | Path) -> Bag:
    """Read a recording: a rosbag2 folder, or an .mcap or .db3 file, complete or cut short.

    Raises DataError, one sentence, if there is nothing to report: no recording, an empty one, or no arm in it.
    """
    storage, contents = Storage(path), _Contents()
    messages = storage.messages(content.is_wanted)
    while batch := list(islice(messages, BATCH_SIZE)):
        for topic, rows in groupby(sorted(batch, key=TOPIC), TOPIC):
            _, types, stamps, data = zip(*rows, strict=True)
            contents.add(topic, types[0], stamps, data)
    if storage.cut_short:
        contents.is_partial = contents.is_cut = True
        contents.notes.append(f"the recording was cut short ({storage.cut_short}): what was written before is reported")
    states = sorted(name for name in contents.joints if leaf(name) == STATES)
    if not states and not contents.problems:
        problem = (
            f"the recording has no topic {STATES} of type {JOINT_STATE}; it has {', '.join(sorted(storage.topics))}"
        )
        if not storage.topics or any(leaf(t) == STATES and kind == JOINT_STATE for t, kind in storage.topics.items()):
            problem = "the recording is empty: it has no messages"
        raise DataError(f"{path}: {'; '.join((problem, *contents.notes))}")
    start = min((contents.joints[name].first_arrival for name in states), default=0)
    recordings = tuple(r for name in states if (r := contents.recording(name, start)))
    if not recordings:
        raise DataError(f"{path}: {'; '.join(contents.problems)}")
    if contents.losses:
        contents.notes.append(f"the recorder lost messages: {contents.losses}")
    events, markers = (
        tuple(Event((stamp - start) / 1e9, *what) for stamp, *what in sorted(found, key=itemgetter(0, 1)))
        for found in (contents.events, contents.markers)
    )
    notes, problems = tuple(contents.notes), tuple(contents.problems)
    trunk = np.array(sorted(contents.trunk), dtype=float).reshape(-1, 7)
    trunk[:, 0] = (trunk[:, 0] - start) / 1e9
    more = contents.is_partial, contents.session, markers, trunk
    return Bag(Path(path), start, recordings, events, contents.parameters, notes, problems, *more)


class _Contents:
    """Collects the messages of a recording, topic by topic."""

    def __init__(self) -> None:
        self.joints: dict[str, JointArrays] = {}
        self.parameters: dict[str, str] = {}
        self.losses = ""
        self.session = Session()
        self.events: list[tuple[Any, ...]] = []  # stamp, text and setting of faults and changed parameters
        self.markers: list[tuple[int, str]] = []  # stamp and text
        self.trunk: list[tuple[float, ...]] = []  # rows of Bag.trunk, with stamps in ns
        self.notes: list[str] = []
        self.problems: list[str] = []
        self.is_cut = False  # the file was cut short
        self.is_partial = False  # it was, or an arm was not down at the end
        self._unreadable: set[str] = set()
        self._steps: dict[str, list[tuple[int, str, float]]] = {}  # arm -> (stamp, action, duration)
        self._states: dict[str, list[tuple[int, str]]] = {}  # arm -> (stamp, state)
        self._last: dict[str, tuple[int, str]] = {}  # node -> level and text of its last status

    def add(self, topic: str, msgtype: str, stamps: Sequence[int], messages: Sequence[bytes]) -> None:
        """Add messages that arrived at `stamps` ns. An unreadable topic becomes a problem, and its rest is ignored."""
        if topic in self._unreadable:
            return
        try:
            if msgtype == JOINT_STATE:
                self.joints.setdefault(topic, JointArrays(topic)).add(stamps, messages)
                return
            for stamp, data in zip(stamps, messages, strict=True):
                self._add(topic, stamp, TYPES.deserialize_cdr(data, msgtype))
        except (DataError, SerdeError, ValueError, LookupError) as error:
            self._unreadable.add(topic)
            self.joints.pop(topic, None)
            text = str(error)
            self.problems.append(text if topic in text else f"{topic}: {text}")

    def _add(self, topic: str, stamp: int, message: Any) -> None:
        """Add one decoded message that arrived at `stamp` ns. Raises DataError for an invalid step."""
        if leaf(topic) == STEPS:
            try:
                step = json.loads(message.data)
                entry = stamp, str(step["action"]), float(step["duration"])
            except (ValueError, KeyError, TypeError):
                raise DataError(f"{topic}: invalid {STEPS} message") from None
            self._steps.setdefault(arm_of(topic), []).append(entry)
        elif topic == content.DIAGNOSTICS:
            for status in message.status:
                self._add_status(stamp, status)
        elif topic == content.PARAMETER_EVENTS:
            for parameter in message.changed_parameters:
                name, value = parameter.name, _value(parameter.value)
                self.events.append((stamp, f"{message.node}: {name} = {value}", (message.node, name, value)))
        elif topic == content.IMU:
            q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
            felt = [component / -STANDARD_GRAVITY for component in (a.x, a.y, a.z)]
            if message.linear_acceleration_covariance[0] == NOT_REPORTED:
                felt = [-component for component in up_in_body((q.x, q.y, q.z, q.w))]
            if all(map(math.isfinite, (*felt, w.x, w.y, w.z))) and any(felt):
                self.trunk.append((stamp, w.x, w.y, w.z, *felt))
        elif topic == content.LOSSES:
            self.losses = message.data
        elif topic == content.MARKERS:
            self.markers.append((stamp, message.data))
        elif topic == content.SESSION:
            try:
                self.session = Session(**json.loads(message.data))
            except (ValueError, TypeError, ParameterError):
                raise DataError(f"{topic}: invalid session") from None
        else:
            node, _, text = message.data.partition(":")
            self.parameters[node.strip()] = f"{node}:{text}"

    def _add_status(self, stamp: int, status: Any) -> None:
        level = int(status.level)
        last = self._last.get(status.name, (0, ""))
        if level > 0 and (level, status.message) != last:
            self.events.append((stamp, f"{status.name}: {status.message}"))
        elif level == 0 and last[0] > 0:
            self.events.append((stamp, f"{status.name}: OK, {status.message}"))
        self._last[status.name] = (level, status.message)
        for entry in status.values:
            if entry.key == "state" and entry.value:
                self._states.setdefault(arm_of(status.name), []).append((stamp, entry.value))

    def recording(self, topic: str, start: int) -> Recording | None:
        """Return the arm whose joint states are on `topic`; None if it is unreadable, which is a problem."""
        name, names = arm_of(topic), self.joints[topic].names
        arrival, stamp, values = self.joints[topic].arrays()
        finite = np.isfinite(values[:, FIELDS.index("position")]).all(axis=1)
        if finite.any() and not finite.all():
            self.notes.append(f"{name}: joint states left out, a position is NaN or infinite: {np.sum(~finite)}")
            arrival, stamp, values = arrival[finite], stamp[finite], values[finite]
        stamped = bool(np.all(np.diff(stamp) >= 0) and abs(np.median(arrival - stamp)) < PAIRING.clock_offset)
        clock = stamp if stamped else arrival  # either is in order
        command, steps = self._commands(topic, names, clock, stamped), self._script(name, start)
        time = (clock - start) / 1e9
        carried = self._carried(name, start, float(time[-1]))
        try:
            position, velocity, effort = np.moveaxis(values, 1, 0)
            return Recording(name, names, time, position, velocity, effort, command, steps, carried)
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
        given = self.joints[topic].names
        if sorted(given) != sorted(names):
            problem = f"joint names differ: {', '.join(given)}; {states} has {', '.join(names)}"
            self.problems.append(f"{topic}: {problem}: the torque error is unknown")
            return result
        arrival, stamp, values = self.joints[topic].arrays()
        sent, effort = stamp if stamped else arrival, values[:, FIELDS.index("effort")]
        order = np.argsort(sent, kind="stable")
        sent, effort = sent[order], effort[order][:, [given.index(name) for name in names]]
        last = np.searchsorted(sent, clock, "left") - 1
        known = (last >= 0) & (clock - sent[last] < PAIRING.command_age)
        result[known] = effort[last[known]]
        return result

    def _script(self, arm: str, start: int) -> tuple[ScriptedStep, ...]:
        """Return the script steps of an arm; each ends when the next one begins, at the latest."""
        steps = [((stamp - start) / 1e9, action, duration) for stamp, action, duration in self._steps.get(arm, [])]
        ends = [*(begin for begin, _, _ in steps[1:]), float("inf")]
        return tuple(ScriptedStep(name, at, min(at + s, end)) for (at, name, s), end in zip(steps, ends, strict=False))

    def _carried(self, arm: str, start: int, end: float) -> tuple[Span, ...] | None:
        """Return when the arm was carried, by its reported states; None if no state of it was recorded.

        end: s, of the arm's recording. An arm that is carried in the last state before it is carried until then. What
        the recording does not show of the arm's way down becomes a note.
        """
        if arm not in self._states:
            return None
        states = sorted(((stamp - start) / 1e9, state) for stamp, state in self._states[arm])
        groups = [list(group) for carried, group in groupby(states, lambda state: state[1] in CARRIED) if carried]
        spans = [(group[0][0], group[-1][0]) for group in groups]
        time, last = states[-1]
        if last in CARRIED and 0.0 < end - time < PAIRING.state_gap:
            spans[-1] = spans[-1][0], end
        if self.is_cut or end - time < PAIRING.state_gap:  # else the joint states go on: they show the way down
            if last in CARRIED:
                missing = "while the arm is carried: it does not show how the arm was let down"
            else:
                missing = "before the arm was down" if last == State.LETTING_DOWN.value else ""
            if missing:
                self.notes.append(f"{arm}: the recording ends {missing}")
                self.is_partial = True
        return tuple(spans)


def _value(value: Any) -> object:
    """Return the Python value of a rcl_interfaces/ParameterValue."""
    fields = ("bool", "integer", "double", "string", "byte_array", "bool_array", "integer_array", "double_array")
    if value.type == 0:
        return "not set"
    found = getattr(value, f"{(*fields, 'string_array')[value.type - 1]}_value")
    return found.tolist() if hasattr(found, "tolist") else found
