"""The parameters of another node, by the services that `ros2 param` uses, renewed when they change."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future

from exo_gravity.nodes.ros.declare import plain

TIMEOUT = 5.0  # s after which a request to a node that has died is repeated


class NodeParameters:
    """The parameters of the node with the full name `name`, in `values` once they are known.

    is_present: whether the node has its parameter services; a node that has died can stay in ROS's list of names.
    on_change: called on the executor's thread when they were read.
    """

    def __init__(self, node: Node, name: str, on_change: Callable[[], None]) -> None:
        self.name = name
        self.values: dict[str, Any] = {}
        self.is_present = False
        self._node = node
        self._on_change = on_change
        self._list = node.create_client(ListParameters, f"{name}/list_parameters")
        self._get = node.create_client(GetParameters, f"{name}/get_parameters")
        self._is_due, self._asked = True, -math.inf  # asked: monotonic s of a request without an answer yet
        self._is_destroyed = False

    def refresh(self) -> None:
        """Read the parameters again, at the next `update`."""
        self._is_due = True

    def update(self) -> None:
        """Read the parameters if they may have changed and the node answers. Call it on the executor's thread."""
        self.is_present = self._list.service_is_ready() and self._get.service_is_ready()
        if not self.is_present:
            self._is_due = True  # it may return with other values
            return
        now = time.monotonic()
        is_waiting = now - self._asked < TIMEOUT
        if (self._is_due or math.isfinite(self._asked)) and not is_waiting:
            self._is_due, self._asked = False, now
            self._list.call_async(ListParameters.Request()).add_done_callback(self._on_names)

    def destroy(self) -> None:
        """Remove the clients; answers that are still on their way are ignored."""
        self._is_destroyed = True
        self._node.destroy_client(self._list)
        self._node.destroy_client(self._get)

    def _on_names(self, future: Future) -> None:
        if self._is_destroyed:
            return
        names = list(future.result().result.names)
        asked = self._get.call_async(GetParameters.Request(names=names))
        asked.add_done_callback(lambda done: self._on_values(names, done))

    def _on_values(self, names: list[str], future: Future) -> None:
        if self._is_destroyed:
            return
        self._asked = -math.inf
        values = map(parameter_value_to_python, future.result().values)
        self.values = {name: plain(value) for name, value in zip(names, values, strict=False) if value is not None}
        self._on_change()
