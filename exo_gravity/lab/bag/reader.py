# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A rosbag2 recording -> the arrays of each arm, its script, faults and parameters.

An arm is a namespace with a `joint_states` topic. Each joint state is paired with the command that was in force. Time
is that of the header stamps; where these run backwards or are far from the recorder's clock, it is the time of arrival.
Whether an arm was carried comes from the key `state` of its can_bridge on /diagnostics, never from the text.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import up_in_body
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import MAX_EFFORT
from exo_gravity.core.trunk.inputs import NOT_REPORTED
from exo_gravity.core.vocabulary import NONE, Source
from exo_gravity.lab.bag import content
from exo_gravity.lab.bag.clock import CLOCK, Timeline, timeline
from exo_gravity.lab.bag.content import (
    BRIDGE,
    COMMANDS,
    JOINT_STATE,
    STATES,
    STEPS,
    Bag,
    Event,
    NodeStatus,
    arm_of,
    leaf,
)
from exo_gravity.lab.bag.joints import FIELDS, JointArrays, JointSeries
from exo_gravity.lab.bag.layout import TYPES, Batch, Decoder
from exo_gravity.lab.bag.pairing import Thinning, arrival_of, clocks_of, efforts_in_force
from exo_gravity.lab.bag.storage import Storage, StoredRows
from exo_gravity.lab.inputs.arms import recorded_of
from exo_gravity.lab.inputs.parameter_file import recorded_parameters
from exo_gravity.lab.trial.recording import CARRIED, Recording, ScriptedStep, Span
from exo_gravity.lab.trial.session import Session


@dataclass(frozen=True)
class Plausible:
    """Which positions are those of an arm in radians."""

    angle: float = 2.0 * math.pi  #: rad; no joint of an arm turns farther
    share: float = 0.01  #: of the samples that may be beyond it, and are left out: more are of another unit


PLAUSIBLE = Plausible()
STATE_GAP = 1.0  # s; can_bridge reports its state twice a second, except while it ends
KNOWN = (Source.SIMULATED, Source.REAL)
LISTED_STEPS = 3  # of the clock, a note each
LISTED_TOPICS = 20  # in a sentence: a robot's recording may have hundreds

Row = tuple[int, int]  # number of a message in the recording, time of arrival in ns


def read_bag(path: str | Path, every: int = 1) -> Bag:
    """Read a recording: a rosbag2 folder, or an .mcap or .db3 file, complete or cut short.

    every: of each arm's samples, the first of so many is kept. Each has the command that was in force.

    Raises DataError, one sentence, if there is nothing to report: no recording, an empty one, or no arm in it.
    """
    storage, contents = Storage(path), _Contents(every)
    contents.read(storage)
    states = sorted(name for name, joints in contents.joints.items() if leaf(name) == STATES and joints.count)
    if not states and not contents.problems:
        problem = f"the recording has no topic {STATES} of type {JOINT_STATE}; it has {_listed(storage.topics)}"
        if not storage.topics or any(leaf(t) == STATES and kind == JOINT_STATE for t, kind in storage.topics.items()):
            problem = "the recording is empty: it has no messages"
        raise DataError(f"{path}: {'; '.join((problem, *contents.notes))}")
    series = {name: found for name in contents.arms(states) if (found := contents.series(name))}
    if not series:
        raise DataError(f"{path}: {'; '.join(contents.problems)}")
    reference = max(series, key=lambda name: len(series[name].ordinal))
    line = timeline(series[reference].ordinal, series[reference].arrival)
    start = min(int(line.times(one.ordinal, one.arrival).min()) for one in series.values())
    contents.note_steps(line, start)
    seconds = _Seconds(line, start)
    recordings = tuple(r for name in [*series] if (r := contents.recording(name, series.pop(name), seconds)))
    if not recordings:
        raise DataError(f"{path}: {'; '.join(contents.problems)}")
    if contents.losses:
        contents.notes.append(f"the recorder lost messages: {contents.losses}")
    events, markers = (
        tuple(Event(now, *what) for now, (_, *what) in seconds.sorted(found))
        for found in (contents.events, contents.markers)
    )
    return Bag(
        Path(path), start, recordings, events, contents.parameters, tuple(contents.notes), tuple(contents.problems),
        contents.is_partial, contents.session, markers, contents.trunk.rows(seconds), contents.tilt.rows(seconds),
        contents.sources,
    )  # fmt: skip


