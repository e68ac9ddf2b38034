# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Nodes of a test, on a separate thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation

InvalidHandle = rclpy_implementation.InvalidHandle


class NodeThread:
    """Nodes with these names in a separate context, which a thread spins until `close`.

    after_spin: called on that thread whenever something may have arrived.
    """

    def __init__(self, *names: str, namespace: str = "", after_spin: Callable[[], object] = lambda: None) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.nodes = [rclpy.create_node(name, namespace=namespace, context=self.context) for name in names]
        self.executor = SingleThreadedExecutor(context=self.context)
        for node in self.nodes:
            self.executor.add_node(node)
        self._after_spin = after_spin
        self._closing = False
        self._thread = threading.Thread(target=self._spin, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def _spin(self) -> None:
        while not self._closing:
            with suppress(InvalidHandle):  # a test has just destroyed a publisher
                self.executor.spin_once(timeout_sec=0.1)
            self._after_spin()

    def close(self) -> None:
        self._closing = True
        self._thread.join()
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        rclpy.try_shutdown(context=self.context)
