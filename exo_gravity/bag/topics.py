"""The topics of a recording that matter here, by name and type."""

from __future__ import annotations

JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"
# Of each arm, in its namespace
STATES, COMMANDS, STEPS, ASSIST = "joint_states", "effort_commands", "wearer_step", "assist_efforts"
# Of all
DIAGNOSTICS, PARAMETER_EVENTS = "/diagnostics", "/parameter_events"
# Of the recorder, in the recording alone
PARAMETERS, LOSSES = "/recorder/parameters", "/recorder/losses"
OTHERS = {
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
    if leaf(topic) in (STATES, COMMANDS):
        return msgtype == JOINT_STATE
    return OTHERS.get(topic) == msgtype or (leaf(topic) == STEPS and msgtype == STRING)
