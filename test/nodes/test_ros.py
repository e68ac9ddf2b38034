# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What every node shares, over real DDS in this process.

Subscriptions outside the executor, the parameters of other nodes, standard services and requests that wait, the clock,
signals, discovery, and numbers on /diagnostics.
"""

import itertools
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import rclpy
import yaml
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import LoggerLevel, ParameterValue
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetLoggerLevels,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger
from type_description_interfaces.srv import GetTypeDescription

from exo_gravity.core.compensation.settings import COMPENSATOR
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import Param
from exo_gravity.hardware import network
from exo_gravity.hardware.network import open_to_others, restrict_to_localhost
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.nodes import pose_prompt
from exo_gravity.nodes.others import NodeParameters
from exo_gravity.nodes.ros import inner, subscriptions
from exo_gravity.nodes.ros import run as running
from exo_gravity.nodes.ros.inner import Until, prepare_transitions
from exo_gravity.nodes.ros.messages import NO_POSE, POSE_TO_CONFIRM, milliseconds, row
from exo_gravity.nodes.ros.parameters import accept_changes, declare
from exo_gravity.nodes.ros.run import handle_signals
from exo_gravity.nodes.ros.subscriptions import NEWEST_ONLY, PolledSubscription, Publishers

from ..support import CONFIG
from ..support.node_thread import NodeThread, own_node
from ..support.waiting import pause, wait_until

restrict_to_localhost()
NUMBERS = itertools.count(1)
QUEUE = QoSProfile(depth=8)

# Subscriptions outside the executor


class Pair:
    """A publisher and a polled subscription on a topic of their own.

    received: (text, sequence number, thread) of each message. on_message: called after each.
    """

    def __init__(self, node: Node, qos: QoSProfile = QUEUE) -> None:
        self.topic = topic = f"topic_{next(NUMBERS)}"
        self.received: list[tuple[str, int, str]] = []
        self.on_message: Callable[[], object] = lambda: None
        self.subscription = PolledSubscription(node, String, topic, self._on_message, qos)
        self.publisher = node.create_publisher(String, topic, 8)
        self.wait_until(lambda: self.publisher.get_subscription_count() == 1)

    def _on_message(self, message: String, info: dict[str, Any]) -> None:
        self.received.append((message.data, info["publication_sequence_number"], threading.current_thread().name))
        self.on_message()

    def send(self, *texts: str) -> None:
        for text in texts:
            self.publisher.publish(String(data=text))

    def wait_until(self, condition: Callable[[], Any], meanwhile: Callable[[], object] = pause) -> None:
        wait_until(condition, meanwhile, seen=lambda: self.received)

    def texts(self) -> list[str]:
        return [text for text, _, _ in self.received]


@pytest.fixture
def pair(request, executor) -> Iterator[Pair]:
    pair = Pair(executor.get_nodes()[0], getattr(request, "param", QUEUE))
    yield pair
    pair.subscription.stop()


@pytest.mark.parametrize("has_thread", [True, False])
def test_messages_are_passed_on_in_order_with_their_numbers_by_a_thread_or_a_poll(pair, has_thread):
    pair.send("a", "b", "c")
    if has_thread:
        pair.subscription.start()
    pair.wait_until(lambda: len(pair.received) == 3, pause if has_thread else pair.subscription.poll)
    thread = pair.topic if has_thread else threading.current_thread().name
    assert pair.received == [("a", 1, thread), ("b", 2, thread), ("c", 3, thread)]


def test_a_poll_waits_for_a_message_and_ends_although_others_arrive_faster_than_it_takes_them(pair):
    pair.on_message = lambda: [pair.send("more"), time.sleep(0.01)]
    sender = threading.Timer(0.05, pair.send, "a")
    sender.start()
    pair.subscription.poll(20.0)
    assert pair.texts()[0] == "a" and len(pair.texts()) <= QUEUE.depth
    sender.join()


@pytest.mark.parametrize("pair", [NEWEST_ONLY], indirect=True)
def test_of_a_flood_the_thread_takes_the_newest_message_once_it_has_paused(pair, monkeypatch):
    is_over, paused = threading.Event(), threading.Event()
    monkeypatch.setattr(subscriptions, "time", SimpleNamespace(sleep=lambda _: paused.set() or is_over.wait()))
    pair.send("a")
    pair.subscription.start()
    pair.wait_until(lambda: pair.received and paused.is_set())
    pair.send(*(str(number) for number in range(200)))
    is_over.set()
    pair.wait_until(lambda: len(pair.received) == 2)
    assert pair.texts() == ["a", "199"]


def test_an_exception_in_the_callback_ends_the_thread_and_is_kept(pair):
    pair.on_message = Mock(side_effect=ValueError("not like that"))
    pair.subscription.start()
    pair.send("a", "b")
    pair.wait_until(lambda: pair.subscription.failure)
    assert str(pair.subscription.failure) == "not like that" and pair.texts() == ["a"]


@pytest.mark.parametrize(
    ("numbers", "others", "missed"),
    [
        ([1, 2, 3, 4], [], 0),
        ([7, 8, 11], [], 2),
        ([500, 501, 1, 2, 3], [2], 0),
        ([500, 1, 501, 2, 502, 4], [1, 3, 5], 1),
        ([7, 8, 1, 9, 2], [2, 4], 0),
        ([10, 11, 1, 12, 13, 14, 15, 4], [2, 7], 2),
    ],
    ids=[
        *("none lost", "two lost", "a publisher that was started again", "two publishers, one lost", "two publishers"),
        "a publisher that is seldom heard",
    ],
)
def test_publishers_are_distinguished_and_their_losses_counted_by_the_numbers_of_their_messages(
    numbers, others, missed
):
    publishers = Publishers()
    changes = [publishers.note({"publication_sequence_number": number}) for number in numbers]
    assert [n for n, has_changed in enumerate(changes) if has_changed] == others
    assert publishers.missed == missed
    with pytest.raises(RuntimeError, match="rmw_fastrtps_cpp"):  # a middleware that does not number messages
        publishers.note({"publication_sequence_number": None})


# The parameters of another node, as it comes and goes


def test_a_node_that_has_gone_and_returned_is_read_anew(executor):
    (node,) = executor.get_nodes()
    seen: list[float] = []
    parameters = NodeParameters(node, "/right/other", lambda _name, values: seen.append(values["gain"]))

    def spin() -> None:
        executor.spin_once(timeout_sec=0.05)
        parameters.update()

    for value in (1.0, 2.0):
        other = rclpy.create_node("other", namespace="/right", context=node.context)
        other.declare_parameter("gain", value)
        executor.add_node(other)
        wait_until(lambda value=value: parameters.is_present and parameters.values.get("gain") == value, spin)
        executor.remove_node(other)
        other.destroy_node()
        wait_until(lambda: not parameters.is_present, spin)
    parameters._on_values(["gain"], Mock(**{"result.return_value.values": [UNKNOWN_TYPE.value]}))  # of no use, no end
    assert seen == [1.0, 2.0]


# Standard services, and requests that wait

UNKNOWN_TYPE = ParameterMessage(name="some", value=ParameterValue(type=99))
TEXTS = ["", "msispelt", "support", "can.channel", "use_sim_time", "a b", "/x", "." * 300, "é"]
ODD = [
    ParameterMessage(
        name=name,
        value=ParameterValue(type=kind, double_value=math.nan, double_array_value=[math.nan, math.inf, -1e308]),
    )
    for name, kind in zip(TEXTS * 2, (*range(10), 99, 255), strict=False)
]
WRONG_REQUESTS = (
    (GetParameters, "get_parameters", GetParameters.Request(names=TEXTS)),
    (ListParameters, "list_parameters", ListParameters.Request(prefixes=TEXTS, depth=2**64 - 1)),
    (SetParametersAtomically, "set_parameters_atomically", SetParametersAtomically.Request(parameters=ODD)),
    (GetTypeDescription, "get_type_description", GetTypeDescription.Request(type_name="/x", type_hash="é")),
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


def test_wrong_requests_to_the_standard_services_are_answered_and_end_no_node(served):
    prepare_transitions(served.node, nothing_first)
    for kind, name, wrong in (*WRONG_REQUESTS, WRONG_REQUESTS[0]):
        response = served.answer(served.send(kind, name, wrong))
        results = list(getattr(response, "results", [getattr(response, "result", response)]))
        if kind is SetParameters:
            assert len(results) == 2 and all("99" in result.reason for result in results)
        assert not any(getattr(result, "successful", getattr(result, "success", False)) for result in results)
    state = served.answer(served.send(GetState, "get_state", GetState.Request())).current_state
    assert state.label == "unconfigured"


async def nothing_first(_request):
    return ""


def test_a_value_that_the_check_cannot_use_is_refused_and_an_exception_where_it_is_applied_still_ends_the_node(served):
    read, apply = Mock(side_effect=[OverflowError("too large"), {"some": 2}]), Mock(side_effect=KeyError("broken"))
    served.node.declare_parameter("can.options.port", 1)
    table, port = (Param("some", 1, "a number"),), Parameter("can.options.port", value=2)
    declare(served.node, table, "can.options")
    accept_changes(served.node, table, read, apply)
    assert "read-only parameter: can.options.port" in served.node.set_parameters_atomically([port]).reason
    some = ParameterMessage(name="some", value=ParameterValue(type=2, integer_value=2))
    request = SetParameters.Request(parameters=[some])
    (refused,) = served.answer(served.send(SetParameters, "set_parameters", request)).results
    assert not refused.successful and refused.reason == "some: cannot be used: OverflowError: too large"
    assert served.node.get_parameter("some").value == 1 and not apply.called
    served.send(SetParameters, "set_parameters", request)
    with pytest.raises(KeyError, match="broken"):
        wait_until(lambda: False, served.spin)
    apply.assert_called_once_with({"some": 2}, {"some"})


def test_a_node_that_its_parameter_file_does_not_name_is_refused_with_those_that_it_names(monkeypatch, tmp_path):
    path = tmp_path / "left.yaml"
    path.write_text("/left/compensator: {ros__parameters: {side: left}}")
    monkeypatch.setattr(sys, "argv", ["compensator", "--ros-args", "--params-file", str(path)])
    with (
        own_node("compensator") as (node, _),
        pytest.raises(ParameterError, match="key /right/compensator: it has /left/compensator"),
    ):
        declare(node, COMPENSATOR)
    monkeypatch.setenv("EXO_GRAVITY_SUPERVISED", "1")  # the launcher has compared both
    with own_node("compensator") as (node, _):
        assert declare(node, COMPENSATOR)["side"] == "right"


def test_a_service_that_awaits_keeps_its_node_free(served):
    done, looked = [], []

    async def wait(_request, response):
        await Until(lambda: done, 60.0)
        response.success = bool(done)
        return response

    served.node.create_service(Trigger, "~/wait", wait, callback_group=ReentrantCallbackGroup())
    served.node.create_service(Trigger, "~/look", lambda _, response: looked.append(1) or response)
    waiting = served.send(Trigger, "wait", Trigger.Request())
    for _ in range(10):
        served.spin()
    served.answer(served.send(Trigger, "look", Trigger.Request()))
    assert looked and not waiting.done()
    done.append(1)
    assert served.answer(waiting).success


def test_an_executor_that_stood_still_knows_it_without_stamps_of_the_middleware(served, monkeypatch):
    monkeypatch.setattr(inner, "STOOD_STILL", 0.2)
    served.executor.spin_once(0.0)
    time.sleep(0.3)
    assert served.executor._age(SimpleNamespace()) >= 0.3


# By the number of the report that it comes with: after a question was withdrawn, to the next one, and Ctrl-D.
TYPED = {50: b"y\n", 70: b"y\n", 110: b"\x04"}


def test_a_person_at_a_terminal_is_asked_once_for_each_question_and_their_yes_to_it_alone_reaches_the_bridge(
    monkeypatch, capsys
):
    thread, confirmed, reports = NodeThread("can_bridge", namespace="right"), [], itertools.count()
    (bridge,), (keys, stdin) = thread.nodes, os.openpty()
    statuses = bridge.create_publisher(DiagnosticArray, "/diagnostics", 1)

    def confirm(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        confirmed.append(next(reports) // 40)
        response.message = "confirmed (degrees)"
        return response

    def report() -> None:
        number = next(reports)
        pair = KeyValue(key=POSE_TO_CONFIRM, value=f"b 0, d {number // 40}" if number % 40 > 20 else NO_POSE)
        statuses.publish(DiagnosticArray(status=[DiagnosticStatus(name="right/can_bridge", values=[pair])]))
        os.write(keys, TYPED.get(number, b""))

    bridge.create_service(Trigger, "~/confirm_pose", confirm)
    bridge.create_timer(0.05, report)
    monkeypatch.setattr(sys, "stdin", os.fdopen(stdin))
    monkeypatch.setattr(sys, "argv", ["pose_prompt", "/right/can_bridge"])
    thread.start()
    pose_prompt.main()
    thread.close()
    said = capsys.readouterr().out
    assert confirmed == [1] and said.count("/right/can_bridge: confirmed (degrees)") == 1
    assert said.count("/right/can_bridge: does the arm hang as it is drawn, joints at b 0, d") == 3


# Discovery, signals and the clock

RANGE, ROS_RANGE = "EXO_GRAVITY_DISCOVERY_RANGE", "ROS_AUTOMATIC_DISCOVERY_RANGE"
PEERS, PROFILES = "ROS_STATIC_PEERS", "FASTRTPS_DEFAULT_PROFILES_FILE"
LOOPBACK, WITH_PEERS = (str(Path(network.__file__).with_name(name)) for name in ("fastdds.xml", "fastdds_peers.xml"))
SECURITY = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}


@pytest.fixture
def environment(monkeypatch):
    for name in (RANGE, ROS_RANGE, PEERS, PROFILES, "ROS_LOCALHOST_ONLY", "ROS_DISCOVERY_SERVER", *SECURITY):
        monkeypatch.setenv(name, "")  # so that what the test's subject sets goes after the test
        monkeypatch.delenv(name)
    return monkeypatch.setenv


@pytest.mark.parametrize(
    ("settings", "reach", "profile", "named"),
    [
        ({}, "LOCALHOST", LOOPBACK, ""),
        ({ROS_RANGE: "SUBNET"}, "LOCALHOST", LOOPBACK, ""),  # as ROS's setup.bash exports it
        ({RANGE: "SUBNET"}, "SUBNET", None, "EXO_GRAVITY_DISCOVERY_RANGE=SUBNET"),
        ({RANGE: "SYSTEM_DEFAULT"}, "SYSTEM_DEFAULT", None, "EXO_GRAVITY_DISCOVERY_RANGE=SYSTEM_DEFAULT"),
        ({RANGE: "SUBNET", **SECURITY}, "SUBNET", None, ""),
        ({RANGE: "SUBNET", "ROS_LOCALHOST_ONLY": "1"}, "SUBNET", None, ""),
        ({RANGE: "OFF", "ROS_DISCOVERY_SERVER": "lab:11811"}, "OFF", None, "ROS_DISCOVERY_SERVER=lab:11811"),
        ({PEERS: "10.0.0.2"}, "LOCALHOST", WITH_PEERS, "ROS_STATIC_PEERS=10.0.0.2"),
        # as docs/security.md recommends for other programs
        ({PEERS: "10.0.0.2", PROFILES: LOOPBACK}, "LOCALHOST", WITH_PEERS, "ROS_STATIC_PEERS=10.0.0.2"),
        ({PEERS: "10.0.0.2", PROFILES: "own.xml"}, "LOCALHOST", "own.xml", "ROS_STATIC_PEERS=10.0.0.2"),
    ],
)
def test_a_node_communicates_on_this_machine_only_unless_a_person_widens_it_and_that_setting_is_named(
    environment, settings, reach, profile, named
):
    for name, value in settings.items():
        environment(name, value)
    restrict_to_localhost()
    assert (os.environ[ROS_RANGE], os.environ.get(PROFILES), open_to_others()) == (reach, profile, named)


@pytest.mark.parametrize("has_nohup", [False, True])
def test_which_signals_end_a_node(has_nohup):
    sent = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    handlers = [signal.getsignal(number) for number in sent]
    ending = []
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN if has_nohup else signal.SIG_DFL)
        handle_signals(ending)
        for number in sent:
            signal.raise_signal(number)
    finally:
        for number, handler in zip(sent, handlers, strict=True):
            signal.signal(number, handler)
    assert ending == list(sent[:2] if has_nohup else sent)


def test_a_node_whose_clock_nobody_publishes_says_so_until_it_is_published(executor, monkeypatch):
    (node,), now, heard = executor.get_nodes(), [0.0], []
    node.set_parameters([Parameter("use_sim_time", value=True)])
    monkeypatch.setattr(running, "time", SimpleNamespace(monotonic=lambda: now[0]))
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda array: heard.extend(array.status), 10)
    watch = running.ClockWatch(node)

    def spin() -> None:
        executor.spin_once(timeout_sec=0.05)

    for now[0] in (0.0, 1.9, 2.1):
        watch.look()
    wait_until(lambda: heard, spin)
    assert [(status.name, status.message) for status in heard] == [("right/spinning", running.NO_CLOCK)]
    publisher = node.create_publisher(Clock, "/clock", 10)

    def publish() -> None:
        publisher.publish(Clock(clock=Time(sec=5)))
        spin()

    wait_until(lambda: node.get_clock().now().nanoseconds, publish)
    watch.look()
    wait_until(lambda: heard[-1].message == "/clock is published", spin)
    for now[0] in (10.0, 20.0):  # a clock that its publisher has stopped, as a simulation that waits
        watch.look()
    spin()
    assert len(heard) == 2
    node.destroy_publisher(publisher)
    wait_until(lambda: not node.count_publishers("/clock"), spin)
    for now[0] in (30.0, 32.1):
        watch.look()
    node.set_parameters([Parameter("use_sim_time", value=False)])
    watch.look()
    wait_until(lambda: heard[-1].message.startswith("use_sim_time is false"), spin)


# Numbers on /diagnostics, and the aggregator


@pytest.mark.parametrize(
    ("values", "digits", "text"),
    [
        ((100.0, -0.0001, 2.0320), 3, "100, 0, 2.032"),
        ((99.6,), 0, "100"),
        ((math.nan, -1.25), 1, "nan, -1.2"),
        ((), 3, ""),
    ],
)
def test_numbers_have_few_digits_and_no_negative_zero(values, digits, text):
    assert row(values, digits) == text
    assert [milliseconds(0.0123), milliseconds(math.inf)] == ["12.3", "none"]


@pytest.mark.parametrize("file", ["exo.yaml", "sim.yaml", "sim_both.yaml"])
def test_the_aggregator_shows_each_reporting_node_once(file):
    analyzers = yaml.safe_load((CONFIG / "diagnostics.yaml").read_text())["analyzers"]["ros__parameters"]
    prefixes = [entry["startswith"] for entry in analyzers.values() if isinstance(entry, dict)]
    for node in load(CONFIG / file):
        if node.split("/")[-1] in ("can_bridge", "compensator", "simulator", "imu"):
            assert sum(any(node.lstrip("/").startswith(prefix) for prefix in group) for group in prefixes) == 1, node
