# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of the fault matrix of people who leave: the author of the outer loop, and who holds control of the arm.

Where the outer loop fails, gravity compensation goes on without it.
"""

from __future__ import annotations

import math
import signal
from functools import partial

import numpy as np
from sensor_msgs.msg import JointState

from .actions import publish, reported, send_signal, stamped
from .fault_case import PROCESS_REACTION, Action, FaultCase
from .players import EFFORTS, FLOOD, GO_WRONG, NAMES, TOPIC
from .rig import Rig
from .rigs import AssistedRig, HeldRig, SuccessorRig

LET_DOWN = 1.5  # s from the death of who holds control
GONE_FOR = 0.45  # s from the fault, in which the assistance is out; that of a sound stream may then return
TOLERANCE = 0.08  # Nm
MAX_MOTION = 0.02  # rad
OTHER_EFFORTS = (0.0, 0.0, 0.0, 0.5)  # Nm


def the_arm_rests(records: np.ndarray) -> str:
    """Return what is wrong unless the arm rests."""
    motion = np.abs(records["position"] - records["position"][0]).max()
    return f"the arm moved by {motion:.2f} rad" if motion > MAX_MOTION else ""


def only_the_assistance_ends(records: np.ndarray, until: float = GONE_FOR) -> str:
    """Return what is wrong unless every motor keeps its torque without the assistance, and the arm rests.

    until: s after the fault in which the assistance must not return.
    """
    since = records["time"] - records["time"][0]
    gone = (since > PROCESS_REACTION) & (since < until)
    wrong = np.abs(records["torque"][gone] - (records["torque"][0] - EFFORTS))
    if wrong.max(initial=0.0) > TOLERANCE:
        return f"{wrong.max():.2f} Nm on top of gravity compensation, {1000 * PROCESS_REACTION:.0f} ms after the fault"
    return the_arm_rests(records)


def other_efforts(rig: Rig) -> JointState:
    """Return efforts of a second outer loop."""
    message: JointState = stamped(rig, JointState(name=NAMES, effort=OTHER_EFFORTS))
    return message


def outer_loop_case(name: str, inject: Action, reason: str) -> FaultCase:
    return FaultCase(
        name,
        inject,
        AssistedRig,
        limit=None,
        outcomes=("active",),
        check=only_the_assistance_ends,
        afterwards=reported("compensator", "assist reason", reason),
    )


# fmt: off
OUTER_LOOP = (
    outer_loop_case("outer loop killed", send_signal("outer_loop", signal.SIGKILL), "stopped"),
    outer_loop_case("outer loop frozen", send_signal("outer_loop", signal.SIGSTOP), "stopped"),
    outer_loop_case("outer loop sends NaN", send_signal("outer_loop", GO_WRONG), "invalid"),
    outer_loop_case("second outer loop for half a second", publish(JointState, TOPIC, other_efforts), "none"),
)
LEASES = (
    FaultCase("who holds control killed", send_signal("holder", signal.SIGKILL), HeldRig, LET_DOWN,
        outcomes=("control_lost",)),
    FaultCase("outer loop killed, the next one asks for 0 Nm", SuccessorRig.replace_outer_loop, SuccessorRig, None,
        outcomes=("active",), check=partial(only_the_assistance_ends, until=math.inf)),
    FaultCase("outer loop floods", send_signal("outer_loop", FLOOD), AssistedRig, None, outcomes=("active",),
        check=the_arm_rests),
)
# fmt: on
