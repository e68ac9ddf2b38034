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


class WeighingPhase(Word):
    """How far a weighing is."""

    NONE = "none"
    TAKING_OVER = "taking_over"
    SWEEPING = "sweeping"
    DONE = "done"
    FAILED = "failed"


class WeighingRefused(Word):
    """Why a weighing does not begin."""

    TERMS = "terms"
    SUPPORT = "support"
    SLOW = "slow"
    UNDER_WAY = "under_way"
    CHANGING_LOAD = "changing_load"
    NO_HAND = "no_hand"


class WeighingTrouble(Word):
    """Why a weighing has no result."""

    HANGS_DOWN = "hangs_down"
    MOVES = "moves"
    SETTINGS_CHANGED = "settings_changed"
    NO_JOINT_STATES = "no_joint_states"
    MOVED_AWAY = "moved_away"
    HAND_ON_ARM = "hand_on_arm"
    TOO_HEAVY = "too_heavy"
    RESTLESS = "restless"
    NOT_FOLLOWED = "not_followed"
    NO_LOAD = "no_load"
