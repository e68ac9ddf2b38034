# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Nodes of a test, in a ROS context of their own; on a separate thread, if wanted."""

import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node

from exo_gravity.nodes.ros.inner import NodeExecutor

from .waiting import wait_until


class NodeThread:
    """Nodes with these names in a separate context, which a thread spins from `start` until `close`.

    options: those of `create_node`.
    """

    def __init__(self, *names: str, **options: Any) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.nodes = [rclpy.create_node(name, context=self.context, **options) for name in names]
        self.executor = SingleThreadedExecutor(context=self.context)
        for node in self.nodes:
            self.executor.add_node(node)
        self._closing = False
        self._thread = threading.Thread(target=self._spin, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def _spin(self) -> None:
        while not self._closing:
            with suppress(rclpy_implementation.InvalidHandle):  # a test has just destroyed a publisher
                self.executor.spin_once(timeout_sec=0.1)

    def close(self) -> None:
        self._closing = True
        if self._thread.ident is not None:
            self._thread.join()
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@contextmanager
def own_node(name: str, namespace: str = "/right", **options: Any) -> Iterator[tuple[Node, SingleThreadedExecutor]]:
    """Make a node, and an executor that has it, which the test spins; they end with the block."""
    thread = NodeThread(name, namespace=namespace, **options)
    try:
        yield thread.nodes[0], thread.executor
    finally:
        thread.close()


class NodeRig:
    """Nodes under test, and `user`, which plays what is around them; waiting spins all that were added.

    statuses: the newest ones by the last part of their nodes' names.
    """

    def __init__(self, *arguments: str) -> None:
        rclpy.init(args=["--ros-args", *arguments])
        self.executor, self.nodes = SingleThreadedExecutor(), list[Any]()
        self.user = self.add(rclpy.create_node("environment"))
        self.statuses: dict[str, DiagnosticStatus] = defaultdict(DiagnosticStatus)
        self.user.create_subscription(DiagnosticArray, "/diagnostics", self.on_diagnostics, 50)

    def add(self, node: Any, is_spun: bool = True) -> Any:
        """Have a node spun, and destroyed at the end."""
        self.nodes.append(node)
        if is_spun:
            self.executor.add_node(node)
        return node

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        self.statuses.update({status.name.rpartition("/")[2]: status for status in message.status})

    def values_of(self, node: str) -> Mapping[str, str]:
        """Return the newest value of each key of a node, '' before its first report."""
        return defaultdict(str, {item.key: item.value for item in self.statuses[node].values})

    def wait_until(self, condition: Callable[[], object]) -> None:
        wait_until(condition, lambda: self.executor.spin_once(timeout_sec=0.01), seen=lambda: dict(self.statuses))

    def close(self) -> None:
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        rclpy.try_shutdown()


class Served:
    """A lifecycle node `served` with an executor, and a client node with another; nothing spins by itself."""

    def __init__(self, client: Node, own: SingleThreadedExecutor) -> None:
        self.client, self._own = client, own
        self.node = LifecycleNode("served", namespace="/right", context=client.context, enable_logger_service=True)
        self.executor = NodeExecutor(client.context)
        self.executor.add_node(self.node)

    def send(self, kind: Any, name: str, request: Any) -> Any:
        """Send a request to a service of the node; return the future of its response."""
        client = self.client.create_client(kind, f"served/{name}")
        wait_until(client.service_is_ready)
        return client.call_async(request)

    def spin(self) -> None:
        """Let node and client each handle what has arrived."""
        self.executor.spin_once(0.01)
        self._own.spin_once(0.01)

    def answer(self, future: Any) -> Any:
        wait_until(future.done, self.spin)
        return future.result()

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
