# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A rosbag2 recording -> the arrays of each arm, its script, faults and parameters.

An arm is a namespace with a `joint_states` topic. Each joint state is paired with the command that was in force. Time
is that of the header stamps; where these run backwards or are far from the recorder's clock, it is the time of arrival.
Whether an arm was carried comes from the key `state` of its can_bridge on /diagnostics, never from the text.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby, pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import up_in_body
from exo_gravity.core.errors import DataError
from exo_gravity.core.safety.command import State
from exo_gravity.core.safety.limits import MAX_EFFORT
from exo_gravity.core.trunk.inputs import NOT_REPORTED
from exo_gravity.core.vocabulary import NONE, Source
from exo_gravity.lab.bag import content
from exo_gravity.lab.bag.content import (
    BRIDGE,
    COMMANDS,
    JOINT_STATE,
    STATES,
    STEPS,
    Bag,
    Event,
    NodeStatus,
    Session,
    arm_of,
    leaf,
)
from exo_gravity.lab.bag.storage import FIELDS, TYPES, Decoder, JointArrays, JointSeries, Messages, Storage
from exo_gravity.lab.inputs.arms import recorded_of
from exo_gravity.lab.inputs.parameter_file import recorded_parameters
from exo_gravity.lab.trial.analysis import CARRIED, Recording, ScriptedStep, Span

SECOND = 1_000_000_000  # ns


@dataclass(frozen=True)
class ClockTuning:
    """What counts as a step of the clock, and which times belong together."""

    back: int = 50_000_000  #: ns; messages that overtake each other differ by less
    ahead: int = 30 * SECOND  #: ns without a message; a shorter pause is one of the recording
    join: int = SECOND  #: ns between two parts after a step: a gap, in which no hold goes on
    edge: int = SECOND // 2  #: ns by which a message of another topic may lie outside of its part
    outside: int = 86_400 * SECOND  #: ns by which it may lie before or after the arm's joint states
    stamp: int = SECOND  #: ns between stamp and arrival
    command_age: int = SECOND // 5  #: ns; an older command is no longer in force


CLOCK = ClockTuning()


@dataclass(frozen=True)
class Timeline:
    """The parts of a recording between steps of its clock. Arrays (k,) have one value for each part.

    A computer without a battery for its clock sets it when it finds a time server: times of arrival step back, or ahead
    by an hour or by decades. The order in which messages lie in the file does not change then. So it divides the
    recording into parts at each step, and puts each part behind the one before it.
    """

    first: np.ndarray  #: number of the first message among all messages of the recording
    offset: np.ndarray  #: ns to add to its times
    begin: np.ndarray  #: ns, its first time, with the offset
    end: np.ndarray  #: ns, its last time, with the offset
    steps: tuple[int, ...]  #: ns of each step, positive ahead
    ordinal: np.ndarray  #: (n,) numbers of the messages that it is made of
    known: np.ndarray  #: (n,) ns, their times

    def part(self, ordinal: np.ndarray) -> np.ndarray:
        """Return the part (n,) in which the `ordinal`-th messages (n,) lie."""
        return np.maximum(np.searchsorted(self.first, ordinal, "right") - 1, 0)

    def times(self, ordinal: np.ndarray, arrival: np.ndarray) -> np.ndarray:
        """Return the times (n,) in ns of messages that arrived at `arrival` (n,) ns; near their part in any case.

        A time of 0 is unknown: such a message has the time of its neighbours in the file.
        """
        part, last = self.part(ordinal), len(self.first) - 1
        low = self.begin - np.where(np.arange(last + 1) == 0, CLOCK.outside, CLOCK.edge)
        high = self.end + np.where(np.arange(last + 1) == last, CLOCK.outside, CLOCK.edge)
        times = np.clip(arrival + self.offset[part], low[part], high[part])
        lost = np.flatnonzero(arrival <= 0)
        times[lost] = self.known[np.minimum(np.searchsorted(self.ordinal, ordinal[lost]), len(self.known) - 1)]
        return times

    def of(self, series: JointSeries) -> tuple[np.ndarray, np.ndarray, float]:
        """Return times of arrival (n,) and stamps (n,) in ns, and the share of stamps that are near.

        A stamp that is far from the recorder's clock is replaced by the time of arrival.
        """
        arrival = self.times(series.ordinal, arrival_of(series))
        stamp = series.stamp + self.offset[self.part(series.ordinal)]
        near = np.abs(arrival - stamp) < CLOCK.stamp
        return arrival, np.where(near, stamp, arrival), float(near.mean())


