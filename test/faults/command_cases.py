# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of the fault matrix about messages of efforts that are wrong, and about another clock.

In most of them this process commands the arm.
"""

from __future__ import annotations

from sensor_msgs.msg import JointState

from .actions import change_message
from .fault_case import Action, FaultCase
from .rigs import CommandedRig, ExternalClockRig

HOUR = 3600  # s


def shift_clock(seconds: float) -> Action:
    return lambda rig: setattr(rig, "clock_offset", seconds)


def shift_stamp(seconds: int) -> Action:
    def change(message: JointState) -> None:
        message.header.stamp.sec += seconds

    return change_message(change)


def ask_for_speed(message: JointState) -> None:
    message.velocity = [0.5] * 4


# fmt: off
EFFORT_COMMANDS = (
    FaultCase("three efforts", change_message(lambda message: message.effort.pop()), CommandedRig),
    FaultCase("a wrong name", change_message(lambda message: message.name.__setitem__(3, "left_knee")), CommandedRig),
    FaultCase("stamps an hour old", shift_stamp(-HOUR), CommandedRig),
    FaultCase("efforts with a velocity", change_message(ask_for_speed), CommandedRig, outcomes=("command_impossible",)),
)
CLOCK = (
    FaultCase("clock set back an hour", shift_clock(-HOUR), ExternalClockRig, None, outcomes=("active",)),
    FaultCase("clock set ahead an hour", shift_clock(HOUR), ExternalClockRig, None, outcomes=("active",)),
)
# fmt: on
