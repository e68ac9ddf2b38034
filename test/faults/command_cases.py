# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of the fault matrix about effort commands: wrong, late for a moment, by another clock, or unexplained.

In most of them this process commands the arm.
"""

from __future__ import annotations

import math
import signal
import time

import numpy as np
from sensor_msgs.msg import JointState

from .actions import change_message, in_turn, pause, send_signal
from .fault_case import Action, FaultCase
from .rig import Rig
from .rigs import CommandedRig, ExternalClockRig, MonitoredCommandsRig, TwoLaunchersRig

HOUR = 3600  # s
UNEXPLAINED = ("unexplained_torque",)
TREMOR = 2.0  # Nm
STEADY = 0.6  # rad/s
RIDE = 0.5  # s from the fault, in which the motors have damped and are free again


def shift_clock(seconds: float) -> Action:
    return lambda rig: setattr(rig, "clock_offset", seconds)


def shift_stamp(seconds: int) -> Action:
    def change(message: JointState) -> None:
        message.header.stamp.sec += seconds

    return change_message(change)


def second_effort(value: float) -> Action:
    return change_message(lambda message: message.effort.__setitem__(1, value))


def tremble(message: JointState) -> None:
    message.effort[1] += TREMOR * math.sin(16.0 * math.pi * time.monotonic())


def reverse(message: JointState) -> None:
    message.effort[1] = -message.effort[1]


def ask_for_speed(message: JointState) -> None:
    message.velocity = [0.5] * 4


def triple(message: JointState) -> None:
    message.effort = [3.0 * torque for torque in message.effort]


def stopped_for(seconds: float, node: str) -> Action:
    """Stop a node's process for `seconds` s."""
    return in_turn(send_signal(node, signal.SIGSTOP), pause(seconds), send_signal(node, signal.SIGCONT))


def damped_for_a_moment(records: np.ndarray) -> str:
    """Return what is wrong unless every motor damps the motion once, and none does so later."""
    since = records["time"] - records["time"][0]
    if not records["damping"][since < RIDE].max(axis=0, initial=0.0).all():
        return "ridden through without damping"
    return "still damped after the ride" if records["damping"][since > RIDE].any() else ""


def resumed(rig: Rig) -> None:
    """Carry the arm again with one request."""
    rig.probe.wait_until(lambda: rig.probe.state == "fault", 10.0)
    assert rig.probe.diagnostic("can_bridge", "resume") == "possible"
    answer = rig.probe.trigger("resume")
    assert answer.success, answer.message
    rig.probe.wait_until(lambda: rig.probe.state == "active", 10.0)


# fmt: off
EFFORT_COMMANDS = (
    FaultCase("effort NaN", second_effort(math.nan), CommandedRig),
    FaultCase("three efforts", change_message(lambda message: message.effort.pop()), CommandedRig),
    FaultCase("a wrong name", change_message(lambda message: message.name.__setitem__(3, "left_knee")), CommandedRig),
    FaultCase("no efforts", change_message(lambda message: setattr(message, "effort", [])), CommandedRig),
    FaultCase("stamps an hour old", shift_stamp(-HOUR), CommandedRig),
    FaultCase("efforts with a velocity", change_message(ask_for_speed), CommandedRig, outcomes=("command_impossible",)),
)
CLOCK = (
    FaultCase("clock set back an hour", shift_clock(-HOUR), ExternalClockRig, None, outcomes=("active",)),
    FaultCase("clock set ahead an hour", shift_clock(HOUR), ExternalClockRig, None, outcomes=("active",)),
)
MONITOR = (
    FaultCase("efforts 3 times too large", change_message(triple), MonitoredCommandsRig, limit=0.5,
        outcomes=UNEXPLAINED),
    FaultCase("efforts oscillate at 8 Hz", change_message(tremble), MonitoredCommandsRig, limit=0.5,
        outcomes=UNEXPLAINED),
    FaultCase("effort of joint 2 with the wrong sign", change_message(reverse), MonitoredCommandsRig, limit=0.3,
        outcomes=UNEXPLAINED),
)
RIDES = (
    FaultCase("compensator stopped for 0.1 s", stopped_for(0.1, "compensator"), TwoLaunchersRig, None,
        outcomes=("active",), speed_limit=STEADY, check=damped_for_a_moment),
    FaultCase("imu stopped for 0.1 s", stopped_for(0.1, "imu"), limit=None, outcomes=("active",), speed_limit=STEADY,
        check=damped_for_a_moment),
    FaultCase("compensator stopped for 0.4 s, then resume", stopped_for(0.4, "compensator"), TwoLaunchersRig,
        outcomes=("command_stale",), speed_limit=STEADY, afterwards=resumed),
)
# fmt: on