def _listed(topics: Mapping[str, str]) -> str:
    """Return the first topics with their types, and the number of the others."""
    shown = [f"{topic} ({kind or 'of no type'})" for topic, kind in sorted(topics.items())]
    others = len(shown) - LISTED_TOPICS
    return ", ".join(shown[:LISTED_TOPICS]) + (f" and {others} more" if others > 0 else "")


class _Seconds(NamedTuple):
    """Times in s since the start of the recording."""

    line: Timeline
    start: int  #: ns

    def of(self, ordinal: Any, arrival: Any) -> np.ndarray:
        """Return the times (n,) of messages by their numbers (n,) and times of arrival (n,) in ns."""
        ordinal, arrival = np.array(ordinal, np.int64), np.array(arrival, np.int64)
        return (self.line.times(ordinal, arrival) - self.start) / 1e9

    def sorted(self, found: Sequence[tuple[Row, Any]] | Sequence[tuple[Any, ...]]) -> list[tuple[float, Any]]:
        """Return entries that begin with a Row in the order of their times, each with its time."""
        if not found:
            return []
        times = self.of(*zip(*(entry[0] for entry in found), strict=True)).tolist()
        return sorted(zip(times, found, strict=True), key=itemgetter(0))


class _Samples:
    """Numbers of a topic, by `columns` from its decoded messages: (n, numbers), NaN in a row that is left out."""

    def __init__(self, msgtype: str, columns: Callable[[np.ndarray], np.ndarray], width: int) -> None:
        self.decoder, self._columns, self._width = Decoder(msgtype), columns, width
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, ordinals: np.ndarray, batch: Batch) -> None:
        for index, _, values in self.decoder.decode(batch):
            rows = self._columns(values)
            kept = np.isfinite(rows).all(axis=1)
            self._parts.append((ordinals[index][kept], batch.arrival[index][kept], rows[kept]))

    def rows(self, seconds: _Seconds) -> np.ndarray:
        """Return the rows in order, each with its time in s first."""
        if not self._parts:
            return np.empty((0, 1 + self._width))
        ordinal, arrival, rows = (np.concatenate(columns) for columns in zip(*self._parts, strict=True))
        self._parts.clear()
        result = np.column_stack((seconds.of(ordinal, arrival), rows))
        return result[np.argsort(result[:, 0], kind="stable")]


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


def _pitch_and_roll(tilt: np.ndarray) -> np.ndarray:
    """Return pitch and roll in rad, (n, 2), of geometry_msgs/Vector3Stamped (n,)."""
    return np.column_stack((tilt["vector.y"], tilt["vector.x"]))


