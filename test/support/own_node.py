# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A node for a test, in its own ROS context."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node


@contextmanager
def own_node(name: str, namespace: str = "/right", **options: Any) -> Iterator[tuple[Node, SingleThreadedExecutor]]:
    """Make a node, and an executor that has it; they end with the block. options: those of `create_node`."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node(name, namespace=namespace, context=context, **options)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)
