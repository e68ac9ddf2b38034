# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a recording holds: its topics, and what the reader makes of them, as plain data that needs no bag library."""

import re
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import Param, check_owned, owned, params_of
from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.trial.analysis import Recording
from exo_gravity.lab.vocabulary import source_of

SUBJECT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}")  # a folder's name on every file system
LONGEST = 1000  # characters of a text


@dataclass(frozen=True)
class Session:
    """The subject and the purpose of a recording. Raises ParameterError, which names the field.

    No name of a person belongs in any field.
    """

    subject: str = owned("", "code of the subject, such as P01; no name")
    protocol: str = owned("", "protocol that is followed")
    note: str = owned("", "note on the session; no name")
    version: str = ""  #: of the package that recorded; '' if it is not known

    def __post_init__(self) -> None:
        check_owned(self)
        if self.subject and not SUBJECT.fullmatch(self.subject):
            expected = "a code of at most 32 letters A-Z, digits, - and _, such as P01: it names a folder"
            raise ParameterError("subject", self.subject, expected)
        for name in ("protocol", "note"):
            check_text(name, getattr(self, name))

    def folder(self, day: date) -> str:
        """Return the folder of the subject's recordings of a day, below all others: 'P01/2026-03-14'."""
        return f"{self.subject}/{day:%Y-%m-%d}" if self.subject else ""


def check_text(name: str, text: Any) -> str:
    """Return `text`; raise ParameterError unless it is a text of at most 1000 characters.

    A browser's field may cut an emoji in half. The half (a lone surrogate) cannot be encoded, so it is refused.
    """
    if not isinstance(text, str) or len(text) > LONGEST or "\0" in text or re.search("[\ud800-\udfff]", text):
        raise ParameterError(name, text, f"a text of at most {LONGEST} whole characters")
    return text


JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"
BRIDGE = "can_bridge"  # the node whose state is that of its arm
# Of each arm, in its namespace
STATES, COMMANDS, STEPS, ASSIST = "joint_states", "effort_commands", "wearer_step", "assist_efforts"
WEARER = ("wearer_efforts", "wearer_efforts_std", "support_request")
# Of all
DIAGNOSTICS, PARAMETER_EVENTS, MARKERS, IMU = "/diagnostics", "/parameter_events", "/event_marker", "/imu/data"
TILT_TOPIC, TILT_TYPE = "/imu/pitch_yaw", "geometry_msgs/msg/Vector3Stamped"
# Of the recorder, in the recording alone
PARAMETERS, LOSSES, SESSION = "/recorder/parameters", "/recorder/losses", "/recorder/session"
READ = {  # type of each topic, or last part of its name, that the reader decodes
    STATES: JOINT_STATE,
    COMMANDS: JOINT_STATE,
    STEPS: STRING,
    DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
    PARAMETER_EVENTS: "rcl_interfaces/msg/ParameterEvent",
    IMU: "sensor_msgs/msg/Imu",
    TILT_TOPIC: TILT_TYPE,
    PARAMETERS: STRING,
    LOSSES: STRING,
    SESSION: STRING,
    MARKERS: STRING,
}


def name_of(path: Path) -> str:
    """Return the name of a recording: that of its folder, or of its file without the end."""
    return path.name if path.is_dir() else path.stem


def leaf(topic: str) -> str:
    """Return the last part of a topic's name."""
    return topic.rpartition("/")[2]


def arm_of(name: str) -> str:
    """Return the namespace of a topic or node without slashes, 'arm' for the root namespace."""
    return name.rpartition("/")[0].strip("/") or "arm"


class NodeStatus(NamedTuple):
    """What a node reported on /diagnostics when its level or message changed."""

    node: str  #: 'right/can_bridge'
    level: int  #: of diagnostic_msgs/DiagnosticStatus; 0: OK
    message: str  #: for people
    fault: str  #: code of the latched fault of a bridge, 'none' without one
    fault_text: str  #: for people; '' if the recording has none


class Event(NamedTuple):
    """A marker, a fault, a warning or a changed parameter."""

    time: float  #: s since the start of the recording
    text: str  #: for people
    setting: tuple[str, str, Any] | None = None  #: node, name and new value of a changed parameter
    status: NodeStatus | None = None  #: of a fault or a warning, and of its end