def timeline(series: JointSeries) -> Timeline:
    """Return the timeline of a recording from the joint states of one arm. Its longest part keeps its times."""
    arrival = arrival_of(series)
    cuts = np.flatnonzero(_is_step(np.diff(arrival))) + 1
    if _is_in_another_order(arrival):
        cuts = cuts[:0]
    parts = [slice(*ends) for ends in pairwise((0, *cuts.tolist(), len(arrival)))]
    begin, end = np.array([(arrival[part].min(), arrival[part].max()) for part in parts]).T
    length = end - begin
    placed = np.concatenate(([0], np.cumsum(length[:-1] + CLOCK.join)))
    anchor = int(np.argmax(length))
    placed += begin[anchor] - placed[anchor]
    first, offset = series.ordinal[[part.start for part in parts]], placed - begin
    known = arrival + np.repeat(offset, [part.stop - part.start for part in parts])
    steps = tuple((arrival[cuts] - arrival[cuts - 1]).tolist())
    return Timeline(first, offset, placed, placed + length, steps, series.ordinal, known)


def arrival_of(series: JointSeries) -> np.ndarray:
    """Return times of arrival (n,) in ns, the stamp where that is unknown.

    A single time far from both of its neighbours, which agree, becomes that of the first of them.
    """
    arrival = np.where(series.arrival > 0, series.arrival, np.maximum(series.stamp, 0))
    is_step, around = _is_step(np.diff(arrival)), arrival[2:] - arrival[:-2]
    alone = is_step[:-1] & is_step[1:] & ~_is_step(around)
    return np.concatenate((arrival[:1], np.where(alone, arrival[:-2], arrival[1:-1]), arrival[1:][-1:]))


def _is_step(change: np.ndarray) -> np.ndarray:
    """Return which changes (n,) in ns from one time to the next are steps of the clock."""
    return (change < -CLOCK.back) | (change > CLOCK.ahead)


def _is_in_another_order(arrival: np.ndarray) -> bool:
    """Return whether the runs of times, sorted, follow each other: the file's order is then not that of arrival."""
    change = np.diff(arrival)
    cuts = np.flatnonzero((change < -CLOCK.back) | (change > CLOCK.join)) + 1
    runs = sorted((int(run.min()), int(run.max())) for run in np.split(arrival, cuts))
    gaps = [later[0] - earlier[1] for earlier, later in pairwise(runs)]
    return bool(np.any(change < -CLOCK.back)) and all(-CLOCK.back <= gap <= CLOCK.join for gap in gaps)


def efforts_in_force(sent: np.ndarray, effort: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """Return the effort (n, joints) in Nm in force at each time of `clock` (n,) in ns, NaN where there was none.

    A command carries the stamp of the joint state that it answers: the last one sent before a joint state is in force.

    sent: (m,) ns, times of the commands in any order. effort: (m, joints) Nm.
    """
    order = np.argsort(sent, kind="stable")
    sent = sent[order]
    last = np.searchsorted(sent, clock, "left") - 1
    known = (last >= 0) & (clock - sent[last] < CLOCK.command_age)
    return np.where(known[:, None], effort[order[last]], np.float32(np.nan))


MAX_ANGLE = 2.0 * math.pi  # rad; no joint of an arm turns farther
MAX_SHARE = 0.01  # of the samples that may be beyond it, and are left out: more are of another unit
STATE_GAP = 1.0  # s; can_bridge reports its state twice a second, except while it ends
LISTED = 20  # in a sentence: a robot's recording may have hundreds of topics

Row = tuple[int, int]  # number of a message in the recording, time of arrival in ns


def read_bag(path: str | Path, every: int = 1) -> Bag:
    """Read a recording: a rosbag2 folder, or an .mcap or .db3 file, complete or cut short.

    every: of each arm's samples, the first of so many is kept. Each has the command that was in force.

    Raises DataError, one sentence, if there is nothing to report: no recording, an empty one, or no arm in it.
    """
    storage, contents = Storage(path), _Contents(every)
    contents.read(storage)
    arms = contents.arms()
    if not arms and not contents.problems:
        found = ", ".join(
            f"{topic} ({kind or 'of no type'})" for topic, kind in sorted(storage.topics.items())[:LISTED]
        )
        problem = f"it has no message on a topic {STATES} of type {JOINT_STATE}; of its topics: {found or 'none'}"
        contents.problems.append("; ".join((problem, *contents.notes)))
    series = {topic: contents.series(topic) for topic in arms}
    if series:
        contents.set_clock(list(series.values()))
    recordings = tuple(r for topic in arms if (r := contents.recording(topic, series.pop(topic))))
    if not recordings:
        raise DataError(f"{path}: {'; '.join(contents.problems)}")
    events, markers = (
        tuple(Event(now, *what) for now, (_, *what) in contents.in_order(found))
        for found in (contents.events, contents.markers)
    )
    return Bag(
        Path(path), contents.start, recordings, events, contents.parameters, tuple(contents.notes),
        tuple(contents.problems), contents.is_partial, contents.session, markers,
        contents.samples(contents.trunk), contents.samples(contents.tilt), contents.sources,
    )  # fmt: skip


class _Samples(Decoder):
    """Numbers of a topic, by `columns` from its decoded messages: (n, numbers), NaN in a row that is left out."""

    def __init__(self, msgtype: str, columns: Callable[[np.ndarray], np.ndarray], width: int) -> None:
        super().__init__(msgtype)
        self._columns = columns
        self.parts = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, width)))]

    def add(self, messages: Messages) -> None:
        for index, _, values in self.decode(messages):
            rows = self._columns(values)
            kept = np.isfinite(rows).all(axis=1)
            self.parts.append((messages.ordinal[index][kept], messages.arrival[index][kept], rows[kept]))


