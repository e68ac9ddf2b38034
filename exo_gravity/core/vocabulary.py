# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The words that programs read on /diagnostics, beside the sentences for people: docs/keys.md.

Each word stands once: the states and the fault codes of an arm in core/safety/command.py, those of nodes off the path
in lab/vocabulary.py, all others here. What decides on a torque tells a word and its sentence at once, in a `Status`.
"""

from enum import Enum
from typing import NamedTuple

INTERFACE = 1  # the version of the keys and words: docs/topics.md
NONE, UNKNOWN = "none", "unknown"  # nothing to tell; something that the node does not know
TEXT = " text"  # a key that ends so has a sentence, which no program may read


class Word(str, Enum):
    """A word of one key. As text it is the word itself."""

    def __str__(self) -> str:
        return str(self.value)


class Status(NamedTuple):
    """What there is to tell; false where that is nothing. As text it is its sentence."""

    code: str  #: for programs
    text: str  #: for people, a sentence

    def __bool__(self) -> bool:
        return bool(self.text)

    def __str__(self) -> str:
        return self.text


NO_REASON = Status(NONE, "")


# can_bridge


INACTIVE = "inactive"  # `state` while the lifecycle node is not active


class Source(Word):
    """Where the readings of an arm come from."""

    SIMULATED = "simulated"
    REAL = "real"
    UNKNOWN = "unknown"


class Motors(Word):
    """Whether motors of an arm may be on."""

    OFF = "off"
    ON = "on"
    UNREACHED = "unreached"


class Wait(Word):
    """What a start waits for, or why it ended; also the code of a fault that is waited out."""

    REPLIES = "replies"
    WATCHDOG = "watchdog"
    BOARD_SETUP = "board_setup"
    JOINT_LIMITS = "joint_limits"
    REST = "rest"
    EFFORTS = "efforts"
    MOTORS_OFF = "motors_off"
    TRUNK = "trunk"
    POSE = "pose"
    CALM = "calm"
    HOLD_STILL = "hold_still"
    MOTOR_ON = "motor_on"  #: not waited for: it ended the start


class Resume(Word):
    """Whether an arm can be carried on after its fault."""

    POSSIBLE = "possible"
    NO_FAULT = "no_fault"
    HAS_CAUSE = "has_cause"
    ZEROS_UNSURE = "zeros_unsure"


class Answer(Word):
    """How a request to an arm ended."""

    NONE = "none"
    DONE = "done"
    REFUSED = "refused"
    INACTIVE = "inactive"
    LEAVING = "leaving"
    TOO_OLD = "too_old"
    OVERTAKEN = "overtaken"
    BUS_ERROR = "bus_error"
    NO_RESPONSE = "no_response"


class BridgeWarning(Word):
    """What a bridge works with although it is not as it should be."""

    LIMITED = "limited"
    LATE_EFFORTS = "late_efforts"
    ABOVE_RATED_TORQUE = "above_rated_torque"
    ODD_TEMPERATURE = "odd_temperature"
    SLOW_LOOP = "slow_loop"


class RefusedEfforts(Word):
    """Why an effort command was refused."""

    SECOND_PUBLISHER = "second_publisher"
    UNKNOWN_STAMP = "unknown_stamp"
    INVALID = "invalid"


# compensator


class CompensatorState(Word):
    """What a compensator does."""

    WAITING = "waiting"
    COMPENSATING = "compensating"
    WITHDRAWN = "withdrawn"
    STOPPED = "stopped"
    FAULTED = "faulted"


class Withdrawal(Word):
    """Why a compensator has no efforts."""

    NO_TILT = "no_tilt"
    LATE_TILT = "late_tilt"
    LATE_TILT_STAMP = "late_tilt_stamp"
    REFUSED_TILT = "refused_tilt"
    INVALID_JOINT_STATES = "invalid_joint_states"
    IMPOSSIBLE_ANGLES = "impossible_angles"
    LAW_NOT_FINITE = "law_not_finite"
    SECOND_PUBLISHER = "second_publisher"
    OUTPUT_FAULT = "output_fault"


class CompensatorWarning(Word):
    """What a compensator works with although it is not as it should be."""

    LATE_TILT = "late_tilt"
    EXACT_LAW = "exact_law"
    TERMS_REFUSED = "terms_refused"
    CHANGING_LOAD = "changing_load"
    CLAMPED = "clamped"


class AssistProblem(Word):
    """Why the efforts of the outer loop are not used, or not in full."""

    OFF = "off"
    NO_MESSAGES = "no_messages"
    STOPPED = "stopped"
    INVALID = "invalid"
    SECOND_PUBLISHER = "second_publisher"
    LATE = "late"


class SupportRequested(Word):
    """What a compensator makes of requests for support."""

    NONE = "none"
    FRESH = "fresh"
    SECOND_PUBLISHER = "second_publisher"
    INVALID = "invalid"
    LATE = "late"


# imu, and every node


class ImuState(Word):
    """What the node `imu` does."""

    WAITING = "waiting"
    PUBLISHING = "publishing"
    SETTLING = "settling"
    STOPPED = "stopped"
    REFUSING = "refusing"
    SECOND_PUBLISHER = "second_publisher"
    NO_DEVICE = "no_device"


class ClockState(Word):
    """Whether a node with `use_sim_time` gets a clock."""

    PUBLISHED = "published"
    MISSING = "missing"


def words(*found: object) -> str:
    """Return words, names or reasons as one value: separated by commas, `none` for none."""
    return ", ".join(map(str, found)) or NONE
