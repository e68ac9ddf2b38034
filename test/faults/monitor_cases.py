"""Rows of the fault matrix in which efforts come in time, and are not what gravity needs."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import ClassVar

from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel
from exo_gravity.lab.inputs.parameter_file import load

from ..support import CONFIG
from ..support.launched_nodes import LaunchedNodes, Parameters
from ..support.ros_probe import HOME
from .actions import simulator
from .command_cases import change_message
from .fault_case import FaultCase
from .rig import Rig
from .rigs import UPRIGHT, CommandedRig

COMPENSATOR = load(CONFIG / "sim.yaml")["/right/compensator"]
ROBOT = ArmModel(*(COMPENSATOR[name] for name in ("link_length", "robot.cog", "robot.mass")))
STATED: Parameters = {"largest_moment": list(ROBOT.first_moment), "largest_addition": [0.0] * 4}
UNEXPLAINED = ("unexplained_torque",)
TREMOR = 2.0  # Nm


class MonitoredCommandsRig(CommandedRig):
    """The bridge knows what the robot needs at most; this process is in the compensator's place."""

    def _make_nodes(self, port: int) -> list[LaunchedNodes]:
        bridge = {"rate": self.rate, **STATED}
        return [self._nodes(without=("compensator", "imu", "simulator"), port=port, can_bridge=bridge)]


class WrongSideRig(Rig):
    """The arm hangs, and its compensator takes it for the left one."""

    pose: Sequence[float] = HOME
    simulator: ClassVar[Parameters] = UPRIGHT
    bridge: ClassVar[Parameters] = STATED
    compensator: ClassVar[Parameters] = {"side": "left"}


def tremble(message: JointState) -> None:
    message.effort[1] += TREMOR * math.sin(16.0 * math.pi * time.monotonic())


def reverse(message: JointState) -> None:
    message.effort[1] = -message.effort[1]


def triple(message: JointState) -> None:
    message.effort = [3.0 * torque for torque in message.effort]


# fmt: off
MONITOR = (
    FaultCase("efforts 3 times too large", change_message(triple), MonitoredCommandsRig, limit=0.5,
        outcomes=UNEXPLAINED),
    FaultCase("efforts oscillate at 8 Hz", change_message(tremble), MonitoredCommandsRig, limit=0.5,
        outcomes=UNEXPLAINED),
    FaultCase("effort of joint 2 with the wrong sign", change_message(reverse), MonitoredCommandsRig, limit=0.3,
        outcomes=UNEXPLAINED),
    FaultCase("wrong side, the trunk leans by 0.3 rad", simulator(trunk__roll=0.3), WrongSideRig, limit=3.0,
        outcomes=UNEXPLAINED, clear=simulator(trunk__roll=0.0)),
)
# fmt: on
