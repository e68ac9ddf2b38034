"""Which hosts a node communicates with, as set before it starts, and which signals end it."""

import os
import signal
from pathlib import Path

import pytest

from exo_gravity.hardware import network
from exo_gravity.hardware.network import keep_to_this_machine, open_to_others
from exo_gravity.nodes.ros.run import handle_signals

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
    ("has_nohup", "ends"), [(False, ["SIGTERM", "SIGINT", "SIGHUP"]), (True, ["SIGTERM", "SIGINT"])]
)
def test_which_signals_end_a_node(has_nohup, ends):
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
