# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Which hosts a node communicates with, as set before it starts, which signals end it, and which clock it waits for."""

import os
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from exo_gravity.hardware import network
from exo_gravity.hardware.network import keep_to_this_machine, open_to_others
from exo_gravity.nodes.ros import run as running
from exo_gravity.nodes.ros.run import WAITS_FOR_BRIDGES, handle_signals

from ..support.own_node import own_node
from ..support.waiting import wait_until

RANGE, ROS_RANGE = "EXO_GRAVITY_DISCOVERY_RANGE", "ROS_AUTOMATIC_DISCOVERY_RANGE"
PEERS, PROFILES = "ROS_STATIC_PEERS", "FASTRTPS_DEFAULT_PROFILES_FILE"
NAMES = (RANGE, ROS_RANGE, PEERS, PROFILES, "ROS_LOCALHOST_ONLY", "ROS_DISCOVERY_SERVER")
LOOPBACK, WITH_PEERS = (str(Path(network.__file__).with_name(name)) for name in ("fastdds.xml", "fastdds_peers.xml"))
SECURITY = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    for name in (*NAMES, *SECURITY):
        monkeypatch.setenv(name, "")  # so that what the test's subject sets goes after the test
        monkeypatch.delenv(name)
    return monkeypatch.setenv


@pytest.mark.parametrize(
    ("settings", "reach", "profile", "named"),
    [
        ({}, "LOCALHOST", LOOPBACK, ""),
        ({ROS_RANGE: "SUBNET"}, "LOCALHOST", LOOPBACK, ""),  # as ROS's setup.bash exports it
        ({RANGE: "SUBNET"}, "SUBNET", None, "EXO_GRAVITY_DISCOVERY_RANGE=SUBNET"),
        ({PEERS: "10.0.0.2"}, "LOCALHOST", WITH_PEERS, "ROS_STATIC_PEERS=10.0.0.2"),
        # as docs/security.md recommends for other programs
        ({PEERS: "10.0.0.2", PROFILES: LOOPBACK}, "LOCALHOST", WITH_PEERS, "ROS_STATIC_PEERS=10.0.0.2"),
        ({PEERS: "10.0.0.2", PROFILES: "own.xml"}, "LOCALHOST", "own.xml", "ROS_STATIC_PEERS=10.0.0.2"),
    ],
)
def test_a_node_communicates_on_this_machine_only_unless_a_person_widens_it(
    environment, settings, reach, profile, named
):
    for name, value in settings.items():
        environment(name, value)
    keep_to_this_machine()
    assert (os.environ[ROS_RANGE], os.environ.get(PROFILES), open_to_others()) == (reach, profile, named)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({RANGE: "SYSTEM_DEFAULT"}, "EXO_GRAVITY_DISCOVERY_RANGE=SYSTEM_DEFAULT"),
        ({RANGE: "SUBNET", **SECURITY}, ""),
        ({RANGE: "SUBNET", "ROS_LOCALHOST_ONLY": "1"}, ""),
        ({"ROS_STATIC_PEERS": "lab-pc"}, "ROS_STATIC_PEERS=lab-pc"),
        ({RANGE: "OFF", "ROS_DISCOVERY_SERVER": "lab:11811"}, "ROS_DISCOVERY_SERVER=lab:11811"),
    ],
)
def test_the_setting_that_admits_other_hosts_is_named(environment, settings, named):
    for name, value in settings.items():
        environment(name, value)
    keep_to_this_machine()
    assert open_to_others() == named


@pytest.mark.parametrize(
    ("has_nohup", "waits", "ends"),
    [
        (False, "", ["SIGTERM", "SIGINT", "SIGHUP"]),
        (True, "", ["SIGTERM", "SIGINT"]),
        (False, "1", ["SIGTERM"]),  # under `ros2 launch`, which interrupts all nodes at once
    ],
)
def test_which_signals_end_a_node(environment, has_nohup, waits, ends):
    environment(WAITS_FOR_BRIDGES, waits)
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
    assert ending == [signal.Signals[name] for name in ends]


@pytest.fixture
def waiting():
    """A node that waits for /clock, and its executor."""
    keep_to_this_machine()
    with own_node("waiting", parameter_overrides=[Parameter("use_sim_time", value=True)]) as own:
        yield own


def test_a_node_whose_clock_nobody_publishes_says_so_until_it_is_published(waiting, monkeypatch):
    (node, executor), now, heard = waiting, [0.0], []
    monkeypatch.setattr(running, "time", SimpleNamespace(monotonic=lambda: now[0]))
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda array: heard.extend(array.status), 10)
    watch = running.ClockWatch(node)

    def spin() -> None:
        executor.spin_once(timeout_sec=0.05)

    for now[0] in (0.0, 1.9, 2.1):
        watch.look()
    wait_until(lambda: heard, spin)
    assert [(status.name, status.message) for status in heard] == [("right/waiting", running.NO_CLOCK)]
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
