# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameters, status and newest messages of other nodes, for nodes that are not on the path of a torque."""

import math
import time
from collections.abc import Callable, Collection, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future

from exo_gravity.nodes.ros.parameters import plain
from exo_gravity.nodes.ros.subscriptions import PolledSubscription

RESPONSE_TIMEOUT = 5.0  # s after which a request to a node that has died is repeated


class Statuses:
    """The newest status of each node on /diagnostics."""

    def __init__(self, node: Node) -> None:
        self._newest: dict[str, tuple[float, dict[str, Any]]] = {}  # monotonic s of its arrival, and its values
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_message, 50)

    def within(self, timeout: float, name: str) -> dict[str, Any]:
        """Return the `status_values` of the node, as 'right/can_bridge'; {} if they are older than `timeout` s."""
        arrived, values = self._newest.get(name, (-math.inf, {}))
        return values if time.monotonic() - arrived < timeout else {}

    def _on_message(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        self._newest.update({status.name: (now, status_values(status)) for status in message.status})


def status_values(status: DiagnosticStatus) -> dict[str, Any]:
    """Return the values of a status by key, with its `level` as a number and its `message`."""
    values = {pair.key: pair.value for pair in status.values}
    return values | {"level": int.from_bytes(status.level, "big"), "message": status.message}


class Latest:
    """The newest message of `topic`, or what `use` makes of it. The topic is polled only in `within`."""

    def __init__(
        self, node: Node, msgtype: type, topic: str, use: Callable[[Any], Any] = lambda message: message
    ) -> None:
        self._use, self._content, self._arrived = use, None, -math.inf
        self._subscription = PolledSubscription(node, msgtype, topic, self._on_message)

    def within(self, timeout: float) -> Any:
        """Return it; None if it is older than `timeout` s."""
        self._subscription.poll()
        return self._content if time.monotonic() - self._arrived < timeout else None

    def _on_message(self, message: Any, _info: dict[str, Any]) -> None:
        self._content, self._arrived = self._use(message), time.monotonic()


class NodeParameters:
    """The parameters of another node, read over its services.

    name: its full name, or its name in `node`'s namespace.
    on_read(name, values): called on the executor's thread each time that they were read.
    once: whether they are read only once; the executor then no longer waits for the clients.
    fitting(name, values): what is kept of them.

    values: by name; {} until they are known.
    is_present: whether the node has its services. One that has died can stay in ROS's list of names.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        on_read: Callable[[str, dict[str, Any]], object] = lambda name, values: None,
        once: bool = False,
        fitting: Callable[[str, dict[str, Any]], dict[str, Any]] = lambda name, values: values,
    ) -> None:
        self.values: dict[str, Any] = {}
        self.is_present = False
        self._node, self._name = node, name
        self._on_read, self._once, self._fitting = on_read, once, fitting
        self._get = node.create_client(GetParameters, f"{name}/get_parameters")
        self._list = node.create_client(ListParameters, f"{name}/list_parameters")
        self._due = -math.inf  # s, when to ask; infinite while the values are known
        self._is_done = False

    def refresh(self) -> None:
        """Read the parameters again, at the next `update`."""
        self._due = -math.inf

    def update(self) -> None:
        """Read the parameters if they may have changed and the node answers. Call it on the executor's thread."""
        if self._is_done:
            return
        self.is_present = self._get.service_is_ready() and self._list.service_is_ready()
        now = time.monotonic()
        if not self.is_present:
            self._due = -math.inf  # it may return with other values
        elif now >= self._due:
            self._due = now + RESPONSE_TIMEOUT
            self._list.call_async(ListParameters.Request()).add_done_callback(self._on_names)

    def _on_names(self, listed: Future) -> None:
        if not self._is_done:
            names = listed.result().result.names
            asked = self._get.call_async(GetParameters.Request(names=names))
            asked.add_done_callback(lambda done: self._on_values(names, done))

    def _on_values(self, names: Sequence[str], asked: Future) -> None:
        if self._is_done:
            return
        if math.isfinite(self._due):  # else they have changed since
            self._due = math.inf
        try:
            values = [parameter_value_to_python(value) for value in asked.result().values]
        except RuntimeError:  # of a type that ROS does not have
            return
        known = {name: plain(value) for name, value in zip(names, values, strict=False) if value is not None}
        self.values = self._fitting(self._name, known)
        if self._once:
            self._is_done = True
            self._node.destroy_client(self._get)
            self._node.destroy_client(self._list)
        self._on_read(self._name, self.values)


class OtherNodes:
    """The other nodes in this ROS domain, with their parameters.

    leaves: the last parts of the names that are looked for; () for all.
    options: of each NodeParameters.

    found: the nodes by full name; one that has ended stays.
    """

    def __init__(self, node: Node, leaves: Collection[str] = (), **options: Any) -> None:
        self.found: dict[str, NodeParameters] = {}
        self._node, self._leaves, self._options = node, leaves, options

    def update(self) -> None:
        """Find new nodes, and read parameters that may have changed. Call it on the executor's thread."""
        for leaf, namespace in self._node.get_node_names_and_namespaces():
            name = f"{namespace.rstrip('/')}/{leaf}"
            is_wanted = leaf in self._leaves if self._leaves else not leaf.startswith("_")
            if is_wanted and name not in self.found and name != self._node.get_fully_qualified_name():
                self.found[name] = NodeParameters(self._node, name, **self._options)
        for parameters in self.found.values():
            parameters.update()

    def values(self, name: str) -> dict[str, Any]:
        """Return the newest parameters of a node; {} while they are not known."""
        return self.found[name].values if name in self.found else {}