@dataclass(frozen=True)
class Bag:
    """What a recording holds."""

    path: Path
    start: int  #: ns since 1970 of time 0
    recordings: tuple[Recording, ...]  #: one per arm
    events: tuple[Event, ...]  #: faults, warnings and changed parameters
    parameters: dict[str, str]  #: YAML text by node
    notes: tuple[str, ...]  #: missing parts that do no harm
    problems: tuple[str, ...]  #: unreadable parts, one sentence each
    is_partial: bool = False  #: whether it was cut short, or ends before its arms were down
    session: Session = field(default_factory=Session)  #: of whom, and what for
    markers: tuple[Event, ...] = ()  #: set by the operator or by a node
    #: the trunk's motion, (n, 7): s since the start, angular velocity (3,) in rad/s, what it feels as gravity (3,) as
    #: a share of 1 g, in its axes
    trunk: np.ndarray = field(default_factory=lambda: np.empty((0, 7)))
    #: its tilt as published on `/imu/pitch_yaw`, (n, 3): s since the start, pitch and roll in rad
    tilt: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    sources: dict[str, Source] = field(default_factory=dict)  #: what the arms' nodes say of them, by arm

    @property
    def trial(self) -> str:
        """The name of the trial's folder: `trial` records into NAME_DATE_TIME/bag."""
        path = self.path.resolve()
        return path.parent.name if name_of(path) == "bag" else name_of(path)

    def source(self, arm: str) -> Source:
        """Return whether `arm` was simulated: as its nodes say, else by their parameters."""
        from exo_gravity.lab.inputs.arms import recorded_of  # not for the nodes that record and show
        from exo_gravity.lab.inputs.parameter_file import node_of

        has_simulator = node_of(arm, "simulator") in self.parameters
        return self.sources.get(arm) or source_of(recorded_of(self.parameters, arm, "can_bridge"), has_simulator)

    def columns(self) -> dict[str, np.ndarray]:
        """Return the time series, a row for each arm, sample and joint: columns of equal length by their names.

        subject: the session's code; arm, joint; time_s since the start; step: of the script from 1 on, and its action,
        0 and '' outside of it; carried: whether the motors carried the arm; position_rad, velocity_rad_per_s,
        torque_nm as measured, command_nm as requested, NaN where unknown; source: simulated, real or unknown.
        """
        arms = [_columns(recording, self.source(recording.name)) for recording in self.recordings]
        columns = {name: np.concatenate([arm[name] for arm in arms]) for name in arms[0]}
        return {"subject": np.full(len(columns["arm"]), self.session.subject, object), **columns}

    def to_frame(self) -> Any:
        """Return `columns` as a pandas.DataFrame. Raises ModuleNotFoundError without pandas."""
        import pandas

        return pandas.DataFrame(self.columns())


def _columns(recording: Recording, source: Source) -> dict[str, np.ndarray]:
    time, joints = recording.time, len(recording.joint_names)
    step, action = np.zeros(len(time), int), np.full(len(time), "", object)
    for number, one in enumerate(recording.steps, 1):
        within = slice(*np.searchsorted(time, (one.start, one.end)))
        step[within], action[within] = number, one.action
    shared = {"time_s": time, "step": step, "action": action, "carried": recording.is_carried}
    values = (recording.position, recording.velocity, recording.effort, recording.command)
    names = ("position_rad", "velocity_rad_per_s", "torque_nm", "command_nm")
    return {
        "arm": np.full(len(time) * joints, recording.name, object),
        "joint": np.tile(np.array(recording.joint_names, object), len(time)),
        **{name: np.repeat(column, joints) for name, column in shared.items()},
        **{name: np.ravel(column) for name, column in zip(names, values, strict=True)},
        "source": np.full(len(time) * joints, source.value, object),
    }


# The parameters of `recorder`.
RECORDER = (
    Param("output", "", "new folder for the recording", fixed=True, required=True),
    Param("live", False, "print the latest state as one line of JSON, ten times a second", fixed=True),
    *params_of(Session, fixed=True),
)
