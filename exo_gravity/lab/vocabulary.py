# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The words on /diagnostics of nodes off the path of a torque, for programs to read: docs/keys.md."""

from exo_gravity.core.vocabulary import Word

# wearer


class WearerState(Word):
    """What the estimate of the wearer's torque does."""

    WAITING = "waiting"
    STOPPED = "stopped"
    ESTIMATING = "estimating"


class NoEstimate(Word):
    """Why the wearer's torque is not estimated."""

    NO_COMPENSATOR = "no_compensator"
    NO_PARAMETERS = "no_parameters"
    REFUSED_PARAMETERS = "refused_parameters"
    NO_DESCRIPTION = "no_description"
    NO_JOINT_STATES = "no_joint_states"
    INCOMPLETE_JOINT_STATES = "incomplete_joint_states"
    NO_TILT = "no_tilt"


class Budget(Word):
    """Whether the motors hold an arm in every pose."""

    WITHIN_RATED = "within_rated"
    ABOVE_RATED = "above_rated"
    UNKNOWN = "unknown"


class Adapts(Word):
    """Whether the support adapts."""

    OFF = "off"
    ON = "on"
    HELD = "held"


# the other nodes


class NodeState(Word):
    """What a node off the path of a torque is doing."""

    WAITING = "waiting"
    RUNNING = "running"
    PUBLISHING = "publishing"
    MEASURING = "measuring"
    WITHDRAWN = "withdrawn"
    DONE = "done"


class SimulatorWarning(Word):
    """What makes a simulated arm differ from a sound real one."""

    STALLED = "stalled"
    DISCONNECTED = "disconnected"