class _Contents:
    """Collects the messages of a recording, topic by topic. every: see `read_bag`."""

    def __init__(self, every: int) -> None:
        self.every = every
        self.joints: dict[str, JointArrays] = {}
        self.parameters: dict[str, str] = {}
        self.losses = ""
        self.session = Session()
        self.events: list[tuple[Any, ...]] = []  # row, text, setting and status of faults and changed parameters
        self.markers: list[tuple[Row, str]] = []  # row and text
        self.sources: dict[str, Source] = {}  # by arm, as the nodes say
        self.trunk = _Samples(content.READ[content.IMU], _turning_and_felt, 6)
        self.tilt = _Samples(content.TILT_TYPE, _pitch_and_roll, 2)
        self.notes: list[str] = []
        self.problems: list[str] = []
        self.is_cut = False  # the file was cut short
        self.is_partial = False  # it was, or an arm was not down at the end
        self._thinnings: dict[str, Thinning] = {}  # of an arm's commands, by the topic of its joint states
        self._names: dict[str, tuple[str, ...]] = {}  # of an arm's joints, by the topic of its joint states
        self._count = 0  # of the messages so far
        self._damaged: dict[str, int] = {}  # messages by topic
        self._unreadable: set[str] = set()
        self._steps: dict[str, list[tuple[Row, str, float]]] = {}  # by arm: row, action, duration
        self._states: dict[str, list[tuple[Row, str]]] = {}  # by arm: row, state
        self._last: dict[str, tuple[int, str]] = {}  # node -> level and text of its last status

    def _add_rows(self, rows: StoredRows) -> None:
        """Add messages. A topic with an invalid message becomes a problem, and its rest is ignored."""
        for (topic, msgtype), chosen, batch in rows.by_topic():
            ordinals = self._count + chosen
            if msgtype == JOINT_STATE:
                if topic not in self.joints:
                    kept = (FIELDS, self.every) if leaf(topic) == STATES else (("effort",), 1)
                    self.joints[topic] = JointArrays(topic, *kept)
                self.joints[topic].add(ordinals, batch)
            elif topic in (content.IMU, content.TILT_TOPIC):
                (self.trunk if topic == content.IMU else self.tilt).add(ordinals, batch)
            elif topic not in self._unreadable:
                self._add_messages(topic, msgtype, ordinals, batch)
        self._count += len(rows.topic)
        for states, joints in self.joints.items() if self.every > 1 else ():
            if leaf(states) == STATES:
                self._thinnings.setdefault(states, Thinning()).apply(self._commands_of(states), joints)

    def _add_messages(self, topic: str, msgtype: str, ordinals: np.ndarray, batch: Batch) -> None:
        for *row, data in zip(ordinals.tolist(), batch.arrival.tolist(), batch.messages(), strict=True):
            try:
                message = TYPES.deserialize_cdr(data, msgtype)
            except Exception:  # rosbags raises whatever its generated code raises
                self._damaged[topic] = self._damaged.get(topic, 0) + 1
                continue
            try:
                self._add(topic, (row[0], row[1]), message)
            except DataError as error:
                self._unreadable.add(topic)
                self.problems.append(str(error))
                return

    def read(self, storage: Storage) -> None:
        """Add the messages of a recording. Note what the files lack, and which messages are damaged."""
        for rows in storage.rows(content.is_wanted):
            self._add_rows(rows)
        self.notes += storage.notes
        if storage.cut_short:
            self.is_partial = self.is_cut = True
            self.notes.append(f"the recording was cut short ({storage.cut_short}): what was written before is reported")
        if storage.damaged:
            self.is_partial = True
            self.notes.append(f"the recording is damaged: parts left out: {storage.damaged}")
        decoders = {topic: joints.decoder for topic, joints in self.joints.items()}
        for topic, decoder in (
            *decoders.items(),
            (content.IMU, self.trunk.decoder),
            (content.TILT_TOPIC, self.tilt.decoder),
        ):
            self._damaged[topic] = self._damaged.get(topic, 0) + decoder.damaged
        for topic, count in self._damaged.items():
            if count and topic in self.joints and not self.joints[topic].count:
                self.problems.append(f"{topic}: {self.joints[topic].decoder.problem}")
            elif count:
                self.is_partial = True
                self.notes.append(f"{topic}: damaged messages left out: {count}")

    def arms(self, states: Sequence[str]) -> Sequence[str]:
        """Return the topics in `states` that belong to arms: those with efforts or a bridge, if there are any."""
        arms = [name for name in states if self._commands_of(name).count or arm_of(name) in self._states]
        for name in states if arms else ():
            if name not in arms:
                self.notes.append(
                    f"{name}: not reported: nothing commands its joints {', '.join(self.joints[name].names)}"
                )
        return arms or states

    def _commands_of(self, states: str) -> JointArrays:
        topic = states.removesuffix(STATES) + COMMANDS
        return self.joints.get(topic) or JointArrays(topic)

    def series(self, topic: str) -> JointSeries | None:
        """Return the joint states of an arm: of the joints that its efforts name, else of those that most have."""
        joints, commanded = self.joints[topic], self._commands_of(topic).names
        names = commanded if commanded and joints.has(commanded) else joints.names
        if commanded and sorted(names) == sorted(joints.names):
            names = joints.names  # in the order of the joint states
        series, others = joints.arrays(names)
        if others:
            self.notes.append(f"{topic}: messages of other joints left out: {others}; a topic of their own is better")
        self._names[topic] = names
        return series._replace(arrival=arrival_of(series))

    def note_steps(self, line: Timeline, start: int) -> None:
        """Note the steps of the clock."""
        ends = (line.end[:-1] - start) / 1e9
        if len(line.steps) > LISTED_STEPS:
            self.notes.append(f"the clock was set {len(line.steps)} times: the recording is divided there")
            return
        for step, end in zip(line.steps, ends.tolist(), strict=True):
            how = f"set back by {-step / 1e9:.1f} s" if step < 0 else f"set ahead by {step / 1e9:.1f} s, or it paused,"
            self.notes.append(f"the recording's clock was {how} at {end:.1f} s: it is divided there")

    def _add(self, topic: str, row: Row, message: Any) -> None:
        """Add one decoded message. Raises DataError for an invalid one."""
        if leaf(topic) == STEPS:
            try:
                step = json.loads(message.data)
                entry = row, str(step["action"]), float(step["duration"])
            except (ValueError, KeyError, TypeError, RecursionError):
                raise DataError(f"{topic}: invalid {STEPS} message") from None
            if not 0.0 <= entry[2] < math.inf:
                raise DataError(f"{topic}: duration = {entry[2]}: must be a number of seconds, 0 or more")
            self._steps.setdefault(arm_of(topic), []).append(entry)
        elif topic == content.DIAGNOSTICS:
            for status in message.status:
                self._add_status(row, status)
        elif topic == content.PARAMETER_EVENTS:
            for parameter in message.changed_parameters:
                name, value = parameter.name, _value(parameter.value)
                self.events.append((row, f"{message.node}: {name} = {value}", (message.node, name, value)))
        elif topic == content.LOSSES:
            self.losses = message.data
        elif topic == content.MARKERS:
            self.markers.append((row, message.data))
        elif topic == content.SESSION:
            try:
                self.session = Session(**json.loads(message.data))
            except (ValueError, TypeError, RecursionError, ParameterError):
                raise DataError(f"{topic}: invalid session") from None
        else:
            node = message.data.partition(":")[0].strip()
            try:
                if leaf(node) in ("compensator", BRIDGE):
                    recorded_of({node: message.data}, arm_of(node), leaf(node))
                else:
                    recorded_parameters(message.data, node)
                self.parameters[node] = message.data
            except DataError:
                self._damaged[topic] = self._damaged.get(topic, 0) + 1

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
        elif leaf(status.name) == BRIDGE and values.get("source") in KNOWN:
            self.sources.setdefault(arm_of(status.name), Source(values["source"]))

    def recording(self, topic: str, series: JointSeries, seconds: _Seconds) -> Recording | None:
        """Return the arm whose joint states are on `topic`; None if it is unreadable, which is a problem."""
        name, names = arm_of(topic), self._names[topic]
        arrival, stamp, near = clocks_of(series, seconds.line)
        values = series.values
        if np.any(np.diff(arrival) < 0):
            order = np.argsort(arrival, kind="stable")
            arrival, stamp, values = arrival[order], stamp[order], values[order]
        kept = self._plausible(name, names, values[:, FIELDS.index("position")])
        if kept is None:
            return None
        if not kept.all():
            arrival, stamp, values = arrival[kept], stamp[kept], values[kept]
        stamped = near > 0.5 and bool(np.all(np.diff(stamp) >= -CLOCK.back))
        clock = np.maximum.accumulate(stamp) if stamped else arrival
        command, steps = self._commands(topic, names, clock, stamped, seconds.line), self._script(name, seconds)
        time = (clock - seconds.start) / 1e9
        position, velocity, effort = np.moveaxis(values, 1, 0)
        self._forget_impossible(name, names, effort)
        self._forget_impossible(f"{name} {COMMANDS}", names, command)
        try:
            recording = Recording(name, names, time, position, velocity, effort, command, steps)
        except DataError as error:
            self.problems.append(str(error))
            return None
        return replace(recording, carried=self._carried(name, seconds, float(time[-1])))

    def _plausible(self, name: str, joints: Sequence[str], position: np.ndarray) -> np.ndarray | None:
        """Return which positions (n, joints) are those of an arm (n,); None if their unit is wrong, a problem."""
        finite = np.isfinite(position).all(axis=1)
        if not finite.any():
            least = joints[int(np.argmin(np.isfinite(position).sum(axis=0)))]
            self.problems.append(f"{name}: {least} has no position that is a number: must be in rad")
            return None
        beyond = np.abs(position) > PLAUSIBLE.angle
        far = finite & beyond.any(axis=1)
        if far.sum() > PLAUSIBLE.share * finite.sum():
            joint = int(np.argmax(beyond[finite].sum(axis=0)))
            largest = float(np.abs(position[finite, joint]).max())
            self.problems.append(
                f"{name}: {joints[joint]} = {largest:.4g} rad: must be within ±2 pi; is it in degrees?"
            )
            return None
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
        is_unit = beyond.any(axis=1).mean() > PLAUSIBLE.share
        effort[np.ones_like(beyond) if is_unit else beyond] = np.nan
        question = "; are they in mNm?" if is_unit else ""
        self.notes.append(
            f"{name}: torques left out: {joints[joint]} = {largest:.4g} Nm: must be within ±{MAX_EFFORT:g} Nm{question}"
        )

    def _commands(
        self, states: str, names: Sequence[str], clock: np.ndarray, stamped: bool, line: Timeline
    ) -> np.ndarray:
        """Return the effort (n, joints) that was in force at each time of `clock`, NaN where there was none."""
        unknown = np.full((len(clock), len(names)), np.nan, np.float32)
        commands = self._commands_of(states)
        if not commands.count:
            self.notes.append(f"{commands.topic} was not recorded: the torque error is unknown")
            return unknown
        if not commands.has(names):
            problem = f"joint names differ: {', '.join(commands.names)}; {states} has {', '.join(names)}"
            self.problems.append(f"{commands.topic}: {problem}: the torque error is unknown")
            return unknown
        series, _ = commands.arrays(names)
        arrival, stamp, _ = clocks_of(series._replace(arrival=arrival_of(series)), line)
        return efforts_in_force(stamp if stamped else arrival, series.values[:, 0], clock)

    def _script(self, arm: str, seconds: _Seconds) -> tuple[ScriptedStep, ...]:
        """Return the script steps of an arm; each ends when the next one begins, at the latest."""
        steps = [(at, action, duration) for at, (_, action, duration) in seconds.sorted(self._steps.get(arm, []))]
        ends = [*(begin for begin, _, _ in steps[1:]), float("inf")]
        return tuple(ScriptedStep(name, at, min(at + s, end)) for (at, name, s), end in zip(steps, ends, strict=False))

    def _carried(self, arm: str, seconds: _Seconds, end: float) -> tuple[Span, ...] | None:
        """Return when the arm was carried, by its reported states; None if no state of it was recorded.

        end: s, of the arm's recording. An arm that is carried in the last state before it is carried until then. What
        the recording does not show of the arm's way down becomes a note.
        """
        if arm not in self._states:
            return None
        states = [(at, state) for at, (_, state) in seconds.sorted(self._states[arm])]
        groups = [list(group) for carried, group in groupby(states, lambda state: state[1] in CARRIED) if carried]
        spans = [(group[0][0], group[-1][0]) for group in groups]
        time, last = states[-1]
        if last in CARRIED and 0.0 < end - time < STATE_GAP:
            spans[-1] = spans[-1][0], end
        if self.is_cut or end - time < STATE_GAP:  # else the joint states go on: they show the way down
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