class _Few:
    """The messages of a topic that has few of them. Each is decoded by rosbags, and given to `take` with its row."""

    def __init__(self, msgtype: str, take: Callable[[Row, Any], None]) -> None:
        self.damaged, self.problem = 0, ""
        self._msgtype, self._take = msgtype, take

    def add(self, messages: Messages) -> None:
        rows = zip(messages.ordinal.tolist(), messages.arrival.tolist(), strict=True)
        for row, data in zip(rows, messages.data, strict=True):
            try:
                self._take(row, TYPES.deserialize_cdr(data, self._msgtype))
            except Exception as error:  # rosbags raises whatever its generated code raises
                reason = " ".join(f"{type(error).__name__}: {error}".split())
                self.damaged, self.problem = self.damaged + 1, f"a message is invalid ({reason})"


def _turning_and_felt(imu: np.ndarray) -> np.ndarray:
    """Return angular velocity and what is felt as gravity in units of 1 g, (n, 6), of sensor_msgs/Imu (n,)."""

    def vector(name: str, axes: str = "xyz") -> np.ndarray:
        return np.array([imu[f"{name}.{axis}"] for axis in axes], float)

    with np.errstate(all="ignore"):  # a damaged message may have any number
        felt = vector("linear_acceleration") / -STANDARD_GRAVITY
        unreported = imu["linear_acceleration_covariance"][:, 0] == NOT_REPORTED
        if unreported.any():
            up = np.array([up_in_body(q) for q in vector("orientation", "xyzw").T[unreported].tolist()])
            felt[:, unreported] = -up.T
        felt[:, ~np.any(felt, axis=0)] = np.nan
    return np.vstack((vector("angular_velocity"), felt)).T


