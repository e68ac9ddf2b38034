# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the nodes use of rclpy's inner parts, and what is done without them, over real DDS in this process."""

from __future__ import annotations

import itertools
import time
from types import SimpleNamespace

import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import LoggerLevel, ParameterValue
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    SetLoggerLevels,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from exo_gravity.core.params import Param
from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.nodes.can_bridge import operation
from exo_gravity.nodes.can_bridge.operation import BridgeServices
from exo_gravity.nodes.ros import inner
from exo_gravity.nodes.ros.inner import ExecutorInbox, NodeExecutor, Until, age_of_request, prepare_transitions
from exo_gravity.nodes.ros.parameters import accept_changes
from exo_gravity.nodes.ros.subscriptions import MANY_REQUESTS, PolledSubscription

from ..support.waiting import wait_until
from .test_bridge_operation import standing

keep_to_this_machine()
TOPICS = itertools.count(1)
UNKNOWN_TYPE = ParameterMessage(name="some", value=ParameterValue(type=99))
WRONG_REQUESTS = (
    (GetParameterTypes, "get_parameter_types", GetParameterTypes.Request(names=["msispelt"])),
    (DescribeParameters, "describe_parameters", DescribeParameters.Request(names=["msispelt"])),
    (GetParameters, "get_parameters", GetParameters.Request(names=["msispelt", ""])),
    (SetParameters, "set_parameters", SetParameters.Request(parameters=[UNKNOWN_TYPE] * 2)),
    (SetParametersAtomically, "set_parameters_atomically", SetParametersAtomically.Request(parameters=[UNKNOWN_TYPE])),
    (SetLoggerLevels, "set_logger_levels", SetLoggerLevels.Request(levels=[LoggerLevel(name="a", level=77)])),
    (ChangeState, "change_state", ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))),
    (ChangeState, "change_state", ChangeState.Request(transition=Transition(id=200))),
    (ChangeState, "change_state", ChangeState.Request(transition=Transition(label="fly"))),
)


class Served:
    """A lifecycle node with an executor, and a client node with another; nothing spins by itself."""

    def __init__(self, executor: type[SingleThreadedExecutor] = NodeExecutor) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = LifecycleNode("served", namespace="/right", context=self.context, enable_logger_service=True)
        self.client = rclpy.create_node("asking", namespace="/right", context=self.context)
        self.executor = executor(context=self.context)
        self.executor.add_node(self.node)
        self._own = SingleThreadedExecutor(context=self.context)
        self._own.add_node(self.client)

    def send(self, kind, name, request):
        """Send a request to a service of the node; return the future of its response."""
        client = self.client.create_client(kind, f"served/{name}")
        wait_until(client.service_is_ready)
        return client.call_async(request)

    def spin(self):
        """Let node and client each handle what has arrived."""
        self.executor.spin_once(0.01)
        self._own.spin_once(0.01)

    def answer(self, future):
        """Return the response of a request."""
        wait_until(future.done, self.spin)
        return future.result()

    def close(self):
        self.executor.shutdown()
        self._own.shutdown()
        self.node.destroy_node()
        self.client.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def served(request):
    """A node that nothing spins; `indirect` for an executor of another kind."""
    served = Served(getattr(request, "param", NodeExecutor))
    yield served
    served.close()


def test_wrong_requests_to_the_standard_services_are_answered_and_end_no_node(served):
    prepare_transitions(served.node, nothing_first)
    for kind, name, wrong in WRONG_REQUESTS * 2:
        response = served.answer(served.send(kind, name, wrong))
        results = list(getattr(response, "results", [getattr(response, "result", response)]))
        if kind is SetParameters:
            assert len(results) == 2 and all("99" in result.reason for result in results)
        assert not any(getattr(result, "successful", getattr(result, "success", False)) for result in results)
    state = served.answer(served.send(GetState, "get_state", GetState.Request())).current_state
    assert state.label == "unconfigured"


async def nothing_first(_request):
    return ""


def test_an_exception_of_this_package_in_a_standard_service_still_ends_the_node(served):
    def fail(_read: object, _names: set[str]) -> None:
        raise KeyError("broken")

    served.node.declare_parameter("some", 1)
    accept_changes(served.node, (Param("some", 1, "a number"),), lambda values: values, fail)
    some = ParameterMessage(name="some", value=ParameterValue(type=2, integer_value=3))
    served.send(SetParameters, "set_parameters", SetParameters.Request(parameters=[some]))
    with pytest.raises(KeyError, match="broken"):
        wait_until(lambda: False, served.spin)


def test_a_value_that_the_check_cannot_use_is_refused_and_leaves_the_node_and_its_value_as_they_were(served):
    def read(values: dict[str, int]) -> dict[str, int]:
        if values["some"] > 2:
            raise OverflowError("too large for a float")
        return values

    applied: list[object] = []
    served.node.declare_parameter("some", 1)
    accept_changes(served.node, (Param("some", 1, "a number"),), read, lambda values, _names: applied.append(values))
    results = []
    for value in (3, 2):
        some = ParameterMessage(name="some", value=ParameterValue(type=2, integer_value=value))
        answer = served.answer(served.send(SetParameters, "set_parameters", SetParameters.Request(parameters=[some])))
        results += answer.results
    refused, done = results
    assert not refused.successful and refused.reason == "some: cannot be used: OverflowError: too large for a float"
    assert done.successful and applied == [{"some": 2}]


