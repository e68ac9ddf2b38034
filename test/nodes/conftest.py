# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Fixtures for the tests of running nodes."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from ..support.launched_nodes import LaunchedNodes
from ..support.node_thread import Served, own_node
from ..support.ros_probe import RosProbe


@pytest.fixture
def node() -> Iterator[Node]:
    """A node in the namespace /right, in a separate context, which ends with the test."""
    with own_node("listener") as (node, _):
        yield node


@pytest.fixture(scope="module")
def executor() -> Iterator[SingleThreadedExecutor]:
    """The executor of one node in the namespace /right, which the tests of a module share."""
    with own_node("spinning") as (_, executor):
        yield executor


@pytest.fixture
def served() -> Iterator[Served]:
    """A lifecycle node and a client; `spin` handles what has arrived for either."""
    with own_node("asking") as own:
        served = Served(*own)
        yield served
        served.close()


@pytest.fixture
def probe() -> Iterator[RosProbe]:
    probe = RosProbe()
    yield probe
    probe.close()


@pytest.fixture
def prepare(tmp_path: Path) -> Callable[..., LaunchedNodes]:
    """A function that writes a changed parameter file without starting its nodes."""

    def prepare(**changes: Any) -> LaunchedNodes:
        return LaunchedNodes(tmp_path, **changes)

    return prepare


@pytest.fixture
def launch(prepare: Callable[..., LaunchedNodes]) -> Iterator[Callable[..., LaunchedNodes]]:
    """A function that starts nodes, which end with the test."""
    launched: list[LaunchedNodes] = []

    def launch(**changes: Any) -> LaunchedNodes:
        launched.append(prepare(**changes).start())
        return launched[-1]

    yield launch
    for nodes in launched:
        nodes.stop()
        print("\n".join(nodes.log))  # pytest shows it if the test failed
