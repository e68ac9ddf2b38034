"""The parameters of another node, as it comes and goes."""

import time

import rclpy
from rclpy.executors import SingleThreadedExecutor

from exo_gravity.nodes.ros import node_parameters
from exo_gravity.nodes.ros.parameters import NodeParameters


def test_a_node_that_has_gone_and_returned_is_read_anew(node):
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    parameters = NodeParameters(node, "/right/other", lambda: None)

    def wait_until(condition):
        deadline = time.monotonic() + 30.0
        while not condition():
            assert time.monotonic() < deadline
            executor.spin_once(timeout_sec=0.05)
            parameters.update()

    for value in (1.0, 2.0):
        other = rclpy.create_node("other", namespace="/right", context=node.context)
        other.declare_parameter("gain", value)
        executor.add_node(other)
        wait_until(lambda value=value: parameters.is_present and parameters.values.get("gain") == value)
        executor.remove_node(other)
        other.destroy_node()
        wait_until(lambda: not parameters.is_present)
    executor.shutdown()


def test_a_name_without_services_is_not_present(node):
    ghost = rclpy.create_node("ghost", context=node.context, start_parameter_services=False)
    parameters = NodeParameters(node, "/ghost", lambda: None)
    parameters.update()
    assert not parameters.is_present
    ghost.destroy_node()


def test_answers_after_the_first_are_ignored_once_it_is_destroyed(node, monkeypatch):
    monkeypatch.setattr(node_parameters, "TIMEOUT", 0.0)  # every update asks again
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    other = rclpy.create_node("other", namespace="/right", context=node.context)
    parameters = NodeParameters(node, "/right/other", lambda: parameters.destroy())
    deadline = time.monotonic() + 30.0
    while not parameters.is_present:
        assert time.monotonic() < deadline
        parameters.update()
        time.sleep(0.01)
    for _ in range(5):
        parameters.update()
    executor.add_node(other)  # which answers all requests now
    while not parameters.values:
        assert time.monotonic() < deadline
        executor.spin_once(timeout_sec=0.05)
    for _ in range(50):
        executor.spin_once(timeout_sec=0.01)
    assert "use_sim_time" in parameters.values
    executor.shutdown()
    other.destroy_node()