def test_a_request_is_as_old_as_it_has_waited_while_the_executor_stood_still(served):
    ages = []
    served.node.create_service(
        Trigger, "~/look", lambda request, response: ages.append(age_of_request(served.node)) or response
    )
    served.answer(served.send(Trigger, "look", Trigger.Request()))
    future, before = served.send(Trigger, "look", Trigger.Request()), time.monotonic()
    time.sleep(0.3)
    waited = time.monotonic() - before
    served.answer(future)
    assert ages[0] < ages[1] and ages[1] >= waited


@pytest.mark.parametrize("data", [True, False])
def test_an_enable_that_has_waited_is_refused_and_a_let_down_is_not(served, monkeypatch, data):
    monkeypatch.setattr(operation, "REQUEST_LIFE", 0.2)
    loop = standing()
    loop.safety.enable(1.0)
    if data:
        loop.safety.disable(1.0)
    BridgeServices(served.node, lambda: loop, (), lambda: "")
    future = served.send(SetBool, "enable", SetBool.Request(data=data))
    time.sleep(0.3)
    response = served.answer(future)
    assert response.success is not data and loop.safety.state == "disabled"
    assert ("s old" in response.message) is data


def test_a_let_down_is_not_pushed_out_by_a_hundred_other_requests(served, monkeypatch):
    monkeypatch.setattr(operation, "REQUEST_LIFE", 0.0)  # those are refused
    loop = standing()
    loop.safety.enable(1.0)
    services = BridgeServices(served.node, lambda: loop, (), lambda: "")
    answered: list[tuple[str, str]] = []
    other = served.client.create_client(SetBool, "served/enable", qos_profile=MANY_REQUESTS)
    wait_until(other.service_is_ready)
    let_down = served.send(SetBool, "enable", SetBool.Request(data=False))
    others = [other.call_async(SetBool.Request(data=True)) for _ in range(100)]
    time.sleep(0.1)
    wait_until(others[-1].done, lambda: served.spin() or answered.append(services.last))
    assert loop.safety.state == "disabled" and ("let_down", "done") in answered
    assert let_down.done() and let_down.result().success


def test_a_let_down_does_not_wait_behind_enables_which_then_never_run(served):
    """The control thread stands still, and goes on once both have asked."""
    loop, calls = standing(), []
    run = loop.call

    def call(function):
        future = run(lambda: "")
        waiting = type(future)()
        calls.append((function, waiting))
        return waiting

    loop.call = call
    BridgeServices(served.node, lambda: loop, (), lambda: "")
    enable = served.send(SetBool, "enable", SetBool.Request(data=True))
    wait_until(lambda: len(calls) == 1, served.spin)
    disable = served.send(SetBool, "enable", SetBool.Request(data=False))
    wait_until(lambda: len(calls) == 2, served.spin)
    for function, future in calls:
        if future.set_running_or_notify_cancel():
            future.set_result(function())
    assert served.answer(disable).success
    refused = served.answer(enable)
    assert not refused.success and "let down" in refused.message
    assert loop.safety.state == "disabled"


@pytest.mark.parametrize("served", [NodeExecutor, SingleThreadedExecutor], indirect=True)
def test_a_service_that_awaits_answers_under_any_executor_and_keeps_ours_free(served):
    done, looked = [], []

    async def wait(_request, response):
        await Until(lambda: done, 60.0)
        response.success = bool(done)
        return response

    served.node.create_service(Trigger, "~/wait", wait)
    served.node.create_service(Trigger, "~/look", lambda _, response: looked.append(1) or response)
    waiting = served.send(Trigger, "wait", Trigger.Request())
    if type(served.executor) is NodeExecutor:
        for _ in range(10):
            served.spin()
        served.answer(served.send(Trigger, "look", Trigger.Request()))
        assert looked and not waiting.done()
    done.append(1)
    assert served.answer(waiting).success


def test_messages_pass_through_the_executor_where_rclpy_has_no_wait_set_for_one_topic(served):
    topic, received = f"inbox_{next(TOPICS)}", []
    subscription = PolledSubscription(
        served.node,
        String,
        topic,
        lambda message, info: received.append((message.data, info["publication_sequence_number"])),
        QoSProfile(depth=8),
        open_inbox=ExecutorInbox,
    )
    publisher = served.client.create_publisher(String, topic, 8)
    wait_until(lambda: publisher.get_subscription_count() == 1)
    for text in ("a", "b"):
        publisher.publish(String(data=text))

    def poll():
        served.spin()
        subscription.poll(0.01)

    wait_until(lambda: len(received) == 2, poll)
    assert received == [("a", 1), ("b", 2)]


def test_an_executor_that_stood_still_knows_it_without_stamps_of_the_middleware(served, monkeypatch):
    monkeypatch.setattr(inner, "STOOD_STILL", 0.2)
    served.executor.spin_once(0.0)
    time.sleep(0.3)
    assert served.executor._age(SimpleNamespace()) >= 0.3
