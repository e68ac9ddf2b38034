"""Whether the motors can provide the torque that the settings require, computed outside the control loop.

A budget takes about 0.2 s of arithmetic, on a thread of its own. The thread pauses after each millisecond: without
pauses, at any priority, it kept the control loop's threads from their processor for up to 0.1 s (measured, Linux 6.18,
two busy cores).
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from rclpy.node import Node

from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.budget import BRIDGE_PARAMETERS, BudgetRequest, JointBudget, largest_support, overload
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.params import CAN_BRIDGE
from exo_gravity.nodes.ros.parameters import NodeParameters

PAUSE = 0.005  # s, about 500 times per budget
WITHIN = "within rated torque everywhere"
Result = tuple[JointBudget, ...] | ParameterError


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
        self._bridge: dict[str, Any] = {}
        self._parameters = NodeParameters(node, "can_bridge", self._on_bridge, BRIDGE_PARAMETERS)
        self._request: BudgetRequest | None = None
        self._job: Future[Result] | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="budget")

    def update(self, settings: Settings) -> None:
        """Collect a finished budget, or start one for `settings` if they are new. Never blocks."""
        self._parameters.update()
        if self._job is not None:
            if self._job.done():
                self._take(self._job.result())
                self._job = None
        elif self._bridge:
            s = settings
            support = s.support if s.mode == "zero_g" else 0.0
            request = BudgetRequest.of(s.robot, (s.wearer_mass, s.wearer_cog), support, self._bridge, s.use_imu)
            if request != self._request:
                self._request, self._job = request, self._pool.submit(compute, request)

    def _take(self, result: Result) -> None:
        if isinstance(result, ParameterError):
            self.largest_support = "unknown"
            self._note(f"unknown: can_bridge has {result}")
        else:
            is_worn = self._request is not None and any(self._request.load[0])
            self.largest_support = f"{largest_support(result) or 0.0:g}" if is_worn else "none"
            self._note(overload(self._names, result) or WITHIN)

    def _on_bridge(self, values: dict[str, Any]) -> None:
        table = [param for param in CAN_BRIDGE if param.name in BRIDGE_PARAMETERS]
        try:
            self._bridge = values_of(table, values)
        except ParameterError as error:
            self._note(f"unknown: can_bridge has {error}")
        self._parameters.destroy()  # the executor then waits for two entities less

    def _note(self, text: str) -> None:
        self.text = text
        if text != WITHIN:
            self._logger.warning(f"{text}; efforts stay clamped to max_effort")


def compute(request: BudgetRequest) -> Result:
    """Return the budget of `request`, or the error, with pauses and without real-time scheduling."""
    # A thread inherits its creator's policy, and thread_priority sets that of all threads: never SCHED_FIFO here.
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    try:
        return request.joints(lambda: time.sleep(PAUSE))
    except ParameterError as error:
        return error
