"""Rows of the fault matrix in which something is late for a moment: the arm stays carried, or one press carries on."""

from __future__ import annotations

import signal

import numpy as np

from .actions import in_turn, pause, send_signal
from .fault_case import Action, FaultCase
from .rig import Rig
from .rigs import TwoLaunchersRig

STEADY = 0.6  # rad/s
RIDE = 0.5  # s from the fault, in which the motors have damped and are free again


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
RIDES = (
    FaultCase("compensator stopped for 0.1 s", stopped_for(0.1, "compensator"), TwoLaunchersRig, None,
        outcomes=("active",), speed_limit=STEADY, check=damped_for_a_moment),
    FaultCase("imu stopped for 0.1 s", stopped_for(0.1, "imu"), limit=None, outcomes=("active",), speed_limit=STEADY,
        check=damped_for_a_moment),
    FaultCase("compensator stopped for 0.4 s, then resume", stopped_for(0.4, "compensator"), TwoLaunchersRig,
        outcomes=("command_stale",), speed_limit=STEADY, afterwards=resumed),
)
# fmt: on
