"""Whether the motors can provide the torque that the settings require, computed outside the control loop.

A budget takes about 0.2 s of arithmetic, on a thread of its own. The thread pauses after each millisecond: without
pauses, at any priority, it kept the control loop's threads from their processor for up to 0.1 s (measured, Linux 6.18,
two busy cores).
"""

import math
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from rclpy.node import Node

from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.budget import USUAL_TILT, budget, largest_support, motor_torques, overload, workspace
from exo_gravity.nodes.ros.parameters import NodeParameters

PAUSE = 0.005  # s, about 500 times per budget
WITHIN = "within rated torque everywhere"
BRIDGE_PARAMETERS = {"motor", "torque_scale", "position_min", "position_max"}
Load = tuple[tuple[float, ...], tuple[float, ...]]  # the wearer's mass (4,) kg and centre of gravity (4,) m
Request = tuple[ArmModel, Load, float, float]  # robot, wearer, support 0..1, largest tilt in rad


class BudgetWatch:
    """Checks the newest settings, one budget at a time. Call `update` regularly.

    Motors and joint limits are parameters of `can_bridge`, which are read once.
    """

    def __init__(self, node: Node, joint_names: Sequence[str]) -> None:
        self.text = "unknown: waiting for can_bridge's parameters"  #: the result for the settings checked last
        #: share 0..1 of the wearer's arm within rated torque everywhere, 0 if none is, 'none' without a wearer
        self.largest_support = "unknown"
        self._logger = node.get_logger()
        self._names = tuple(joint_names)
        self._bridge = NodeParameters(node, "can_bridge", once=True)
        self._request: Request | None = None
        self._job: Future[tuple[str, str]] | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="budget")

    def update(self, settings: Settings) -> None:
        """Collect a finished budget, or start one for `settings` if they are new. Never blocks."""
        self._bridge.update()
        if self._job is not None:
            if self._job.done():
                (self.text, self.largest_support), self._job = self._job.result(), None
                if self.text != WITHIN:
                    self._logger.warning(f"{self.text}; efforts stay clamped to max_effort")
        elif self._bridge.values.keys() >= BRIDGE_PARAMETERS:
            s = settings
            load = tuple(s.wearer_mass), tuple(s.wearer_cog)
            support = (1.0 if s.support_adapts else s.support) if s.mode == "zero_g" else 0.0
            request = s.loaded, load, support, math.radians(USUAL_TILT) if s.use_imu else 0.0
            if request != self._request:
                self._request = request
                self._job = self._pool.submit(compute, self._names, request, self._bridge.values)


def compute(names: Sequence[str], request: Request, bridge: Mapping[str, Any]) -> tuple[str, str]:
    """Return `text` and `largest_support` of `BudgetWatch`, with pauses and without real-time scheduling.

    names: of the joints (4,). bridge: its parameter values.
    """
    # A thread inherits its creator's policy, and thread_priority sets that of all threads: never SCHED_FIFO here.
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    robot, load, support, tilt = request
    try:
        bounds = workspace(bridge["position_min"], bridge["position_max"], tilt)
        rated, peak = motor_torques(bridge["motor"], bridge["torque_scale"])
        joints = budget(robot, load, support, bounds, rated, peak, lambda: time.sleep(PAUSE))
    except ParameterError as error:
        return f"unknown: can_bridge has {error}", "unknown"
    return overload(names, joints) or WITHIN, f"{largest_support(joints) or 0.0:g}" if any(load[0]) else "none"