class _Contents:
    """Collects the messages of a recording, topic by topic. every: see `read_bag`."""

    def __init__(self, every: int) -> None:
        self.every = every
        self.parameters: dict[str, str] = {}
        self.session = Session()
        self.events: list[tuple[Any, ...]] = []  # row, text, setting and status of faults and changed parameters
        self.markers: list[tuple[Row, str]] = []  # row and text
        self.sources: dict[str, Source] = {}  # by arm, as the nodes say
        self.trunk = _Samples(content.READ[content.IMU], _turning_and_felt, 6)
        self.tilt = _Samples(content.TILT_TYPE, lambda tilt: np.stack((tilt["vector.y"], tilt["vector.x"]), axis=1), 2)
        self.notes: list[str] = []
        self.problems: list[str] = []
        self.is_partial = False  # whether a part is missing, or an arm was not down at the end
        self.start = 0  # ns since 1970, of time 0
        self._line: Timeline
        self._joints: dict[str, JointArrays] = {}  # by topic
        self._names: dict[str, tuple[str, ...]] = {}  # of an arm's joints, by the topic of its joint states
        self._steps: dict[str, list[tuple[Row, str, float]]] = {}  # by arm: row, action, duration
        self._states: dict[str, list[tuple[Row, str]]] = {}  # by arm: row, state
        self._last: dict[str, tuple[int, str]] = {}  # node -> level and text of its last status
        self._is_cut = False

    def read(self, storage: Storage) -> None:
        """Add the messages of a recording. Note what the files lack, and which messages are damaged."""
        readers: dict[str, JointArrays | _Samples | _Few] = {content.IMU: self.trunk, content.TILT_TOPIC: self.tilt}
        for rows in storage.rows(lambda topic, kind: kind in (content.READ.get(topic), content.READ.get(leaf(topic)))):
            topic, msgtype = rows.topic, rows.msgtype
            if topic not in readers and msgtype == JOINT_STATE:
                kept = (FIELDS, self.every) if leaf(topic) == STATES else (("effort",), 1)
                readers[topic] = self._joints[topic] = JointArrays(topic, *kept)
            elif topic not in readers:
                readers[topic] = _Few(msgtype, partial(self._add, topic))
            readers[topic].add(rows)
        self.notes += storage.notes
        self._is_cut = bool(storage.cut_short)
        if storage.cut_short:
            self.notes.append(f"the recording was cut short ({storage.cut_short}): what was written before is reported")
        if storage.damaged:
            self.notes.append(f"the recording is damaged: parts left out: {storage.damaged}")
        self.is_partial = bool(storage.cut_short or storage.damaged)
        for topic, reader in readers.items():
            needed = topic == content.SESSION or leaf(topic) == STEPS
            if reader.damaged and (needed or (topic in self._joints and not self._joints[topic].names)):
                self.problems.append(f"{topic}: {reader.problem}")
            elif reader.damaged:
                self.is_partial = True
                self.notes.append(f"{topic}: damaged messages left out: {reader.damaged}")

    def arms(self) -> Sequence[str]:
        """Return the topics of the arms' joint states: of those with efforts or a bridge, if there are any."""
        states = sorted(name for name, joints in self._joints.items() if leaf(name) == STATES and joints.names)
        arms = [name for name in states if self._commands_of(name).names or arm_of(name) in self._states]
        for name in states if arms else ():
            if name not in arms:
                joints = ", ".join(self._joints[name].names)
                self.notes.append(f"{name}: not reported: nothing commands its joints {joints}")
        return arms or states

    def _commands_of(self, states: str) -> JointArrays:
        topic = states.removesuffix(STATES) + COMMANDS
        return self._joints.get(topic) or JointArrays(topic)

    def series(self, topic: str) -> JointSeries:
        """Return the joint states of an arm: of the joints that its efforts name, else of those that most have."""
        joints, commanded = self._joints[topic], self._commands_of(topic).names
        names = commanded if commanded and joints.has(commanded) else joints.names
        if sorted(names) == sorted(joints.names):
            names = joints.names  # in the order of the joint states
        series, others = joints.arrays(names)
        if others:
            self.notes.append(f"{topic}: messages of other joints left out: {others}; a topic of their own is better")
        self._names[topic] = names
        return series

    def set_clock(self, series: Sequence[JointSeries]) -> None:
        """Take the time from the longest of these joint states. Note the steps of the clock."""
        line = self._line = timeline(max(series, key=lambda one: len(one.ordinal)))
        self.start = min(int(line.of(one)[0].min()) for one in series)
        if line.steps:
            changes = zip(line.steps, (line.end - self.start).tolist(), strict=False)
            listed = [f"{step / 1e9:+.1f} s at {end / 1e9:.1f} s" for step, end in changes][:LISTED]
            self.notes.append(f"the recording's clock was set, or it paused; it is divided there: {', '.join(listed)}")

    def in_order(self, found: Sequence[tuple[Any, ...]]) -> list[tuple[float, Any]]:
        """Return entries that begin with a Row in the order of their times, each with its time in s."""
        rows = np.array([entry[0] for entry in found], np.int64).reshape(-1, 2)
        return sorted(zip(self._seconds(*rows.T).tolist(), found, strict=True), key=itemgetter(0))

    def samples(self, samples: _Samples) -> np.ndarray:
        """Return the rows of a topic in order, each with its time in s first."""
        ordinal, arrival, rows = (np.concatenate(columns) for columns in zip(*samples.parts, strict=True))
        result = np.column_stack((self._seconds(ordinal, arrival), rows))
        return result[np.argsort(result[:, 0], kind="stable")]

    def _seconds(self, ordinal: np.ndarray, arrival: np.ndarray) -> np.ndarray:
        """Return the times (n,) in s since the start of messages by their numbers (n,) and times of arrival (n,)."""
        return (self._line.times(ordinal, arrival) - self.start) / 1e9

    def _add(self, topic: str, row: Row, message: Any) -> None:
        """Add one decoded message. Raises whatever an invalid one leads to."""
        if leaf(topic) == STEPS:
            step = json.loads(message.data)
            duration = float(step["duration"])
            if not 0.0 <= duration < math.inf:
                raise DataError(f"duration = {duration}: must be a number of seconds, 0 or more")
            self._steps.setdefault(arm_of(topic), []).append((row, str(step["action"]), duration))
        elif topic == content.DIAGNOSTICS:
            for status in message.status:
                self._add_status(row, status)
        elif topic == content.PARAMETER_EVENTS:
            for parameter in message.changed_parameters:
                name, value = parameter.name, _value(parameter.value)
                self.events.append((row, f"{message.node}: {name} = {value}", (message.node, name, value)))
        elif topic == content.LOSSES:
            self.notes.append(f"the recorder lost messages: {message.data}")
        elif topic == content.MARKERS:
            self.markers.append((row, message.data))
        elif topic == content.SESSION:
            self.session = Session(**json.loads(message.data))
        else:
            node = message.data.partition(":")[0].strip()
            if leaf(node) in ("compensator", BRIDGE):
                recorded_of({node: message.data}, arm_of(node), leaf(node))
            else:
                recorded_parameters(message.data, node)
            self.parameters[node] = message.data

    def _add_status(self, row: Row, status: Any) -> None:
        level, values = int(status.level), {entry.key: entry.value for entry in status.values}
        fault = values.get("fault", NONE), values.get("fault text", "")
        last, found = self._last.get(status.name, (0, "")), NodeStatus(status.name, level, status.message, *fault)
        if level > 0 and (level, status.message) != last:
            self.events.append((row, f"{status.name}: {status.message}", None, found))
        elif level == 0 and last[0] > 0:
            self.events.append((row, f"{status.name}: OK, {status.message}", None, found))
        self._last[status.name] = (level, status.message)
        for entry in status.values:
            if entry.key == "state" and entry.value and leaf(status.name) == BRIDGE:
                self._states.setdefault(arm_of(status.name), []).append((row, entry.value))
        if leaf(status.name) == "simulator":
            self.sources[arm_of(status.name)] = Source.SIMULATED
        elif leaf(status.name) == BRIDGE and values.get("source") in (Source.SIMULATED, Source.REAL):
            self.sources.setdefault(arm_of(status.name), Source(values["source"]))

    def recording(self, topic: str, series: JointSeries) -> Recording | None:
        """Return the arm whose joint states are on `topic`; None if it is unreadable, which is a problem."""
        name, names, values = arm_of(topic), self._names[topic], series.values
        arrival, stamp, near = self._line.of(series)
        kept = self._plausible(name, names, values[:, FIELDS.index("position")])
        if not kept.any():
            return None
        if not kept.all() or np.any(np.diff(arrival) < 0):
            order = np.flatnonzero(kept)[np.argsort(arrival[kept], kind="stable")]
            arrival, stamp, values = arrival[order], stamp[order], values[order]
        stamped = near > 0.5 and bool(np.all(np.diff(stamp) >= -CLOCK.back))
        clock = np.maximum.accumulate(stamp) if stamped else arrival
        command, time = self._commands(topic, names, clock, stamped), (clock - self.start) / 1e9
        position, velocity, effort = np.moveaxis(values, 1, 0)
        self._forget_impossible(name, names, effort)
        self._forget_impossible(f"{name} {COMMANDS}", names, command)
        try:
            recording = Recording(name, names, time, position, velocity, effort, command, self._script(name))
        except DataError as error:
            self.problems.append(str(error))
            return None
        return replace(recording, carried=self._carried(name, float(time[-1])))

    def _plausible(self, name: str, joints: Sequence[str], position: np.ndarray) -> np.ndarray:
        """Return which positions (n, joints) are those of an arm (n,); none if their unit is wrong, a problem."""
        finite = np.isfinite(position).all(axis=1)
        beyond = np.abs(position) > MAX_ANGLE
        far = finite & beyond.any(axis=1)
        if not finite.any():
            least = joints[int(np.argmin(np.isfinite(position).sum(axis=0)))]
            self.problems.append(f"{name}: {least} has no position that is a number: must be in rad")
        elif far.sum() > MAX_SHARE * finite.sum():
            joint = int(np.argmax(beyond[finite].sum(axis=0)))
            largest = float(np.abs(position[finite, joint]).max())
            self.problems.append(
                f"{name}: {joints[joint]} = {largest:.4g} rad: must be within ±2 pi; is it in degrees?"
            )
            return np.zeros_like(finite)
        for what, wrong in (("is NaN or infinite", ~finite), ("is beyond ±2 pi", far)):
            if wrong.any():
                self.notes.append(f"{name}: joint states left out, a position {what}: {np.sum(wrong)}")
        return finite & ~far

    def _forget_impossible(self, name: str, joints: Sequence[str], effort: np.ndarray) -> None:
        """Set torques (n, joints) in Nm that no motor has to NaN, all of them if their unit is wrong, and note it."""
        beyond = np.abs(effort) > MAX_EFFORT
        if not beyond.any():
            return
        joint = int(np.argmax(beyond.sum(axis=0)))
        largest = float(np.abs(effort[beyond[:, joint], joint]).max())
        is_unit = beyond.any(axis=1).mean() > MAX_SHARE
        effort[np.ones_like(beyond) if is_unit else beyond] = np.nan
        question = "; are they in mNm?" if is_unit else ""
        self.notes.append(
            f"{name}: torques left out: {joints[joint]} = {largest:.4g} Nm: must be within ±{MAX_EFFORT:g} Nm{question}"
        )

    def _commands(self, states: str, names: Sequence[str], clock: np.ndarray, stamped: bool) -> np.ndarray:
        """Return the effort (n, joints) that was in force at each time of `clock`, NaN where there was none."""
        commands = self._commands_of(states)
        if commands.has(names):
            series, _ = commands.arrays(names)
            arrival, stamp, _ = self._line.of(series)
            return efforts_in_force(stamp if stamped else arrival, series.values[:, 0], clock)
        if commands.names:
            problem = f"joint names differ: {', '.join(commands.names)}; {states} has {', '.join(names)}"
            self.problems.append(f"{commands.topic}: {problem}: the torque error is unknown")
        else:
            self.notes.append(f"{commands.topic} was not recorded: the torque error is unknown")
        return np.full((len(clock), len(names)), np.nan, np.float32)

    def _script(self, arm: str) -> tuple[ScriptedStep, ...]:
        """Return the script steps of an arm; each ends when the next one begins, at the latest.

        A simulator repeats its newest step to a recorder that starts later: the end of a script is no script.
        """
        steps = [(at, action, duration) for at, (_, action, duration) in self.in_order(self._steps.get(arm, []))]
        if all(action == "done" for _, action, _ in steps):
            return ()
        ends = [*(begin for begin, _, _ in steps[1:]), math.inf]
        return tuple(ScriptedStep(name, at, min(at + s, end)) for (at, name, s), end in zip(steps, ends, strict=False))

    def _carried(self, arm: str, end: float) -> tuple[Span, ...] | None:
        """Return when the arm was carried, by its reported states; None if no state of it was recorded.

        end: s, of the arm's recording. An arm that is carried in the last state before it is carried until then. What
        the recording does not show of the arm's way down becomes a note.
        """
        states = [(at, state) for at, (_, state) in self.in_order(self._states.get(arm, []))]
        if not states:
            return None
        groups = [list(group) for carried, group in groupby(states, lambda state: state[1] in CARRIED) if carried]
        spans = [(group[0][0], group[-1][0]) for group in groups]
        time, last = states[-1]
        if last in CARRIED and 0.0 < end - time < STATE_GAP:
            spans[-1] = spans[-1][0], end
        # Else the joint states go on: they show the way down.
        if (self._is_cut or end - time < STATE_GAP) and last in (*CARRIED, State.LETTING_DOWN):
            missing = "before the arm was down" if last == State.LETTING_DOWN else "while the arm is carried"
            self.notes.append(f"{arm}: the recording ends {missing}: it does not show how the arm was let down")
            self.is_partial = True
        return tuple(spans)


def _value(value: Any) -> object:
    """Return the Python value of a rcl_interfaces/ParameterValue, whose type is the number of its field."""
    found = [*vars(value).values()][value.type] if value.type else "not set"
    return found.tolist() if hasattr(found, "tolist") else found
