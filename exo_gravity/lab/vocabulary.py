# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The words on /diagnostics of nodes off the path of a torque (docs/keys.md), and whether an arm is simulated."""

from collections.abc import Iterable, Mapping
from typing import Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import source_of_bus
from exo_gravity.core.vocabulary import Source, Word

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


# What a report says of it, of several arms together.
STATEMENTS = {
    Source.SIMULATED: "Simulated: programs made these numbers, not a person and not a motor.",
    Source.REAL: "Recorded on a real arm.",
    Source.UNKNOWN: "The recording does not say whether the arm was real or simulated.",
}


def source_of(bridge: Mapping[str, Any], has_simulator: bool) -> Source:
    """Return the source of an arm.

    An arm is simulated if its device says so: a simulator plays it, or its bus leads to no motor. It is real if its
    parameter file names a bus that leads to motors. Otherwise its source is unknown, and is said to be.

    bridge: the parameters of its `can_bridge`, {} if they are not known.
    has_simulator: whether a simulator plays this arm.
    """
    if has_simulator:
        return Source.SIMULATED
    interface = bridge.get("can.interface")
    try:
        return source_of_bus(interface, bridge.get("can.channel", "")) if interface else Source.UNKNOWN
    except ParameterError:  # a channel that this version does not know
        return Source.UNKNOWN


def of_all(sources: Iterable[Source]) -> Source:
    """Return the source of several arms: simulated if one of them is, real if all are, otherwise unknown."""
    found = set(sources)
    if Source.SIMULATED in found:
        return Source.SIMULATED
    return Source.REAL if found == {Source.REAL} else Source.UNKNOWN
