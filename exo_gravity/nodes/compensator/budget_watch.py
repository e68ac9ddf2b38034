"""Checks whether the motors can provide the torque that the compensator's settings require, outside the control loop.

Motors and joint limits are parameters of `can_bridge`, which are requested once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rclpy
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.budget import BRIDGE_PARAMETERS, BudgetRequest, overload
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.params import CAN_BRIDGE
from exo_gravity.nodes.ros.budget_thread import BudgetThread

WITHIN = "within rated torque everywhere"
TABLE = [param for param in CAN_BRIDGE if param.name in BRIDGE_PARAMETERS]


class BudgetWatch:
    """Call `update` regularly; `text` is the result for the newest settings that were checked."""

    def __init__(self, node: Node, joint_names: Sequence[str]) -> None:
        self.text = "unknown: waiting for can_bridge's parameters"
        self._node = node
        self._names = tuple(joint_names)
        self._client = node.create_client(GetParameters, "can_bridge/get_parameters")
        self._reply: rclpy.Future | None = None
        self._bridge: dict[str, Any] = {}
        self._thread = BudgetThread()

    def update(self, settings: Settings) -> None:
        """Collect a finished budget, and start one for `settings` if they are new. Never blocks."""
        if not self._bridge:
            self._request()
            return
        s = settings
        support = s.support if s.mode == "zero_g" else 0.0
        load = s.wearer_mass, s.wearer_cog
        if self._thread.update(BudgetRequest.of(s.robot, load, support, self._bridge, s.use_imu)):
            self.text = self._sentence()
            if self.text != WITHIN:
                self._node.get_logger().warning(f"{self.text}; efforts stay clamped to max_effort")

    def _request(self) -> None:
        """Request motors and joint limits; each call takes the next step."""
        if self._reply is None:
            if self._client.service_is_ready():
                self._reply = self._client.call_async(GetParameters.Request(names=list(BRIDGE_PARAMETERS)))
        elif self._reply.done() and self._client is not None:
            values = map(parameter_value_to_python, self._reply.result().values)
            self._node.destroy_client(self._client)  # the executor then waits for one entity less
            self._client = None
            try:
                self._bridge = values_of(TABLE, dict(zip(BRIDGE_PARAMETERS, values, strict=False)))
            except ParameterError as error:
                self.text = f"unknown: can_bridge has {error}"
                self._node.get_logger().warning(self.text)

    def _sentence(self) -> str:
        result = self._thread.result
        if isinstance(result, ParameterError):
            return f"unknown: can_bridge has {result}"
        return overload(self._names, result or ()) or WITHIN
