"""What a recording holds: its topics, and what the reader makes of them, as plain data that needs no bag library."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from exo_gravity.core.params import Param
from exo_gravity.core.trial.recording import Recording

JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"
# Of each arm, in its namespace
STATES, COMMANDS, STEPS, ASSIST = "joint_states", "effort_commands", "wearer_step", "assist_efforts"
# Of all
DIAGNOSTICS, PARAMETER_EVENTS = "/diagnostics", "/parameter_events"
# Of the recorder, in the recording alone
PARAMETERS, LOSSES = "/recorder/parameters", "/recorder/losses"
READ = {  # type of each topic, or last part of its name, that the reader decodes
    STATES: JOINT_STATE,
    COMMANDS: JOINT_STATE,
    STEPS: STRING,
    DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
    PARAMETER_EVENTS: "rcl_interfaces/msg/ParameterEvent",
    PARAMETERS: STRING,
    LOSSES: STRING,
}


def leaf(topic: str) -> str:
    """Return the last part of a topic's name."""
    return topic.rpartition("/")[2]


def arm_of(name: str) -> str:
    """Return the namespace of a topic or node without slashes, 'arm' for the root namespace."""
    return name.rpartition("/")[0].strip("/") or "arm"


def is_wanted(topic: str, msgtype: str) -> bool:
    """Return whether the reader decodes this topic."""
    return msgtype in (READ.get(topic), READ.get(leaf(topic)))


class Event(NamedTuple):
    """A fault, a warning or a changed parameter."""

    time: float  #: s since the start of the recording
    text: str


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


# The parameters of `recorder`.
RECORDER = (
    Param("output", "", "new folder for the recording", fixed=True, required=True),
    Param("live", False, "print the latest state as one line of JSON, ten times a second", fixed=True),
)
