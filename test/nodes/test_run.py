"""Which hosts a node communicates with, as set before it starts, and which signals end it."""

import os
import signal
from pathlib import Path

import pytest

from exo_gravity.hardware import network
from exo_gravity.hardware.network import keep_to_this_machine, open_to_others
from exo_gravity.nodes.ros.run import handle_signals

RANGE, ROS_RANGE = "EXO_GRAVITY_DISCOVERY_RANGE", "ROS_AUTOMATIC_DISCOVERY_RANGE"
NAMES = (RANGE, ROS_RANGE, "ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER")
LOOPBACK = str(Path(network.__file__).with_name("fastdds.xml"))
SECURITY = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    for name in (*NAMES, *SECURITY, "FASTRTPS_DEFAULT_PROFILES_FILE"):
        monkeypatch.setenv(name, "")  # so that what the test's subject sets goes after the test
        monkeypatch.delenv(name)
    return monkeypatch.setenv


@pytest.mark.parametrize("exported", ["", "SUBNET"])
def test_without_its_own_setting_a_node_communicates_on_this_machine_only(environment, exported):
    environment(ROS_RANGE, exported)  # SUBNET: as ROS's setup.bash exports it
    keep_to_this_machine()
    assert os.environ[ROS_RANGE] == "LOCALHOST"
    assert os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"].endswith("fastdds.xml")
    assert open_to_others() == ""


def test_its_own_setting_admits_other_hosts_and_is_named(environment):
    environment(RANGE, "SUBNET")
    keep_to_this_machine()
    assert os.environ[ROS_RANGE] == "SUBNET"
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" not in os.environ
    assert open_to_others() == "EXO_GRAVITY_DISCOVERY_RANGE=SUBNET"


@pytest.mark.parametrize("exported", ["", LOOPBACK])
def test_with_a_named_peer_a_node_does_not_keep_to_the_loopback_interface(environment, exported):
    environment("ROS_STATIC_PEERS", "10.0.0.2")
    if exported:  # as docs/security.md recommends for other programs
        environment("FASTRTPS_DEFAULT_PROFILES_FILE", exported)
    keep_to_this_machine()
    assert os.environ[ROS_RANGE] == "LOCALHOST"
    assert os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"].endswith("fastdds_peers.xml")
    assert open_to_others() == "ROS_STATIC_PEERS=10.0.0.2"


def test_with_a_named_peer_the_users_own_profile_is_kept(environment):
    environment("ROS_STATIC_PEERS", "10.0.0.2")
    environment("FASTRTPS_DEFAULT_PROFILES_FILE", "own.xml")
    keep_to_this_machine()
    assert os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] == "own.xml"


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
