"""One arm as `robot_model` follows it: its parameters, requested from its nodes, and its newest joint states."""

from __future__ import annotations

import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future
from sensor_msgs.msg import JointState

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.view.arm_description import OF_BRIDGE, OF_COMPENSATOR, ArmDescription, described
from exo_gravity.core.view.scene import ArmView
from exo_gravity.nodes.ros.hot_path import NEWEST, HotPath
from exo_gravity.nodes.ros.messages import by_name

STALE = 0.5  # s after which a reading or a state is no longer shown
STALE_STATE = 2.0  # s; states come twice a second
FIELDS = ("position", "velocity", "effort")


class ViewedArm:
    """The arm in `namespace` ('/right', '' for the root). description: None until both nodes have answered.

    problem: why there is no description or no reading, '' if nothing is wrong.
    """

    def __init__(self, node: Node, namespace: str) -> None:
        self.description: ArmDescription | None = None
        self.problem = f"waiting for the parameters of {namespace}/compensator and {namespace}/can_bridge"
        self.states_topic = f"{namespace}/joint_states"
        self.states: JointState | None = None
        self._node = node
        self._bridge = f"{namespace}/can_bridge".lstrip("/")
        self._status, self._status_time = ("", ""), -math.inf
        self._time = -math.inf
        self._values: dict[str, dict[str, Any]] = {}
        self._requests = {
            leaf: (node.create_client(GetParameters, f"{namespace}/{leaf}/get_parameters"), names)
            for leaf, names in (("compensator", OF_COMPENSATOR), ("can_bridge", OF_BRIDGE))
        }
        self._subscription = HotPath(node, JointState, self.states_topic, self._on_states, NEWEST)

    def request(self) -> None:
        """Request the parameters of those nodes that can be asked and were not; call it until `description` is set."""
        for leaf, (client, names) in list(self._requests.items()):
            if client.service_is_ready():
                del self._requests[leaf]
                future = client.call_async(GetParameters.Request(names=list(names)))
                future.add_done_callback(lambda done, of=leaf, asked=names: self._on_values(of, asked, done))

    def note(self, status: DiagnosticStatus) -> None:
        """Keep the status of this arm's bridge; ignore any other."""
        if status.name == self._bridge:
            values = {pair.key: pair.value for pair in status.values}
            self._status, self._status_time = (values.get("state", ""), status.message), time.monotonic()

    def view(self) -> ArmView | None:
        """Return what is known of the arm now; None without a description or a fresh reading."""
        self._subscription.poll()
        now = time.monotonic()
        if self.description is None:
            return None
        if self.states is None or now - self._time > STALE:
            self.problem = f"no messages on {self.states_topic}"
            return None
        names = self.description.limits.joint_names
        try:
            theta, velocity, effort = (by_name(self.states, field, names) for field in FIELDS)
        except ParameterError as error:
            self.problem = f"{self.states_topic}: {error.name} must be {error.expected}"
            return None
        self.problem = ""
        state, message = self._status if now - self._status_time < STALE_STATE else ("", "")
        return ArmView(self.description, theta, velocity, effort, state, message)

    def _on_states(self, message: JointState, _info: dict[str, Any]) -> None:
        self.states, self._time = message, time.monotonic()

    def _on_values(self, leaf: str, names: tuple[str, ...], future: Future) -> None:
        values = map(parameter_value_to_python, future.result().values)
        self._values[leaf] = dict(zip(names, values, strict=True))
        if len(self._values) < 2:
            return
        try:
            self.description = described(self._values["compensator"], self._values["can_bridge"])
        except (ParameterError, TypeError) as error:  # TypeError: a parameter that the node does not have is None
            self.problem = f"{self._bridge.rpartition('/')[0] or 'arm'}: {error}"
            self._node.get_logger().error(self.problem)
