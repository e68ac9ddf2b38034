# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The parameters of another node, as it comes and goes."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import pytest
import rclpy
from rclpy.node import Node

from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.nodes.ros import parameters as parameters_module
from exo_gravity.nodes.ros.parameters import RESPONSE_TIMEOUT, NodeParameters

from ..support.waiting import wait_until

keep_to_this_machine()


@pytest.fixture
def node(executor) -> Node:
    """The node that asks."""
    return executor.get_nodes()[0]


def other_node(node: Node, value: float = 1.0) -> Node:
    other = rclpy.create_node("other", namespace="/right", context=node.context)
    other.declare_parameter("gain", value)
    return other


def test_a_node_that_has_gone_and_returned_is_read_anew(node, executor):
    seen: list[float] = []
    parameters = NodeParameters(node, "/right/other", lambda _name, values: seen.append(values["gain"]))

    def spin() -> None:
        executor.spin_once(timeout_sec=0.05)
        parameters.update()

    for value in (1.0, 2.0):
        other = other_node(node, value)
        executor.add_node(other)
        wait_until(lambda value=value: parameters.is_present and parameters.values.get("gain") == value, spin)
        executor.remove_node(other)
        other.destroy_node()
        wait_until(lambda: not parameters.is_present, spin)
    assert seen == [1.0, 2.0]


def test_a_name_without_services_is_not_present(node):
    ghost = rclpy.create_node("ghost", context=node.context, start_parameter_services=False)
    parameters = NodeParameters(node, "/ghost")
    parameters.update()
    assert not parameters.is_present
    ghost.destroy_node()


def test_what_is_read_once_ignores_the_answers_after_the_first(node, executor, monkeypatch):
    other = other_node(node)
    clock = itertools.count(0.0, RESPONSE_TIMEOUT).__next__  # every update asks again
    monkeypatch.setattr(parameters_module, "time", SimpleNamespace(monotonic=clock))
    answers: list[object] = []

    parameters = NodeParameters(node, "/right/other", lambda _name, values: answers.append(values), once=True)
    wait_until(lambda: parameters.is_present, parameters.update)
    for _ in range(5):
        parameters.update()
    executor.add_node(other)  # which answers all requests now
    wait_until(lambda: answers, lambda: executor.spin_once(timeout_sec=0.05))
    for _ in range(50):
        executor.spin_once(timeout_sec=0.01)
    assert len(answers) == 1
    executor.remove_node(other)
    other.destroy_node()
