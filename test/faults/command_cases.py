"""Rows of the fault matrix in which this process commands the arm, or sets its clock."""

from __future__ import annotations

import math
from collections.abc import Callable

from sensor_msgs.msg import JointState

from .fault_case import Action, FaultCase
from .rigs import CommandedRig, ExternalClockRig

HOUR = 3600  # s


def change_message(change: Callable[[JointState], object]) -> Action:
    return lambda rig: setattr(rig, "change_message", change)


def shift_clock(seconds: float) -> Action:
    return lambda rig: setattr(rig, "clock_offset", seconds)


def shift_stamp(seconds: int) -> Action:
    def change(message: JointState) -> None:
        message.header.stamp.sec += seconds

    return change_message(change)


def second_effort(value: float) -> Action:
    return change_message(lambda message: message.effort.__setitem__(1, value))


# fmt: off
EFFORT_COMMANDS = (
    FaultCase("effort NaN", second_effort(math.nan), CommandedRig),
    FaultCase("three efforts", change_message(lambda message: message.effort.pop()), CommandedRig),
    FaultCase("a wrong name", change_message(lambda message: message.name.__setitem__(3, "left_knee")), CommandedRig),
    FaultCase("no efforts", change_message(lambda message: setattr(message, "effort", [])), CommandedRig),
    FaultCase("stamps an hour old", shift_stamp(-HOUR), CommandedRig),
)
CLOCK = (
    FaultCase("clock set back an hour", shift_clock(-HOUR), ExternalClockRig, None, outcomes=("active",)),
    FaultCase("clock set ahead an hour", shift_clock(HOUR), ExternalClockRig, None, outcomes=("active",)),
)
# fmt: on
