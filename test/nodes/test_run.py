"""What a node does before it is a node: where it may be heard."""

import os

import pytest

from exo_gravity.nodes.run import keep_to_this_machine, open_to_others

NAMES = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER")
SECURITY = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    for name in (*NAMES, *SECURITY, "FASTRTPS_DEFAULT_PROFILES_FILE"):
        monkeypatch.delenv(name, raising=False)
    return monkeypatch.setenv


def test_nothing_set_means_this_machine_alone():
    keep_to_this_machine()
    assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"].endswith("fastdds.xml")
    assert open_to_others() == ""


def test_what_the_user_set_stays(environment):
    environment("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    keep_to_this_machine()
    assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SUBNET"
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" not in os.environ


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"}, "ROS_AUTOMATIC_DISCOVERY_RANGE=SYSTEM_DEFAULT"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", **SECURITY}, ""),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_LOCALHOST_ONLY": "1"}, ""),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "lab-pc"}, "ROS_STATIC_PEERS=lab-pc"),
        (
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_DISCOVERY_SERVER": "lab:11811"},
            "ROS_DISCOVERY_SERVER=lab:11811",
        ),
    ],
)
def test_what_lets_other_hosts_in_is_named(environment, settings, told):
    for name, value in settings.items():
        environment(name, value)
    assert open_to_others() == told
