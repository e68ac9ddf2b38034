"""Checks whether the motors can provide the torque that the compensator's settings require, outside the control loop.

Motors and joint limits are parameters of `can_bridge`, which are requested once. A budget takes about 0.2 s of
arithmetic. It runs in a separate thread, and pauses after each millisecond: without pauses, at any priority, it kept
the loop's threads from their processor for up to 0.1 s (measured, Linux 6.18, two busy cores). While a budget is
computed, newer settings wait; the newest of them comes next.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import rclpy
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.budget import Workspace, budget, motor_torques, overload
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.params import CAN_BRIDGE

WITHIN = "within rated torque everywhere"
PAUSE = 0.005  # s, about 500 times per budget
BRIDGE_PARAMETERS = ("motor", "torque_scale", "position_min", "position_max")


class BudgetWatch:
    """Call `update` regularly; `text` is the result for the newest settings that were checked."""

    def __init__(self, node: Node, joint_names: Sequence[str], max_tilt: float) -> None:
        self.text = "unknown: waiting for can_bridge's parameters"
        self._node = node
        self._names = tuple(joint_names)
        self._max_tilt = max_tilt
        self._client = node.create_client(GetParameters, "can_bridge/get_parameters")
        self._reply: rclpy.Future | None = None
        self._bridge: Sequence[ParameterValue] | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="budget")
        self._job: Future | None = None
        self._checked: tuple | None = None

    def update(self, settings: Settings) -> None:
        """Collect a finished budget, and start one for `settings` if they are new. Never blocks."""
        if self._bridge is None:
            self._request()
        elif self._job is not None and self._job.done():
            self.text, self._job = self._job.result(), None
            if self.text != WITHIN:
                self._node.get_logger().warning(f"{self.text}; efforts stay clamped to max_effort")
        elif self._job is None:
            support = settings.support if settings.mode == "zero_g" else 0.0
            work = settings.robot, tuple(settings.wearer_mass), tuple(settings.wearer_cog), support
            if work != self._checked:
                self._checked = work
                self._job = self._pool.submit(self._sentence, *work)

    def _request(self) -> None:
        """Request motors and joint limits; each call takes the next step."""
        if self._reply is None:
            if self._client.service_is_ready():
                self._reply = self._client.call_async(GetParameters.Request(names=list(BRIDGE_PARAMETERS)))
        elif self._reply.done():
            self._bridge = self._reply.result().values
            self._node.destroy_client(self._client)  # the executor then waits for one entity less

    def _sentence(self, robot: ArmModel, mass: Sequence[float], cog: Sequence[float], support: float) -> str:
        # A thread inherits its creator's policy, and thread_priority sets that of all threads: never SCHED_FIFO here.
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        try:
            values = dict(zip(BRIDGE_PARAMETERS, map(parameter_value_to_python, self._bridge or ()), strict=False))
            bridge = values_of([param for param in CAN_BRIDGE if param.name in BRIDGE_PARAMETERS], values)
            workspace = Workspace(bridge["position_min"], bridge["position_max"], self._max_tilt)
            torques = motor_torques(bridge["motor"], bridge["torque_scale"])
            joints = budget(robot, (mass, cog), support, workspace, *torques, lambda: time.sleep(PAUSE))
            return overload(self._names, joints) or WITHIN
        except ParameterError as error:
            return f"unknown: can_bridge has {error}"
